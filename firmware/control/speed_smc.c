#include "control/speed_smc.h"

#include "fixed/exponential.h"
#include "fixed/fixed.h"

#define ONE_Q22 (1u << 22)

int32_t speed_smc_reaching_torque_q24(const speed_smc_parameters_t *parameters, int32_t x_q22) {
    const uint32_t x = (uint32_t)fixed_abs(x_q22);
    /* delta |x| in octaves: Q22 * Q27. */
    const uint32_t octaves_q17 = (uint32_t)(((uint64_t)x * (uint32_t)parameters->delta_q27) >> 32);
    const uint32_t decay_q31 = exponential_octaves_q31(octaves_q17);
    /* eps |x| + ((1 - eps) |x| + 1) decay, which is below 2^62 + 2^53: |x| + 1, where nothing decays. */
    const int32_t rest_q31 = (int32_t)((1u << 31) - (uint32_t)parameters->epsilon_q31);
    const uint32_t near_q22 = 2u * (uint32_t)fixed_multiply_high((int32_t)x, rest_q31) + ONE_Q22;
    const uint64_t denominator_q53 = (uint64_t)x * (uint32_t)parameters->epsilon_q31 + (uint64_t)near_q22 * decay_q31;

    /* Its first 16 bits, rounded, and their reciprocal: a division of 32 bits. The first bit is within the high word,
     * because the smallest there is, for eps = 2^-15 and delta = 10, is 2^-15.5; and not its very first one. */
    const int shift = __builtin_clz((uint32_t)(denominator_q53 >> 32));
    const uint32_t first = (uint32_t)(denominator_q53 >> (32 - shift));
    const uint32_t reciprocal = UINT32_MAX / (((first >> 15) + 1) >> 1); /* at most 2^17 */
    const uint32_t gain = (uint32_t)(((uint64_t)(uint32_t)parameters->gain_q24 * reciprocal) >> 17);

    /* Below 2^62. */
    const uint64_t product = (uint64_t)gain * x;
    const uint64_t torque_q24 = product >> (32 - shift);
    const int32_t magnitude_q24 = torque_q24 > INT32_MAX ? INT32_MAX : (int32_t)torque_q24;
    return x_q22 < 0 ? -magnitude_q24 : magnitude_q24;
}

int32_t speed_smc_step(const speed_smc_parameters_t *parameters, int32_t speed_reference_q22, int32_t speed_q22,
                       int32_t load_torque_q24) {
    const int32_t error_q22 = fixed_subtract(speed_reference_q22, speed_q22);
    const int32_t reaching_q24 = speed_smc_reaching_torque_q24(parameters, error_q22);
    const int32_t friction_q24 = fixed_narrow(fixed_product(speed_q22, parameters->friction_q30), 28);
    const int32_t torque_q24 = fixed_add(fixed_add(reaching_q24, load_torque_q24), friction_q24);
    return fixed_clamp(torque_q24, parameters->torque_min_q24, parameters->torque_max_q24);
}
