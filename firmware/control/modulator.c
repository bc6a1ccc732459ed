#include "control/modulator.h"

#include "fixed/compiler.h"

static void set_phase(hal_pwm_compare_t *compare, unsigned phase, int32_t duty_q15, int32_t period_ticks) {
    /* Magnitude at most the period: 2^15 * 2^15 before the shift. */
    const int32_t ticks = (duty_q15 * period_ticks + MODULATOR_DUTY_ONE_Q15 / 2) >> 15;
    const int32_t upper = ticks > 0 ? ticks : 0;
    compare->upper[phase] = (uint16_t)upper;
    compare->lower[phase] = (uint16_t)(period_ticks + ticks - upper);
}

static void set_phase_interleaved(hal_pwm_compare_t *compare, unsigned phase, int32_t duty_q15, int32_t period_ticks) {
    /* On-time of both switches, at most two periods: 2^16 * 2^15 before the shift. */
    const uint32_t product_q15 = (uint32_t)(MODULATOR_DUTY_ONE_Q15 + duty_q15) * (uint32_t)period_ticks;
    const uint32_t both = (product_q15 + MODULATOR_DUTY_ONE_Q15 / 2) >> 15;
    compare->upper[phase] = (uint16_t)(both / 2);
    compare->lower[phase] = (uint16_t)(both - both / 2);
}

void modulate(const int32_t duty_q15[], unsigned phases, uint16_t period_ticks, bool interleaved,
              hal_pwm_compare_t *compare) {
    if (interleaved) {
        UNROLL(4)
        for (unsigned phase = 0; phase < phases; phase++) {
            set_phase_interleaved(compare, phase, duty_q15[phase], period_ticks);
        }
    } else {
        UNROLL(4)
        for (unsigned phase = 0; phase < phases; phase++) {
            set_phase(compare, phase, duty_q15[phase], period_ticks);
        }
    }
}
