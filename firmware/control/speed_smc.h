/* Sliding-mode speed control.
 *
 * Sliding variable s = x = speed reference - speed, (6) of the paper. Control law, (11):
 *
 *   T = J H(x) sgn(s) + T_L + B w
 *
 * with the load torque T_L and the speed w from the load observer. Reaching law: the paper's (10) is misprinted and
 * never moves the motor (H stays below 0.23 rad/s^2); it stems from Zhang, Sun, Zhao, Sun, IEEE Trans. Power Electron.
 * 28(3), 2013, used here with a gain k:
 *
 *   H = k / (eps + (1 - eps + 1/|x|) e^(-delta |s|)) = k |x| / (eps |x| + ((1 - eps) |x| + 1) e^(-delta |x|))
 *
 * The right-hand form needs no division by |x|. Far from the surface H tends to k / eps, near it to k |x|.
 */
#ifndef CONTROL_SPEED_SMC_H
#define CONTROL_SPEED_SMC_H

#include <stdint.h>

typedef struct {
    int32_t gain_q24;       /* J k, N m s/rad, Q7.24, > 0 */
    int32_t epsilon_q31;    /* eps, Q1.31, from 2^-15; 1 is the largest below it */
    int32_t delta_q27;      /* delta / ln 2, octaves s/rad, Q4.27; delta 0..10 */
    int32_t friction_q30;   /* B, N m s, Q1.30, >= 0 */
    int32_t torque_min_q24; /* N m, Q7.24 */
    int32_t torque_max_q24; /* N m, Q7.24 */
} speed_smc_parameters_t;

/* J H(x) sgn(x) in N m, Q7.24, for x in rad/s, Q9.22, the whole range; saturates. Odd to the bit. Relative error below
 * 1e-4 (the exponential's table, a denominator of 16 bits and its reciprocal), two LSBs of the gain, and 2^-20 N m. */
int32_t speed_smc_reaching_torque_q24(const speed_smc_parameters_t *parameters, int32_t x_q22);

/* Torque reference in N m, Q7.24, within the limits. Speed and reference in rad/s, Q9.22; load torque in N m, Q7.24. */
int32_t speed_smc_step(const speed_smc_parameters_t *parameters, int32_t speed_reference_q22, int32_t speed_q22,
                       int32_t load_torque_q24);

#endif
