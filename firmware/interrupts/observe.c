#include "interrupts/observe.h"

#include "control/machine_tables.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"
#include "interrupts/deferred.h"

void observe_forget_load(control_state_t *state) {
    state->observer.load_torque_q24 = 0;
    observer_bandwidth_reset(&state->bandwidth);
    deferred_reset_observer(state);
}

/* 1/32 rev less an LSB, at which load_observer.c limits the innovation. */
#define FOLLOWS_MAX ((1 << 27) - 1)

/* 2 pi 2000 1/s: from 2^-32 rev in half a millisecond to 2^-22 rad/s, Q24. */
#define HALF_MS_SPEED_Q24 205887416

NOINLINE void observe_recover(control_state_t *state, uint32_t periods_per_ms) {
    observer_slip_t *slip = &state->slip;
    const bool follows = fixed_abs(state->innovation) < FOLLOWS_MAX;
    if (slip->periods == 0) {
        slip->angle = state->measurement.angle;
        slip->periods = !follows;
        return;
    }
    if (slip->periods < periods_per_ms / 2) {
        slip->periods++;
        return;
    }
    slip->periods = 0;
    if (!follows) {
        const uint32_t angle = state->measurement.angle;
        const int32_t rotation = (int32_t)(angle - slip->angle);
        load_observer_reset(&state->observer, angle);
        state->observer.speed_q22 = fixed_multiply(rotation, HALF_MS_SPEED_Q24, 24u + machine_tables.speed_exponent);
        observer_bandwidth_reset(&state->bandwidth);
    }
}

/* Counts that become fast again are followed at the steady bandwidth, until one triggers. */
static const load_observer_gains_t *slow_gains(const control_parameters_t *parameters, control_state_t *state,
                                               const slow_counts_results_t *slow_counts) {
    state->bandwidth.stage = OBSERVER_BANDWIDTH_STEADY_STAGE;
    const uint32_t encoder_angle = state->measurement.encoder_angle;
    if (encoder_angle == slow_counts->encoder_angle) {
        const int32_t max_q22 = slow_counts->speed_max_q22;
        state->observer.speed_q22 = fixed_clamp(state->observer.speed_q22, -max_q22, max_q22);
    }
    return slow_counts_gains(&parameters->slow_counts, slow_counts, encoder_angle);
}

void observe(const control_parameters_t *parameters, control_state_t *state, const deferred_results_t *deferred) {
    const control_measurement_t *measured = &state->measurement;
    const int32_t innovation = load_observer_innovation(&state->observer, measured->angle);
    const load_observer_gains_t *gains =
        deferred->slow_counts.slow
            ? slow_gains(parameters, state, &deferred->slow_counts)
            : observer_bandwidth_step(&parameters->bandwidth, &state->bandwidth, &deferred->bandwidth, innovation,
                                      &measured->angle_from_edge);
    state->innovation = innovation;
    const int32_t torque_q24 = fixed_subtract(measured->torque_sum_q24, deferred->speed.periodic_load_q24);
    load_observer_step(&parameters->observer, gains, &deferred->observer, &state->observer, innovation, torque_q24);
}
