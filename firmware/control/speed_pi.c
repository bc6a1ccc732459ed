#include "control/speed_pi.h"

#include "fixed/fixed.h"

#define INTEGRAL_TO_TORQUE 30 /* Q54 to Q24 */
#define TORQUE_TO_INTEGRAL ((int64_t)1 << INTEGRAL_TO_TORQUE)

void speed_pi_reset(speed_pi_t *pi) {
    pi->integral_q54 = 0;
}

int32_t speed_pi_step(const speed_pi_parameters_t *parameters, speed_pi_t *pi, int32_t speed_error_q22) {
    const int64_t low = parameters->torque_min_q24 * TORQUE_TO_INTEGRAL;
    const int64_t high = parameters->torque_max_q24 * TORQUE_TO_INTEGRAL;
    const int64_t proportional_q24 = fixed_shift((int64_t)speed_error_q22 * parameters->kp_q16, 14);
    const int64_t sum_q24 = proportional_q24 + fixed_shift(pi->integral_q54, INTEGRAL_TO_TORQUE);
    const int64_t limited_q24 = sum_q24 > parameters->torque_max_q24   ? parameters->torque_max_q24
                                : sum_q24 < parameters->torque_min_q24 ? parameters->torque_min_q24
                                                                       : sum_q24;
    const int pushes_further =
        (sum_q24 > limited_q24 && speed_error_q22 > 0) || (sum_q24 < limited_q24 && speed_error_q22 < 0);
    if (!pushes_further) {
        /* |integral| <= 2^61 (the limits), |step| <= 2^62: the sum fits. */
        const int64_t next = pi->integral_q54 + (int64_t)speed_error_q22 * parameters->ki_step_q32;
        pi->integral_q54 = next > high ? high : next < low ? low : next;
    }
    return (int32_t)limited_q24;
}
