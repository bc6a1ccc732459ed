/* Speed control of the traditional controller: proportional-integral with anti-windup.
 *
 *   T = kp e + ki integral(e dt),   e = speed reference - speed
 *
 * Textbook PI in forward-Euler form; anti-windup by conditional integration (K. J. Astrom, T. Hagglund, "PID
 * Controllers: Theory, Design, and Tuning", 2nd ed., ISA, 1995).
 */
#ifndef CONTROL_SPEED_PI_H
#define CONTROL_SPEED_PI_H

#include <stdint.h>

typedef struct {
    int32_t kp_q16;         /* N m s/rad, Q15.16, 0..1000 */
    int32_t ki_step_q32;    /* ki Ts, N m s/rad, Q-1.32, >= 0 */
    int32_t torque_min_q24; /* N m, Q7.24 */
    int32_t torque_max_q24; /* N m, Q7.24, above torque_min; both within +-127 N m */
} speed_pi_parameters_t;

typedef struct {
    int64_t integral_q54; /* N m, Q9.54; clamped to the torque limits */
} speed_pi_t;

/* Integral 0. */
void speed_pi_reset(speed_pi_t *pi);

/* Integral so that the next torque, without a speed error, is another law's: N m, Q7.24, within the limits. */
void speed_pi_follow(speed_pi_t *pi, int32_t torque_q24);

/* One sample: torque reference in N m, Q7.24, clamped to the limits, from the speed error in rad/s, Q9.22, any value.
 * Anti-windup: while the sum is at a limit, an error that drives it further is not integrated, and the integral is
 * clamped to the limits. 64-bit products: e kp at most 2^57, e ki Ts at most 2^62; 64-bit accumulator for the integral.
 * Proportional part and integral are rounded down to Q24; their sum saturates. */
int32_t speed_pi_step(const speed_pi_parameters_t *parameters, speed_pi_t *pi, int32_t speed_error_q22);

#endif
