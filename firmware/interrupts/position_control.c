#include "interrupts/position_control.h"

#include "fixed/compiler.h"
#include "fixed/fixed.h"
#include "interrupts/speed_control.h"

/* Part of the largest torque that the law asks for from which on it shows the inertia. */
#define LAW_SHARE 32

/* [SR-09] */
static int32_t torque_limit_q24(const control_parameters_t *parameters, const control_state_t *state) {
    const int32_t limit_q24 = state->torque_limit_q24;
    return position_seeks_stop(&state->position) ? fixed_min(limit_q24, parameters->position.law.homing_torque_q24)
                                                 : limit_q24;
}

NOINLINE static void control_position(const control_parameters_t *parameters, control_state_t *state,
                                      const deferred_input_t *input, const position_sample_t *sample,
                                      deferred_results_t *results) {
    deferred_t *deferred = &state->deferred;
    const position_output_t output =
        position_step(&parameters->position.law, &state->position, &state->position_command, sample);
    const int32_t limit_q24 = torque_limit_q24(parameters, state);
    const command_t command = {
        .request = COMMAND_RUN, .mode = DRIVE_MODE_SPEED, .speed_reference_q22 = output.speed_q22};
    deferred->speed_reference_q22 = speed_control_limited_q22(parameters, output.speed_q22); /* no ramp */
    deferred->run = true;
    deferred->follows_position = true;
    speed_control_position(parameters, deferred, input, &command, limit_q24, results);
    const int32_t torque_q24 = fixed_add(results->speed.speed_law_torque_q24,
                                         fixed_multiply(output.torque_q24, deferred->inertia.ratio_q14, 14));
    results->speed.speed_law_torque_q24 = torque_q24;
    deferred->accelerates = fixed_abs(torque_q24) >= parameters->conduction.torque_max_q24 / LAW_SHARE;
}

/* Step of position mode: with its sample, which the other modes need not. False, and nothing is done, while the drive
 * does not run, and on a machine that runs in one direction only. */
NOINLINE static bool begin_step(const control_parameters_t *parameters, control_state_t *state,
                                const deferred_input_t *input, const command_t *command, deferred_results_t *results) {
    if (!input->run || command->request != COMMAND_RUN || parameters->speed_reference_min_q22 >= 0) {
        return false;
    }
    const int32_t limit_q24 =
        fixed_min(fixed_min(torque_limit_q24(parameters, state), state->deferred.conduction.torque_max_q24),
                  -state->deferred.conduction.torque_min_q24);
    const position_sample_t sample = {
        .encoder_angle = input->encoder_angle,
        .angle = input->angle,
        .speed = (input->speed_q22 >> 4) * (parameters->position.law.per_speed_q16 >> 4) >> 8,
        .at_torque_limit = fixed_abs(input->torque_reference_q24) >= limit_q24 - limit_q24 / 16,
        .count = state->deferred.slow_counts.slow ? 2 * parameters->encoder_middle : 0,
        .periods = input->periods,
    };
    position_status_t *status = &state->position.status;
    status->active = status->active && state->deferred.follows_position; /* else it begins */
    inertia_refine(&parameters->inertia, &parameters->observer, &state->deferred.inertia);
    control_position(parameters, state, input, &sample, results);
    return true;
}

void position_control_deferred(const control_parameters_t *parameters, control_state_t *state,
                               const deferred_input_t *input, const command_t *command, deferred_results_t *results) {
    if (command->mode == DRIVE_MODE_POSITION && begin_step(parameters, state, input, command, results)) {
        return;
    }
    state->deferred.follows_position = false;
    speed_control_deferred(parameters, &state->deferred, input, command, state->torque_limit_q24, results);
}

void position_control_follow(control_state_t *state, const deferred_input_t *input) {
    if (!state->deferred.follows_position) {
        position_follow(&state->position, input->encoder_angle, input->angle);
    }
}
