/* Board virt with an RV32IMAC: start, end, the two interrupts, the critical section. */
#include "qemu/board.h"

#include "hal_interrupt.h"
#include "hal_time.h"
#include "qemu/hal_qemu.h"

/* SiFive test finisher: writing its status ends QEMU with the exit code in the upper half. */
#define FINISHER (*(volatile uint32_t *)0x00100000)
#define FINISHER_FAIL 0x3333

/* RISC-V ACLINT specification, first hart. The software interrupt is the control interrupt. The timer interrupt, whose
 * priority is below the software interrupt's, is the deferred interrupt: it is requested while the time of the
 * timer is not below mtimecmp. The lower half stays 0, so that one store of the upper half requests it or clears the
 * request. */
#define ACLINT_MSIP (*(volatile uint32_t *)0x02000000)
#define ACLINT_MTIMECMP_LOW (*(volatile uint32_t *)0x02004000)
#define ACLINT_MTIMECMP_HIGH (*(volatile uint32_t *)0x02004004)
#define REQUEST 0u
#define NO_REQUEST UINT32_MAX

/* RISC-V privileged architecture, 3.1.6 and 3.1.9. */
#define MSTATUS_MIE "8"
#define MIE_MSIE UINT32_C(0x08)
#define MIE_MTIE UINT32_C(0x80)

noreturn void board_exit(uint32_t code) {
    FINISHER = code << 16 | FINISHER_FAIL; /* status PASS has no exit code */
    for (;;) {
    }
}

noreturn void board_restart(void) {
    __asm__ volatile("la sp, stack_top\n\tj program_start");
    __builtin_unreachable();
}

/* Handler of all exceptions: none is expected. */
noreturn void fault_handler(void);
noreturn void fault_handler(void) {
    board_exit(MAILBOX_EXIT_FAULT);
}

/* Reset code and vector table, one jump of a word for each cause: 0 exceptions, 3 software interrupt, 7 timer
 * interrupt.
 *
 * The handlers save the caller-saved registers and clear the request. The control interrupt pre-empts the deferred one:
 * that handler also saves what a further interrupt overwrites, mepc and mstatus, and enables interrupts while it calls
 * the drive; its own request is masked meanwhile. The alignment keeps each epilogue within one page, so that it is one
 * block of QEMU. */
__asm__(".macro for_each_saved access\n"
        "    .set .Loffset, 4\n"
        "    .irp register, t0, t1, t2, t3, t4, t5, t6, a0, a1, a2, a3, a4, a5, a6, a7\n"
        "    \\access \\register, .Loffset(sp)\n"
        "    .set .Loffset, .Loffset + 4\n"
        "    .endr\n"
        ".endm\n"

        ".section .first, \"ax\"\n"
        "    la sp, stack_top\n"
        "    la t0, traps + 1\n" /* 1: vectored mode */
        "    csrw mtvec, t0\n"
        "    j program_start\n"

        ".text\n"
        ".balign 256\n"
        ".option push\n"
        ".option norvc\n"
        "traps:\n"
        "    j fault_handler\n"
        "    j fault_handler\n"
        "    j fault_handler\n"
        "    j control_handler\n"
        "    j fault_handler\n"
        "    j fault_handler\n"
        "    j fault_handler\n"
        "    j deferred_handler\n"
        ".option pop\n"

        ".global control_handler\n"
        ".type control_handler, %function\n"
        "control_handler:\n"
        "    addi sp, sp, -64\n"
        ".size control_handler, . - control_handler\n"
        "    sw ra, 0(sp)\n"
        "    for_each_saved sw\n"
        "    li t0, 0x02000000\n" /* ACLINT_MSIP */
        "    sw zero, 0(t0)\n"
        "    call program_interrupt\n"
        ".type control_handler_return, %function\n"
        "control_handler_return:\n"
        "    lw ra, 0(sp)\n"
        ".size control_handler_return, . - control_handler_return\n"
        "    for_each_saved lw\n"
        "    addi sp, sp, 64\n"
        "    mret\n"

        ".balign 128\n"
        ".global deferred_handler\n"
        ".type deferred_handler, %function\n"
        "deferred_handler:\n"
        "    addi sp, sp, -80\n"
        ".size deferred_handler, . - deferred_handler\n"
        "    sw ra, 0(sp)\n"
        "    for_each_saved sw\n"
        "    csrr t0, mepc\n"
        "    csrr t1, mstatus\n"
        "    sw t0, 64(sp)\n"
        "    sw t1, 68(sp)\n"
        "    li t0, 0x02004004\n" /* ACLINT_MTIMECMP_HIGH */
        "    li t1, -1\n"         /* NO_REQUEST */
        "    sw t1, 0(t0)\n"
        "    li t0, 0x80\n" /* MIE_MTIE */
        "    csrc mie, t0\n"
        "    csrsi mstatus, " MSTATUS_MIE "\n"
        "    call program_deferred\n"
        "    csrci mstatus, " MSTATUS_MIE "\n"
        "    li t0, 0x80\n"
        "    csrs mie, t0\n"
        "    lw t0, 64(sp)\n"
        "    lw t1, 68(sp)\n"
        "    csrw mepc, t0\n"
        "    csrw mstatus, t1\n" /* the last that ends a block of QEMU before the return */
        ".type deferred_handler_return, %function\n"
        "deferred_handler_return:\n"
        "    lw ra, 0(sp)\n"
        ".size deferred_handler_return, . - deferred_handler_return\n"
        "    for_each_saved lw\n"
        "    addi sp, sp, 80\n"
        "    mret\n");

void board_interrupt_enable(void) {
    ACLINT_MTIMECMP_HIGH = NO_REQUEST;
    ACLINT_MTIMECMP_LOW = 0;
    __asm__ volatile("csrs mie, %0\n\tcsrsi mstatus, " MSTATUS_MIE ::"r"(MIE_MSIE | MIE_MTIE) : "memory");
}

void board_interrupt_pend(void) {
    ACLINT_MSIP = 1;
    while (ACLINT_MSIP != 0) { /* the handler clears it */
    }
}

void hal_interrupt_request_deferred(hal_t *hal) {
    (void)hal;
    ACLINT_MTIMECMP_HIGH = REQUEST;
}

/* No use of the timer's time, so instructions take no time: the execution time is that set by the bench. */
uint32_t hal_interrupt_elapsed_ticks(const hal_t *hal) {
    return hal->mailbox.elapsed_ticks;
}

/* Masks all interrupts: there are only the two of the drive. */
void hal_critical_enter(hal_t *hal) {
    (void)hal;
    __asm__ volatile("csrci mstatus, " MSTATUS_MIE ::: "memory");
}

void hal_critical_leave(hal_t *hal) {
    (void)hal;
    __asm__ volatile("csrsi mstatus, " MSTATUS_MIE ::: "memory");
}
