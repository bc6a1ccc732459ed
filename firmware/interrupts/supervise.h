/* Supervision step of the control interrupt: drive state and fault record. */
#ifndef INTERRUPTS_SUPERVISE_H
#define INTERRUPTS_SUPERVISE_H

#include <stdbool.h>
#include <stdint.h>

#include "interrupts/control_step.h"

/* One tick of the state machine with the fault mask of this period: completes the record of a new fault, and sets
 * observer and references for the new state when the state changes. Returns true in RUN. */
bool supervise(const control_parameters_t *parameters, control_state_t *state, const control_sample_t *sample,
               const command_t *command, uint64_t fault_mask);

#endif
