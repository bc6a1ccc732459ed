#include "control/speed_smc.h"

#include <stdbool.h>

#include "fixed/exp2.h"
#include "fixed/fixed.h"
#include "fixed/formats.h"

/*   J H(x) sgn(x) = J k x / D,   D = eps |x| + ((1 - eps) |x| + 1) 2^-y,   y = delta |x| / ln 2
 *   1 / D by a 16-bit mantissa of D and the reciprocal of the mantissa, a 32-bit division */
int32_t speed_smc_reaching_torque_q24(const speed_smc_parameters_t *parameters, int32_t x_q22) {
    const uint32_t magnitude_q22 = (uint32_t)fixed_abs(x_q22);
    /* y: Q22 * Q27 to Q17. */
    const uint32_t exponent_q17 = (uint32_t)(((uint64_t)magnitude_q22 * (uint32_t)parameters->delta_q27) >> 32);
    const uint32_t decay_q31 = exp2_negative_q31(exponent_q17);
    const int32_t one_minus_epsilon_q31 = (int32_t)((1u << 31) - (uint32_t)parameters->epsilon_q31);
    const uint32_t bracket_q22 =
        2u * (uint32_t)fixed_multiply_high((int32_t)magnitude_q22, one_minus_epsilon_q31) + ONE_Q22;
    /* D is at most |x| + 1, without decay: below 2^62 + 2^53. */
    const uint64_t denominator_q53 =
        (uint64_t)magnitude_q22 * (uint32_t)parameters->epsilon_q31 + (uint64_t)bracket_q22 * decay_q31;

    /* The leading one of D is in the high word: the minimum of D, for eps = 2^-15 and delta = 10, is 2^-15.5. It is not
     * bit 63, so the shift is at least 1. Shifted by words, which takes half the instructions. */
    const uint32_t denominator_high = (uint32_t)(denominator_q53 >> 32);
    const int shift = __builtin_clz(denominator_high);
    const uint32_t normalised = denominator_high << shift | (uint32_t)denominator_q53 >> (32 - shift);
    const uint32_t mantissa16 = ((normalised >> 15) + 1) >> 1; /* rounded, 2^15..2^16 */
    const uint32_t reciprocal = UINT32_MAX / mantissa16;       /* at most 2^17 */
    const uint32_t scaled_gain = (uint32_t)(((uint64_t)(uint32_t)parameters->gain_q24 * reciprocal) >> 17);

    const uint64_t product = (uint64_t)scaled_gain * magnitude_q22; /* below 2^62 */
    const uint32_t product_high = (uint32_t)(product >> 32);
    const uint32_t torque_q24 = product_high << shift | (uint32_t)product >> (32 - shift);
    const bool fits = product_high >> (31 - shift) == 0; /* the bits above, and the sign bit */
    const int32_t saturated_q24 = fits ? (int32_t)torque_q24 : INT32_MAX;
    const int32_t sign = x_q22 >> 31; /* -1 or 0: -t is ~t + 1 */
    return (saturated_q24 ^ sign) - sign;
}

int32_t speed_smc_torque_q24(const speed_smc_parameters_t *parameters, int32_t reaching_q24, int32_t speed_q22,
                             int32_t load_torque_q24, int32_t torque_min_q24, int32_t torque_max_q24) {
    const int32_t friction_q24 = fixed_product_shift_saturate(speed_q22, parameters->friction_q30, 28);
    const int32_t torque_q24 = fixed_add(fixed_add(reaching_q24, load_torque_q24), friction_q24);
    return fixed_clamp(torque_q24, torque_min_q24, torque_max_q24);
}
