/* Compare values from duties. */
#ifndef CONTROL_PWM_H
#define CONTROL_PWM_H

#include <stdint.h>

#include "hal_pwm.h"

/* Sets one phase's two compare values for a duty in Q1.15, -32768..32768, which every law keeps to, rounded to a tick
 * of period_ticks (at most 32767): 0..+1 lower switch on, upper switch on for the duty's share; -1..0 upper switch off,
 * lower switch off for the duty's share. So the states are (+1, 0) and (-1, 0), and each switch switches at most once a
 * period. */
void pwm_set_phase(hal_pwm_compare_t *compare, unsigned phase, int32_t duty_q15, uint16_t period_ticks);

/* Sets one phase's compare values for a whole period in a state: +1 both switches on, 0 the lower one, -1 none. */
void pwm_set_state(hal_pwm_compare_t *compare, unsigned phase, int state, uint16_t period_ticks);

/* The same voltage in two pulses, which halves its ripple: each switch is on for (1 + duty) / 2 of the period, the
 * upper one in its middle and the lower one around its ends, and what they overlap beyond the period or leave open, a
 * quarter from either end, is the duty. Each switch still switches twice a period; the sum of both is rounded to a
 * tick. */
void pwm_set_phase_twice(hal_pwm_compare_t *compare, unsigned phase, int32_t duty_q15, uint16_t period_ticks);

#endif
