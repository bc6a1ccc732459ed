#include "control/speed_smc.h"

#include "fixed/exponential.h"
#include "fixed/fixed.h"

#define ONE_Q22 (1 << 22)
#define ONE_Q15 (1 << 15)

int32_t speed_smc_reaching_torque_q24(const speed_smc_parameters_t *parameters, int32_t x_q22) {
    const int64_t x = fixed_abs(x_q22);
    /* delta |x|: Q22 * Q12 = Q34, to unsigned Q16.16; 512 * 10 = 5120 fits. */
    const uint32_t exponent_q16 = (uint32_t)((x * parameters->delta_q12) >> 18);
    const int64_t decay_q31 = exponential_negative_q31(exponent_q16);

    const int64_t far_q22 = (x * parameters->epsilon_q15) >> 15;
    const int64_t near_q22 = ((x * (ONE_Q15 - parameters->epsilon_q15)) >> 15) + ONE_Q22;
    /* near < 2^32, decay <= 2^31: below 2^63. */
    const int64_t denominator_q22 = far_q22 + ((near_q22 * decay_q31) >> 31);

    /* gain < 2^31, |x| < 2^31: below 2^62. The denominator is zero only for x = 0 with no exponent: never, near >= 1.
     */
    const int64_t torque_q24 = (parameters->gain_q24 * x) / (denominator_q22 > 0 ? denominator_q22 : 1);
    const int32_t magnitude_q24 = fixed_saturate(torque_q24);
    return x_q22 < 0 ? -magnitude_q24 : magnitude_q24;
}

int32_t speed_smc_step(const speed_smc_parameters_t *parameters, int32_t speed_reference_q22, int32_t speed_q22,
                       int32_t load_torque_q24) {
    const int32_t error_q22 = fixed_subtract(speed_reference_q22, speed_q22);
    const int32_t reaching_q24 = speed_smc_reaching_torque_q24(parameters, error_q22);
    const int32_t friction_q24 = fixed_multiply(speed_q22, parameters->friction_q30, 28);
    const int32_t torque_q24 = fixed_add(fixed_add(reaching_q24, load_torque_q24), friction_q24);
    return fixed_clamp(torque_q24, parameters->torque_min_q24, parameters->torque_max_q24);
}
