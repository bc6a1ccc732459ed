/* Torque control step of the control interrupt: duties from the torque reference. */
#ifndef INTERRUPTS_TORQUE_CONTROL_H
#define INTERRUPTS_TORQUE_CONTROL_H

#include <stdbool.h>

#include "interrupts/control_step.h"

/* Resets the torque controllers for the next run. */
void torque_control_reset(const control_parameters_t *parameters, control_state_t *state);

/* Sets the duties of all phases by the configured law. The observer has predicted the coming sample before. */
void torque_control(const control_parameters_t *parameters, control_state_t *state, const deferred_results_t *deferred);

/* Limit of the currents of hysteresis control at a speed, rad/s, Q9.22; its results are for the next period:
 * 10 of the computed bound of traditional. [deferred interrupt] */
ditc_hysteresis_limit_t torque_control_limit(const control_parameters_t *parameters, int32_t speed_q22);

/* True when the last period in RUN was limited by the DC-link voltage. [background] */
bool torque_control_voltage_saturated(const control_parameters_t *parameters, const control_state_t *state);

#endif
