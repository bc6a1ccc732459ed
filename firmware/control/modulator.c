#include "control/modulator.h"

#include "fixed/compiler.h"
#include "fixed/fixed.h"

void modulate(const int32_t duty_q15[], unsigned phases, uint16_t period_ticks, bool interleaved,
              hal_pwm_compare_t *compare) {
    const int32_t rounding = MODULATOR_DUTY_ONE_Q15 / 2;
    /* The upper switch is on for what exceeds the period, or for half of the time. */
    const int32_t lower_alone = interleaved ? 0 : period_ticks;
    const unsigned halving = interleaved;
    UNROLL(4)
    for (unsigned phase = 0; phase < phases; phase++) {
        /* On-time of both switches together, 1 + duty, at most two periods: 2^16 * (2^15 - 1) before the shift. */
        const int32_t both =
            (duty_q15[phase] * period_ticks + (MODULATOR_DUTY_ONE_Q15 * period_ticks + rounding)) >> 15;
        const int32_t beyond = both - lower_alone;
        const int32_t upper = fixed_max(beyond, 0) >> halving;
        int32_t lower = both - upper;
        IN_REGISTER(lower); /* a difference of 32 bits, of which 16 are stored */
        compare->upper[phase] = (uint16_t)upper;
        compare->lower[phase] = (uint16_t)lower;
    }
}
