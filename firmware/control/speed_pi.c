#include "control/speed_pi.h"

#include "fixed/fixed.h"

/* Q54 to Q24, rounded down. */
static inline int32_t integral_torque_q24(int64_t integral_q54) {
    return fixed_shift_saturate(integral_q54, 30);
}

void speed_pi_reset(speed_pi_t *pi) {
    pi->integral_q54 = 0;
}

void speed_pi_follow(speed_pi_t *pi, int32_t torque_q24) {
    pi->integral_q54 = fixed_product(torque_q24, 1 << 30);
}

int32_t speed_pi_step(const speed_pi_parameters_t *parameters, speed_pi_t *pi, int32_t speed_error_q22) {
    const int32_t min_q24 = parameters->torque_min_q24;
    const int32_t max_q24 = parameters->torque_max_q24;
    const int32_t proportional_q24 = fixed_product_shift_saturate(speed_error_q22, parameters->kp_q16, 14);
    const int32_t sum_q24 = fixed_add(proportional_q24, integral_torque_q24(pi->integral_q54));
    int32_t torque_q24 = sum_q24;
    if (sum_q24 > max_q24) {
        torque_q24 = max_q24;
        if (speed_error_q22 > 0) {
            return torque_q24;
        }
    } else if (sum_q24 < min_q24) {
        torque_q24 = min_q24;
        if (speed_error_q22 < 0) {
            return torque_q24;
        }
    }
    /* |integral| <= 2^61 (clamped to the limits), |step| <= 2^62: the sum fits. */
    int64_t next_q54 = fixed_accumulate(pi->integral_q54, speed_error_q22, parameters->ki_step_q32);
    const int32_t next_q24 = integral_torque_q24(next_q54);
    if (next_q24 >= max_q24) {
        next_q54 = fixed_product(max_q24, 1 << 30);
    } else if (next_q24 < min_q24) {
        next_q54 = fixed_product(min_q24, 1 << 30);
    }
    pi->integral_q54 = next_q54;
    return torque_q24;
}
