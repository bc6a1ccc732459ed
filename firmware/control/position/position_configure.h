/* Parameters of the position loop, and limits of a set point. */
#ifndef CONTROL_POSITION_POSITION_CONFIGURE_H
#define CONTROL_POSITION_POSITION_CONFIGURE_H

#include "control/position/position_loop.h"

/* Speeds and what follows from them have the unit of the machine's speeds, 2^speed_exponent. Of a limit of 0 the drive
 * finds one: the largest speed reference, 3/4 of the acceleration that torque_max_q24 gives to the inertia, the
 * acceleration, and the jerk with which the acceleration rises in 5 ms. */
typedef struct {
    uint32_t control_rate_hz;
    unsigned speed_exponent;
    int32_t angle_step_q32;   /* of load_observer_model_t */
    int32_t acceleration_q32; /* likewise */
    int32_t torque_max_q24;
    int32_t speed_max_q22;
    int32_t speed_rpm;
    int32_t acceleration_rpm_s;
    int32_t deceleration_rpm_s;
    int32_t jerk_rpm_s2;
    int32_t gain_1_s;
    int32_t lowest_rev;
    int32_t highest_rev;
    int32_t following_error_q7; /* deg, Q7 */
    int32_t window_q15;         /* deg, Q15 */
    int32_t homing_speed_rpm;
    int32_t homing_torque_q24;
    int32_t cycle_ms;
} position_settings_t;

/* [background] */
position_parameters_t position_configure(const position_settings_t *settings);

/* The set point with its limits, none beyond the parameters'. inertia_ratio_q14: identified inertia by the parameter's;
 * torque_left_q14: torque that the load leaves, of the largest one, any value, limited to 3/32..3/4. [background] */
position_command_t position_command(const position_parameters_t *parameters, const position_set_point_t *set_point,
                                    int32_t inertia_ratio_q14, int32_t torque_left_q14);

#endif
