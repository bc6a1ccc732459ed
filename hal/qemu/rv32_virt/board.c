/* Board virt with an RV32IMAC: start, end, the control interrupt, the critical section. */
#include "qemu/board.h"

#include "hal_interrupt.h"
#include "hal_time.h"
#include "qemu/hal_qemu.h"

/* SiFive test finisher: writing its status ends QEMU with the exit code in the upper half. */
#define FINISHER (*(volatile uint32_t *)0x00100000)
#define FINISHER_FAIL 0x3333

/* RISC-V ACLINT specification: software interrupt of the first hart, which software can request, unlike that of the
 * timer. */
#define ACLINT_MSIP (*(volatile uint32_t *)0x02000000)

/* RISC-V privileged architecture, 3.1.6 and 3.1.9. */
#define MSTATUS_MIE "8"
#define MIE_MSIE "8"

noreturn void board_exit(uint32_t code) {
    FINISHER = code << 16 | FINISHER_FAIL; /* status PASS has no exit code */
    for (;;) {
    }
}

/* Handler of all exceptions: none is expected. */
noreturn void fault_handler(void);
noreturn void fault_handler(void) {
    board_exit(MAILBOX_EXIT_FAULT);
}

/* Reset code and vector table: exceptions jump to the start of the table, software interrupts, number 3, to its fourth
 * word, where the handler begins. The handler saves the caller-saved registers and clears the request. Its alignment
 * keeps it within one page, so that its epilogue is one block of QEMU. */
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
        ".global control_handler\n"
        ".type control_handler, %function\n"
        "control_handler:\n"
        "    addi sp, sp, -64\n"
        ".size control_handler, . - control_handler\n"
        ".option pop\n"
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
        "    mret\n");

void board_interrupt_enable(void) {
    __asm__ volatile("csrsi mie, " MIE_MSIE "\n\tcsrsi mstatus, " MSTATUS_MIE ::: "memory");
}

void board_interrupt_pend(void) {
    ACLINT_MSIP = 1;
    while (ACLINT_MSIP) { /* the handler clears it */
    }
}

/* No timer, so instructions take no time: the execution time is that set by the bench. */
uint32_t hal_interrupt_elapsed_ticks(const hal_t *hal) {
    return hal->mailbox.elapsed_ticks;
}

/* Masks all interrupts: there is only the control interrupt. */
void hal_critical_enter(hal_t *hal) {
    (void)hal;
    __asm__ volatile("csrci mstatus, " MSTATUS_MIE ::: "memory");
}

void hal_critical_leave(hal_t *hal) {
    (void)hal;
    __asm__ volatile("csrsi mstatus, " MSTATUS_MIE ::: "memory");
}
