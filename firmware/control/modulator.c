#include "control/modulator.h"

#define DUTY_ONE_Q15 32768

void pwm_set_phase(hal_pwm_compare_t *compare, unsigned phase, int32_t duty_q15, uint16_t period_ticks) {
    /* Within +-period: 2^15 * 2^15. */
    const int32_t ticks = (duty_q15 * period_ticks + DUTY_ONE_Q15 / 2) >> 15;
    const int32_t below = ticks >> 31; /* -1 or 0 */
    compare->upper[phase] = (uint16_t)(ticks & ~below);
    compare->lower[phase] = (uint16_t)(period_ticks + (ticks & below));
}

void pwm_set_phase_twice(hal_pwm_compare_t *compare, unsigned phase, int32_t duty_q15, uint16_t period_ticks) {
    /* At most two periods: 2^16 * 2^15. */
    const uint32_t both = ((uint32_t)(DUTY_ONE_Q15 + duty_q15) * period_ticks + DUTY_ONE_Q15 / 2) >> 15;
    compare->upper[phase] = (uint16_t)(both / 2);
    compare->lower[phase] = (uint16_t)(both - both / 2);
}

void pwm_set_state(hal_pwm_compare_t *compare, unsigned phase, int state, uint16_t period_ticks) {
    /* Without a branch: (state + 1) / 2 is 1 for +1 only. */
    const uint32_t upper = period_ticks & (0u - ((uint32_t)(state + 1) >> 1));
    const uint32_t lower = period_ticks & ~(uint32_t)(state >> 31);
    compare->upper[phase] = (uint16_t)upper;
    compare->lower[phase] = (uint16_t)lower;
}
