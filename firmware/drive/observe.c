#include "drive/observe.h"

#include "drive/deferred.h"

void observe_reset(control_state_t *state, const control_measurement_t *measured) {
    load_observer_reset(&state->observer, measured->angle);
    observer_bandwidth_reset(&state->bandwidth);
    deferred_reset_observer(state);
}

void observe(const control_parameters_t *parameters, control_state_t *state, const observer_bandwidth_limits_t *limits,
             const control_measurement_t *measured) {
    const int32_t innovation = load_observer_innovation(&state->observer, measured->angle);
    const load_observer_gains_t *gains = observer_bandwidth_step(&parameters->bandwidth, &state->bandwidth, limits,
                                                                 innovation, measured->angle_from_edge);
    state->innovation = innovation;
    load_observer_step(&parameters->observer, gains, &state->observer, innovation, measured->torque_sum_q24);
}
