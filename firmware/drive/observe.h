/* Observation step of the control interrupt: rotor angle, speed and load torque. */
#ifndef DRIVE_OBSERVE_H
#define DRIVE_OBSERVE_H

#include "drive/control.h"

/* Corrects the observer with a measurement and predicts the coming sample, with the periodic load of the deferred step;
 * the bandwidth follows the innovation. */
void observe(const control_parameters_t *parameters, control_state_t *state, const deferred_results_t *deferred,
             const control_measurement_t *measured);

/* Restarts the observer at the measured angle, at standstill, with its maximum bandwidth. */
void observe_reset(control_state_t *state, const control_measurement_t *measured);

/* True when the observer follows the encoder: within 1/32 rev at the last sample. */
bool observe_follows(const control_state_t *state);

/* As observe_reset(), but angle and speed are kept. */
void observe_forget_load(control_state_t *state);

#endif
