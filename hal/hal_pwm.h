/* PWM timer of the asymmetric half bridges: two switches per phase, one compare value each.
 *
 * The timer counts up and down, `period_ticks` each way, so a control period is 2 * period_ticks ticks of its clock.
 * An upper switch is on while its carrier is below its compare value, with the carrier's valley in the middle of the
 * period: a pulse of 2 * compare ticks, centred. The lower switch's carrier has its valley at the ends of the period
 * (shifted by half a period), so a compare value gives a pulse split over both ends; two partial duties therefore
 * interleave. Compare 0 is off for the whole period, compare >= period_ticks is on for the whole period.
 *
 *   both on: +Vdc    one on: 0 (freewheeling)    both off: -Vdc while current flows, else open
 *
 * Compare values are buffered: what is written in period k acts from the start of period k + 1.
 */
#ifndef HAL_PWM_H
#define HAL_PWM_H

#include <stdint.h>

#include "hal.h"

/* Range of the timer's clock. */
#define HAL_PWM_CLOCK_HZ_MIN 25000000
#define HAL_PWM_CLOCK_HZ_MAX 400000000

typedef struct {
    uint16_t upper[HAL_PHASES_MAX]; /* compare value in ticks */
    uint16_t lower[HAL_PHASES_MAX];
} hal_pwm_compare_t;

/* Clock of the timer, whose ticks are the unit of compare values, edge ages and execution times; constant. The drive
 * does not start unless it is in the range above and half a control period is an integer number of ticks. [background]
 */
uint32_t hal_pwm_clock_hz(const hal_t *hal);

/* Sets the period and starts the timer; the first control interrupt comes one period later. Called once. [background]
 */
void hal_pwm_start(hal_t *hal, uint16_t period_ticks);

/* Buffers the compare values of the next period. [control interrupt] */
void hal_pwm_write(hal_t *hal, const hal_pwm_compare_t *compare);

/* Opens every switch now, not at the next period, and clears the buffer. [control interrupt, background] */
void hal_pwm_open_all(hal_t *hal);

/* Causes of a break. A break opens every switch without the firmware, within the response of the hardware, and keeps
 * them open whatever is written:
 *
 *   over-current   a comparator in a gate driver, from the current in the switch, independent of the ADC
 *   not renewed    the compare values of two periods in succession were not written (nor cleared by hal_pwm_open_all):
 *                  the control interrupt is late, hangs or is no longer triggered; the values act in the first of the
 *                  two periods again and not in the second
 *   STO            a line of safe torque off is not energised
 *
 * All are latched. */
#define HAL_PWM_BREAK_OVER_CURRENT 1u
#define HAL_PWM_BREAK_NOT_RENEWED 2u
#define HAL_PWM_BREAK_STO_1 4u
#define HAL_PWM_BREAK_STO_2 8u

/* Latched causes, HAL_PWM_BREAK_*; 0: none. [control interrupt] */
uint32_t hal_pwm_break(const hal_t *hal);

/* Clears the causes that have gone; without a cause left, compare values act again. The caller has called
 * hal_pwm_open_all before. [control interrupt] */
void hal_pwm_clear_break(hal_t *hal);

#endif
