/* Speed control of the traditional controller with another anti-windup: back-calculation.
 *
 *   T = limited(kp e + I),   dI/dt = ki e + (T - (kp e + I)) / T_t,   T_t = 256 samples
 *
 * At a limit the integral follows the torque instead of being held (K. J. Astrom, L. Rundqwist, "Integrator Windup and
 * How to Avoid It", American Control Conference, 1989). Formats and limits: control/speed_pi.h. */
#include "control/speed_pi.h"

#include "fixed/fixed.h"

enum { TRACKING_SHIFT = 8, Q54_TO_Q24 = 30 };

void speed_pi_reset(speed_pi_t *pi) {
    pi->integral_q54 = 0;
}

void speed_pi_follow(speed_pi_t *pi, int32_t torque_q24) {
    pi->integral_q54 = fixed_product(torque_q24, 1 << Q54_TO_Q24);
}

int32_t speed_pi_step(const speed_pi_parameters_t *parameters, speed_pi_t *pi, int32_t speed_error_q22) {
    const int32_t proportional_q24 = fixed_product_shift_saturate(speed_error_q22, parameters->kp_q16, 14);
    const int32_t sum_q24 = fixed_add(proportional_q24, fixed_shift_saturate(pi->integral_q54, Q54_TO_Q24));
    int32_t torque_q24 = sum_q24;
    if (torque_q24 > parameters->torque_max_q24) {
        torque_q24 = parameters->torque_max_q24;
    } else if (torque_q24 < parameters->torque_min_q24) {
        torque_q24 = parameters->torque_min_q24;
    }
    /* The excess is at most 2^32, its part of the integral 2^54; the integral stays within the range of Q9.54. */
    const int64_t excess_q54 = ((int64_t)torque_q24 - sum_q24) * (1 << (Q54_TO_Q24 - TRACKING_SHIFT));
    pi->integral_q54 = fixed_accumulate(pi->integral_q54 + excess_q54, speed_error_q22, parameters->ki_step_q32);
    return torque_q24;
}
