/* Callees of the control interrupt: with link-time optimisation, unlike board.c, so that it is inlined there. */
#include "hal_interrupt.h"
#include "qemu/hal_qemu.h"
#include "qemu/mps2_an386/timer.h"

/* Armv7-M architecture reference manual, B3.2.4. */
#define SCB_ICSR (*(volatile uint32_t *)0xE000ED04u)
#define SCB_ICSR_PENDSVSET (UINT32_C(1) << 28)

void hal_interrupt_request_deferred(hal_t *hal) {
    (void)hal;
    SCB_ICSR = SCB_ICSR_PENDSVSET;
}

uint32_t hal_interrupt_elapsed_ticks(const hal_t *hal) {
    return hal->mailbox.timed ? timer_elapsed_ticks() : hal->mailbox.elapsed_ticks;
}
