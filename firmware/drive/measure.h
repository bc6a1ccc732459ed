/* Measurement step of the control interrupt: from counts to physical quantities. */
#ifndef DRIVE_MEASURE_H
#define DRIVE_MEASURE_H

#include "control/commutation.h"
#include "drive/control.h"

/* Converts a sample. The angle of an encoder edge is extrapolated at the observer's speed; torque and flux linkage are
 * those of the machine's tables at the angle of each phase, corrected by its misalignment (2^-32 electrical rev), with
 * predictive torque control at the planned one. Currents and voltage are rounded to nearest; a count of 0 is exactly 0
 * A. */
void measure(const control_parameters_t *parameters, const load_observer_t *observer,
             const deferred_results_t *deferred, const predictive_torque_t *predictive, const control_sample_t *sample,
             control_measurement_t *measured);

#endif
