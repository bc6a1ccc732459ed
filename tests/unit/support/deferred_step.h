// The deferred interrupt as the drive makes it (drive.c), without its timing.
#pragma once

extern "C" {
#include "interrupts/deferred.h"
}

// Computes the pending step and puts its results into effect; false when none is pending.
inline bool deferred_step(const control_parameters_t *parameters, control_state_t *state, const command_t *command) {
    deferred_response_t *response = &state->deferred.response;
    if (!deferred_pending(&state->deferred_request, response)) {
        return false;
    }
    deferred_compute(parameters, state, command);
    deferred_complete(&state->deferred_request, response);
    return true;
}
