/* Pulse-width modulator: compare values of the asymmetric half bridges (hal_pwm.h) from duties.
 *
 * A duty is the mean phase voltage of a period as a fraction of the DC-link voltage, Q1.15, -32768..32768; the switch
 * states of hysteresis control are the duties -1, 0 and +1. Compare values are rounded to the timer tick. */
#ifndef CONTROL_MODULATOR_H
#define CONTROL_MODULATOR_H

#include <stdbool.h>
#include <stdint.h>

#include "hal_pwm.h"

#define MODULATOR_DUTY_ONE_Q15 32768

/* Sets the compare values of phases 0..phases - 1 for a timer period of period_ticks (1..32767); the other phases
 * keep theirs.
 *
 * Not interleaved: at 0..+1 the lower switch is on and the upper one is modulated, at -1..0 the upper switch is off and
 * the lower one is modulated. Each switch switches at most once per period.
 *
 * Interleaved: the same voltage in two pulses, which halves the current ripple. Each switch is on for (1 + duty) / 2 of
 * the period, the upper one in its middle, the lower one around its ends; their overlap, or the gap between them, a
 * quarter of the period from either end, is the duty. */
void modulate(const int32_t duty_q15[], unsigned phases, uint16_t period_ticks, bool interleaved,
              hal_pwm_compare_t *compare);

#endif
