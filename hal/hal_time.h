/* Time since start, by a free-running timer, and the critical section. */
#ifndef HAL_TIME_H
#define HAL_TIME_H

#include <stdint.h>

#include "hal.h"

/* Microseconds since start; wraps after 71 minutes. [any] */
uint32_t hal_time_us(const hal_t *hal);

/* The same by a second clock with an oscillator of its own, from any beginning, in steps of at most 31 us (a crystal of
 * 32,768 Hz). [background] */
uint32_t hal_time_reference_us(const hal_t *hal);

/* Masks the control interrupt and the deferred interrupt between the two calls; does not nest. [background] */
void hal_critical_enter(hal_t *hal);
void hal_critical_leave(hal_t *hal);

#endif
