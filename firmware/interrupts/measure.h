/* Measurement step of the control interrupt: from counts to physical quantities. */
#ifndef INTERRUPTS_MEASURE_H
#define INTERRUPTS_MEASURE_H

#include "control/commutation.h"
#include "interrupts/control_step.h"

/* Converts a sample. The angle of an encoder edge is extrapolated at the observer's speed. Currents and voltage are
 * rounded to nearest; a count of 0 is exactly 0 A. Integrates the applied voltage over the period that now begins. */
void measure(const control_parameters_t *parameters, control_state_t *state, const deferred_results_t *deferred,
             const control_sample_t *sample);

/* Implied by the currents, by the machine's tables: torque at the angle of each phase, corrected by its misalignment
 * (2^-32 electrical rev), with the roles of the phases; with predictive torque control torque and flux linkage at the
 * planned angle; the sum times the scale of the tables (table_scale.h). failed: a check has, which opens the switches;
 * the torque is not looked up then, but 0, and the period that records a fault is no longer than a period of the run:
 * 34 of the computed bound of traditional. */
void measure_torque(const control_parameters_t *parameters, control_state_t *state,
                    const int32_t misalignment[HAL_PHASES_MAX], bool failed);

#endif
