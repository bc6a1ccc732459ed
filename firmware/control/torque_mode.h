/* Torque mode: torque reference from the commanded torque.
 *
 *   T = T_before + clamp(T_commanded - T_before, +-slew rate),   T_commanded within the torque limits
 *
 * Nothing else holds the speed in this mode: torque that drives the shaft faster is reduced linearly with the speed,
 * from the torque limit at 7/8 of the over-speed limit to 0 at 15/16 of it, in either direction. Torque that brakes is
 * not reduced. A shaft that its load drives faster still ends in the fault over_speed.
 */
#ifndef CONTROL_TORQUE_MODE_H
#define CONTROL_TORQUE_MODE_H

#include <stdint.h>

typedef struct {
    int32_t slew_q24;            /* largest change per period, N m, Q7.24, > 0; INT32_MAX: none */
    int32_t torque_min_q24;      /* N m, Q7.24: 0 for a single-quadrant controller */
    int32_t torque_max_q24;      /* N m, Q7.24 */
    int32_t speed_end_q22;       /* no driving torque above, rad/s, Q9.22 */
    int32_t fold_back_range_q22; /* speed range in which it falls from the limit to 0, rad/s, Q9.22 */
    int32_t fold_back_q18;       /* torque limit by this range, N m s/rad, Q13.18, rounded up */
} torque_mode_parameters_t;

typedef struct {
    int32_t torque_q24; /* after slew rate and limits, before the reduction, N m, Q7.24 */
} torque_mode_t;

/* Slew rate in N m/s, Q22.10, 0: none; limits in N m, Q7.24; over-speed limit in rad/s, Q9.22, at least 1 rad/s. */
torque_mode_parameters_t torque_mode_configure(int32_t slew_rate_q10, uint32_t control_rate_hz, int32_t torque_min_q24,
                                               int32_t torque_max_q24, int32_t over_speed_q22);

/* One period: torque reference in N m, Q7.24, from the commanded torque in N m, Q7.24, and the speed in rad/s, Q9.22,
 * any values. Differences saturate; 64-bit product, rounded down. The reduction begins up to 2^-18 N m s/rad times
 * over-speed / 16 late. */
int32_t torque_mode_step(const torque_mode_parameters_t *parameters, torque_mode_t *mode, int32_t commanded_q24,
                         int32_t speed_q22);

#endif
