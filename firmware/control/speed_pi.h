/* Speed control of the traditional drive: proportional and integral, with anti-windup.
 *
 *   T = kp e + ki integral(e dt)
 */
#ifndef CONTROL_SPEED_PI_H
#define CONTROL_SPEED_PI_H

#include <stdint.h>

typedef struct {
    int32_t kp_q16;         /* N m s/rad, Q15.16, 0..1000 */
    int32_t ki_step_q32;    /* ki * sampling period, N m/rad * s, Q-1.32, >= 0 */
    int32_t torque_min_q24; /* N m, Q7.24 */
    int32_t torque_max_q24; /* N m, Q7.24, above torque_min; both within +-127 N m */
} speed_pi_parameters_t;

typedef struct {
    int64_t integral_q54; /* N m; held within the torque limits */
} speed_pi_t;

/* Starts from zero. */
void speed_pi_reset(speed_pi_t *pi);

/* One sample: torque reference in N m, Q7.24, within the limits, from the speed error in rad/s, Q9.22, any value.
 * Anti-windup: while the sum is at a limit, errors that push further are not integrated, and the integral itself stays
 * within the limits. Products in 64 bits: e * kp at most 2^31 * 2^26, e * ki at most 2^62.
 * Proportional part and integral are rounded down. */
int32_t speed_pi_step(const speed_pi_parameters_t *parameters, speed_pi_t *pi, int32_t speed_error_q22);

#endif
