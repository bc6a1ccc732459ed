/* The control interrupt, which the PWM timer triggers at the start of each control period, and the deferred interrupt,
 * which the control interrupt requests. */
#ifndef HAL_INTERRUPT_H
#define HAL_INTERRUPT_H

#include <stdint.h>

#include "hal.h"

/* Triggers missed since the last call: a trigger that comes while the previous control interrupt is still running is
 * not made up for, and its period keeps the compare values of the period before. [control interrupt] */
uint32_t hal_interrupt_missed_triggers(hal_t *hal);

/* Ticks of the PWM timer from the trigger of the present control interrupt, which took its sample, rounded down to
 * the resolution of the port's counter. Continues beyond the period, wraps after 2^32 ticks; 0 on a port whose
 * instructions take no time. [control interrupt, deferred interrupt] */
uint32_t hal_interrupt_elapsed_ticks(const hal_t *hal);

/* Requests the deferred interrupt: the port calls drive_deferred_interrupt once after the present control interrupt, at
 * a priority between the control interrupt, which pre-empts it, and the background. A request while one is
 * waiting has no effect; the drive makes none before the last call has returned. [control interrupt] */
void hal_interrupt_request_deferred(hal_t *hal);

#endif
