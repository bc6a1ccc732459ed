/* Sliding-mode speed control: torque reference from speed error, estimated load torque and friction.
 *
 * Sliding variable s = x = speed reference - speed, (6) of the paper. Control law, (11) of the paper:
 *
 *   T = J H(x) sgn(s) + T_L + B w
 *
 * with the load torque T_L and the speed w from the load observer. Reaching law: (10) of the paper is misprinted and
 * never moves the motor (H stays below 0.23 rad/s^2). Its source is X. Zhang, L. Sun, K. Zhao, L. Sun, "Nonlinear speed
 * control for PMSM system using sliding-mode control and disturbance compensation techniques", IEEE Trans. Power
 * Electron. 28(3), 2013, used here:
 *
 *   H = k / (eps + (1 - eps + 1/|x|) e^(-delta |s|)) = k |x| / (eps |x| + ((1 - eps) |x| + 1) e^(-delta |x|))
 *
 * The right-hand form needs no division by |x|. Far from the sliding surface H tends to k / eps, near it to k |x|.
 *
 * Lyapunov function V = s^2 / 2: with T_L and w known, ds/dt = -H sgn(s), so dV/dt = -|s| H < 0 for s != 0.
 */
#ifndef CONTROL_SPEED_SMC_H
#define CONTROL_SPEED_SMC_H

#include <stdint.h>

#define SPEED_SMC_EPSILON_MIN_Q31 (1 << 16) /* 2^-15 */

typedef struct {
    int32_t gain_q24;     /* J k, N m s/rad, Q7.24, > 0 */
    int32_t epsilon_q31;  /* eps, Q0.31, 2^-15..1 - 2^-31; eps = 1 is stored as 1 - 2^-31 */
    int32_t delta_q27;    /* delta / ln 2, s/rad, Q4.27; delta 0..10 */
    int32_t friction_q30; /* B, N m s, Q1.30, >= 0 */
} speed_smc_parameters_t;

/* J H(x) sgn(x) in N m, Q7.24, for x in rad/s, Q9.22, the whole range; saturates at +-INT32_MAX. Exactly odd in x.
 * Error: 1e-4 of the value (table of the exponential, 16-bit mantissa and reciprocal of the denominator), two LSBs of
 * the gain and 2^-20 N m. Accumulator: 64 bits, unsigned. Rounded towards zero. */
int32_t speed_smc_reaching_torque_q24(const speed_smc_parameters_t *parameters, int32_t x_q22);

/* Torque reference in N m, Q7.24, within the limits: reaching torque, load torque (N m, Q7.24) and friction at a
 * speed in rad/s, Q9.22, any values. Sums saturate; the friction torque is rounded down, within 16 LSB of saturation
 * when it saturates. */
int32_t speed_smc_torque_q24(const speed_smc_parameters_t *parameters, int32_t reaching_q24, int32_t speed_q22,
                             int32_t load_torque_q24, int32_t torque_min_q24, int32_t torque_max_q24);

#endif
