/* Timers of the board, used with instruction timing: one triggers each control period, one counts. */
#ifndef TIMER_H
#define TIMER_H

#include <stdint.h>

/* Interrupt of the timer that triggers; must be enabled. */
#define TIMER_IRQ 8

/* Starts both timers; the first trigger occurs after one control period of 2 * period_ticks PWM ticks, a
 * multiple of 40 ns. */
void timer_start(uint32_t period_ticks);

/* Handler of TIMER_IRQ, above the deferred interrupt. Requests the control interrupt, which must have a higher
 * priority, unless the trigger occurred while the previous interrupt was running: then it is missed. */
void timer_handler(void);

/* PWM ticks since the trigger that is served, in steps of 40 ns, rounded down. */
uint32_t timer_elapsed_ticks(void);

#endif
