/* Speed control: torque reference from the commanded speed. The law is computed by the deferred step and acts one period
 * later; the feed-forward of the estimated load, which decides the speed drop after a load step, in the control
 * interrupt. */
#ifndef DRIVE_SPEED_CONTROL_H
#define DRIVE_SPEED_CONTROL_H

#include "drive/control.h"

/* Moves the speed reference by at most the ramp towards the commanded speed, from the present speed at the start of a
 * run, and returns the torque of the configured law without feed-forward, N m, Q7.24. [deferred] */
int32_t speed_control_law_q24(const control_parameters_t *parameters, deferred_t *deferred,
                              const deferred_input_t *input);

/* Torque reference: that of the law, and with sliding mode the feed-forward of load and friction, limited. [interrupt]
 */
int32_t speed_control_torque_q24(const control_parameters_t *parameters, const load_observer_t *observer,
                                 const control_sample_t *sample, int32_t law_torque_q24);

#endif
