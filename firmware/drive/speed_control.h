/* Speed control step of the control interrupt: torque reference from the commanded speed. */
#ifndef DRIVE_SPEED_CONTROL_H
#define DRIVE_SPEED_CONTROL_H

#include "drive/control.h"

/* Moves the speed reference towards the commanded speed, zero for every request other than run, by at most the ramp,
 * and sets the torque reference: the torque of the speed law, which the deferred step has computed (N m, Q7.24), and
 * with sliding mode the feed-forward of load and friction. */
void speed_control(const control_parameters_t *parameters, control_state_t *state, const control_sample_t *sample,
                   const command_t *command, int32_t law_torque_q24);

#endif
