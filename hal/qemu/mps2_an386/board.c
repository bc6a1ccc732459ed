/* Board mps2-an386, a Cortex-M4: start, end, the two interrupts, the critical section. */
#include "qemu/board.h"

#include "hal_interrupt.h"
#include "hal_time.h"
#include "qemu/hal_qemu.h"
#include "qemu/mps2_an386/timer.h"

/* Interrupt line that no peripheral of the board uses. */
#define CONTROL_IRQ 31

/* Armv7-M architecture reference manual, B3.4. */
#define NVIC_ISER0 (*(volatile uint32_t *)0xE000E100u)
#define NVIC_ISPR0 (*(volatile uint32_t *)0xE000E200u)
#define SCB_SHPR3_PENDSV (*(volatile uint8_t *)0xE000ED22u) /* priority of PendSV */
#define NVIC_IPR(irq) (*(volatile uint8_t *)(0xE000E400u + (irq)))

#define SYS_EXIT_EXTENDED 0x20
#define ADP_STOPPED_APPLICATION_EXIT 0x20026

extern uint32_t stack_top[]; /* symbol of the linker script */

noreturn void board_exit(uint32_t code) {
    const uint32_t block[2] = {ADP_STOPPED_APPLICATION_EXIT, code};
    register uint32_t operation __asm__("r0") = SYS_EXIT_EXTENDED;
    register const uint32_t *argument __asm__("r1") = block;
    __asm__ volatile("bkpt 0xAB" : "+r"(operation) : "r"(argument) : "memory");
    for (;;) {
    }
}

noreturn void board_restart(void) {
    __asm__ volatile("msr msp, %0\n\tb program_start" ::"r"(stack_top));
    __builtin_unreachable();
}

/* Handler of all other exceptions: none is expected. */
static void fault_handler(void) {
    board_exit(MAILBOX_EXIT_FAULT);
}

/* In assembly, so that their first and their last instructions have names: the instruction counter recognises both
 * ends. */
#define HANDLER(name, body)                                                                                            \
    ".balign 4\n"                                                                                                      \
    ".global " name "\n"                                                                                               \
    ".type " name ", %function\n" name ":\n"                                                                           \
    "    push {r4, lr}\n" /* r4: stack alignment to 8 bytes */                                                         \
    ".size " name ", . - " name "\n"                                                                                   \
    "    bl " body "\n"                                                                                                \
    ".type " name "_return, %function\n" name "_return:\n"                                                             \
    "    pop {r4, pc}\n"                                                                                               \
    ".size " name "_return, . - " name "_return\n"

void control_handler(void);
void deferred_handler(void);
__asm__(".text\n"
        ".thumb\n" HANDLER("control_handler", "program_interrupt") HANDLER("deferred_handler", "program_deferred"));

void board_interrupt_enable(void) {
    SCB_SHPR3_PENDSV = 0xFF;   /* lowest priority */
    NVIC_IPR(CONTROL_IRQ) = 0; /* highest configurable priority */
    NVIC_ISER0 = UINT32_C(1) << CONTROL_IRQ;
    if (board.mailbox.timed && board.mailbox.period_ticks > 0) {
        NVIC_IPR(TIMER_IRQ) = 0x80; /* lower: the control interrupt pre-empts the timer's */
        NVIC_ISER0 = UINT32_C(1) << TIMER_IRQ;
        timer_start(board.mailbox.period_ticks);
    }
}

void board_interrupt_pend(void) {
    NVIC_ISPR0 = UINT32_C(1) << CONTROL_IRQ;
    __asm__ volatile("dsb\n\tisb" ::: "memory");
}

/* Masks all interrupts: there are only the two of the drive and the timer's, which requests the control
 * interrupt.
 */
void hal_critical_enter(hal_t *hal) {
    (void)hal;
    __asm__ volatile("cpsid i" ::: "memory");
}

void hal_critical_leave(hal_t *hal) {
    (void)hal;
    __asm__ volatile("cpsie i" ::: "memory");
}

typedef void (*vector_t)(void);

__attribute__((section(".first"), used)) static const struct {
    uint32_t *stack;
    vector_t exceptions[15];
    vector_t interrupts[CONTROL_IRQ + 1];
} vectors = {
    .stack = stack_top,
    .exceptions = {program_start, fault_handler, fault_handler, fault_handler, fault_handler, fault_handler,
                   fault_handler, fault_handler, fault_handler, fault_handler, fault_handler, fault_handler,
                   fault_handler, deferred_handler, fault_handler},
    .interrupts = {[TIMER_IRQ] = timer_handler, [CONTROL_IRQ] = control_handler},
};
