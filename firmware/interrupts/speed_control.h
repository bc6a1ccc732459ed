/* Torque reference from the commanded speed, or in torque mode from the commanded torque. The laws are computed by the
 * deferred step and act one period later; the feed-forward of the estimated load, which decides the speed drop after a
 * load step, in the control interrupt. The limits that the deferred step sets keep the feed-forward out of torque mode:
 * both of them are the torque reference then. */
#ifndef INTERRUPTS_SPEED_CONTROL_H
#define INTERRUPTS_SPEED_CONTROL_H

#include "interrupts/control_step.h"

/* Commanded speed within the range of the drive, rad/s, Q9.22: the highest speed of the machine, 7/8 of over_speed_rpm
 * where that is less, so that an overshoot has room, and 0 for a negative one with a single-quadrant controller.
 * [deferred interrupt, background] */
int32_t speed_control_limited_q22(const control_parameters_t *parameters, int32_t commanded_q22);

/* Computes law torque, limits of the torque reference and speed reference of the results, and the mode.
 *
 * Speed mode: moves the speed reference by at most the ramp towards the commanded speed, from the present speed at the
 * start of a run, or 0 without a run request; the torque is the configured law's without feed-forward. Torque
 * mode: torque_mode.h. It begins with the present torque; after it the speed reference begins with the present speed,
 * and the integral of the PI with the present torque. limit_q24: of the torque's magnitude, N m, Q7.24, >= 0; what the
 * interrupt adds is within it too. [deferred interrupt] */
void speed_control_deferred(const control_parameters_t *parameters, deferred_t *deferred, const deferred_input_t *input,
                            const command_t *command, int32_t limit_q24, deferred_results_t *results);

/* The same for the reference of a position loop, which is deferred->speed_reference_q22. [deferred interrupt] */
void speed_control_position(const control_parameters_t *parameters, deferred_t *deferred, const deferred_input_t *input,
                            const command_t *command, int32_t limit_q24, deferred_results_t *results);

/* While counts are slow, a speed above the reference may be one of the estimate alone. A load against the reference
 * brakes by itself: the more of it, the less braking torque, none from a sixteenth of the largest torque on. A load
 * that drives limits nothing. load_q24: estimated load torque, N m, Q7.24. For limits of speed mode.
 * [deferred interrupt] */
void speed_control_limit_uncertain(const control_parameters_t *parameters, int32_t load_q24,
                                   deferred_speed_results_t *results);

/* Torque reference: the law's, and with sliding mode the feed-forward of load and friction, limited.
 * [control interrupt] */
int32_t speed_control_torque_q24(const control_parameters_t *parameters, const load_observer_t *observer,
                                 const control_sample_t *sample, const deferred_results_t *deferred);

#endif
