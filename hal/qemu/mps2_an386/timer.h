/* The board's timers, for instructions that take time: one triggers each control period, one counts. */
#ifndef TIMER_H
#define TIMER_H

#include <stdint.h>

/* Interrupt of the timer that triggers; must be enabled. */
#define TIMER_IRQ 8

/* Starts both: the first trigger comes one control period from now, which is 2 * period_ticks of HAL_PWM_TICK_NS, a
 * multiple of 40 ns. */
void timer_start(uint32_t period_ticks);

/* Handler of TIMER_IRQ. Requests the control interrupt, which must have a higher priority, unless the trigger came
 * while the previous interrupt was running: then it is missed. */
void timer_handler(void);

/* Ticks of HAL_PWM_TICK_NS since the trigger that is served, in steps of 40 ns, rounded down. */
uint32_t timer_elapsed_ticks(void);

#endif
