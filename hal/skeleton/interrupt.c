/* Interrupts: the trigger of each period, and what the control interrupt requests. */
#include "hal_interrupt.h"
#include "hal_time.h"
#include "skeleton/board.h"

/* FILL IN: triggers since the last call, less the one that is served; count them in hardware. */
uint32_t hal_interrupt_missed_triggers(hal_t *hal) {
    (void)hal;
    return 0;
}

/* FILL IN: ticks of the PWM timer since the trigger that is served, beyond the period, too. */
uint32_t hal_interrupt_elapsed_ticks(const hal_t *hal) {
    (void)hal;
    return 0;
}

/* FILL IN: makes the deferred interrupt pending (Cortex-M: PendSV). */
void hal_interrupt_request_deferred(hal_t *hal) {
    (void)hal;
}

/* FILL IN: masks both interrupts. */
void hal_critical_enter(hal_t *hal) {
    (void)hal;
}

/* FILL IN: lets them in again. */
void hal_critical_leave(hal_t *hal) {
    (void)hal;
}
