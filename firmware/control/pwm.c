#include "control/pwm.h"

#include "fixed/fixed.h"

#define DUTY_ONE_Q15 32768

void pwm_set_phase(hal_pwm_compare_t *compare, unsigned phase, int32_t duty_q15, uint16_t period_ticks) {
    const int32_t duty = fixed_clamp(duty_q15, -DUTY_ONE_Q15, DUTY_ONE_Q15);
    const int32_t share_q15 = duty >= 0 ? duty : DUTY_ONE_Q15 + duty;
    const uint16_t ticks = (uint16_t)fixed_shift((int64_t)share_q15 * period_ticks, 15);
    compare->upper[phase] = duty >= 0 ? ticks : 0;
    compare->lower[phase] = duty >= 0 ? period_ticks : ticks;
}

void pwm_set_phase_twice(hal_pwm_compare_t *compare, unsigned phase, int32_t duty_q15, uint16_t period_ticks) {
    const int32_t duty = fixed_clamp(duty_q15, -DUTY_ONE_Q15, DUTY_ONE_Q15);
    const uint16_t both = (uint16_t)fixed_shift((int64_t)(DUTY_ONE_Q15 + duty) * period_ticks, 15);
    compare->upper[phase] = both / 2;
    compare->lower[phase] = (uint16_t)(both - both / 2);
}

void pwm_set_state(hal_pwm_compare_t *compare, unsigned phase, int state, uint16_t period_ticks) {
    /* By the signs: without a branch. */
    const uint32_t upper = period_ticks & (uint32_t)(-state >> 31);
    const uint32_t lower = period_ticks & ~(uint32_t)(state >> 31);
    compare->upper[phase] = (uint16_t)upper;
    compare->lower[phase] = (uint16_t)lower;
}
