#include "control/shaft_torque.h"

#include "fixed/compiler.h"
#include "fixed/divide.h"
#include "fixed/fixed.h"

#define ONE_Q30 (1 << 30)
#define TOLERANCE_Q30 (ONE_Q30 / 80)
#define GAIN_MAX_Q30 (ONE_Q30 / 12)
#define SCALED_BITS 30

/* Sums of windows whose variance is the least that counts, from which on the factor is used, and of which the older
 * half is forgotten. */
#define WINDOWS_MIN 64
#define WINDOWS_MAX 1024

static int32_t factor_q30(const shaft_torque_t *shaft, int32_t scale_q30) {
    const unsigned shift = fixed_shift_below((uint64_t)shaft->variance, SCALED_BITS);
    const int32_t by_energy = (int32_t)((shaft->variance >> shift) * scale_q30 >> 30);
    const int64_t excess =
        fixed_clamp_64((shaft->covariance >> shift) - by_energy, -(INT64_C(1) << 32), INT64_C(1) << 32);
    const int32_t excess_q30 = fixed_saturate(fixed_divide(excess * (1 << 30), by_energy + 1));
    const int32_t beyond_q30 = excess_q30 - fixed_clamp(excess_q30, -TOLERANCE_Q30, TOLERANCE_Q30);
    return fixed_abs(excess_q30) > GAIN_MAX_Q30 ? ONE_Q30 : ONE_Q30 + beyond_q30;
}

COLD void shaft_torque_step(const inertia_parameters_t *parameters, shaft_torque_t *shaft,
                            const shaft_torque_sample_t *sample) {
    if (sample->window == shaft->window) {
        return;
    }
    shaft->window = sample->window;
    const int32_t variance = sample->torque_variance_q14;
    const int32_t covariance = sample->covariance_q14;
    const int64_t product = fixed_product(variance, sample->acceleration_variance_q14);
    if (sample->counts && variance >= parameters->variance_min_q14 && covariance > 0 &&
        fixed_product(covariance, covariance) > product - (product >> 4)) {
        const int64_t in_effect_q30 = sample->in_effect_q30;
        shaft->covariance += fixed_divide((int64_t)covariance << 30, in_effect_q30);
        shaft->variance += fixed_divide(fixed_divide((int64_t)variance << 30, in_effect_q30) << 30, in_effect_q30);
        if (shaft->variance > (int64_t)parameters->variance_min_q14 * WINDOWS_MAX) {
            shaft->variance /= 2;
            shaft->covariance /= 2;
        }
    }
    shaft->factor_q30 = shaft->variance > (int64_t)parameters->variance_min_q14 * WINDOWS_MIN
                            ? factor_q30(shaft, sample->scale_q30)
                            : ONE_Q30;
}
