/* Speed control step of the control interrupt: torque reference from the commanded speed. */
#ifndef DRIVE_SPEED_CONTROL_H
#define DRIVE_SPEED_CONTROL_H

#include "drive/control.h"

/* Resets the speed controller for the next run. */
void speed_control_reset(control_state_t *state);

/* Moves the speed reference towards the commanded speed, zero for every request other than run, by at most the ramp,
 * and sets the torque reference by the configured law. */
void speed_control(const control_parameters_t *parameters, control_state_t *state, const control_sample_t *sample,
                   const command_t *command);

#endif
