/* Position mode: the position loop in front of the speed loop. */
#ifndef INTERRUPTS_POSITION_CONTROL_H
#define INTERRUPTS_POSITION_CONTROL_H

#include "interrupts/control_step.h"

/* The speed and torque results of this step: in position mode the speed law's with the reference of the position
 * loop, whose torque is added; otherwise speed_control_deferred(). Speed mode alone ramps
 * the speed reference; a controller of one quadrant holds a reference of 0. [deferred interrupt] */
void position_control_deferred(const control_parameters_t *parameters, control_state_t *state,
                               const deferred_input_t *input, const command_t *command, deferred_results_t *results);

/* Follows the position in the other modes: at least once in half a revolution. [deferred interrupt] */
void position_control_follow(control_state_t *state, const deferred_input_t *input);

#endif
