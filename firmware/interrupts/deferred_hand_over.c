/* The control interrupt's part of the deferred step: resets, and the input of a step. */
#include "fixed/compiler.h"
#include "fixed/fixed.h"
#include "interrupts/deferred.h"

/* From here on the results of earlier inputs are without effect, but for those that are kept. */
void deferred_reset_run(control_state_t *state) {
    deferred_request_t *request = &state->deferred_request;
    const deferred_results_t *kept = deferred_in_effect(state);
    const uint32_t generation = request->generation;
    request->initial.fault_mask = kept->fault_mask;
    request->initial.bandwidth = kept->bandwidth;
    request->initial.slow_counts.slow = false; /* until the next step, a period later */
    request->initial.predictive = kept->predictive;
    request->initial.observer = kept->observer;
    request->initial.limit = kept->limit;
    request->initial.duty = kept->duty;
    request->initial.predictive.conduction = CONDUCTION_INITIAL;
    request->initial.speed = (deferred_speed_results_t){0, 0, 0, 0, 0};
    request->generation = (generation & DEFERRED_OBSERVER_MASK) | ((generation + 1) & DEFERRED_RUN_MASK);
}

void deferred_reset_observer(control_state_t *state) {
    deferred_request_t *request = &state->deferred_request;
    const deferred_results_t *kept = deferred_in_effect(state);
    request->initial.fault_mask = kept->fault_mask;
    request->initial.speed = kept->speed;
    request->initial.predictive = kept->predictive;
    request->initial.observer = kept->observer;
    request->initial.limit = kept->limit;
    request->initial.duty = kept->duty;
    request->initial.bandwidth = (observer_bandwidth_limits_t){0, 0, 0, 0};
    request->initial.slow_counts.slow = false;
    request->generation += DEFERRED_OBSERVER_STEP;
}

static void hand_over_bandwidth(control_state_t *state, deferred_input_t *input) {
    input->bandwidth.innovation = state->innovation;
    input->bandwidth.from_edge = state->measurement.angle_from_edge;
    input->bandwidth.stage = state->bandwidth.stage;
    input->bandwidth.trigger = state->bandwidth.trigger;
    state->bandwidth.trigger = OBSERVER_TRIGGER_NONE;
}

/* A sample is learned from once. Word by word: a copy of the structure takes registers that each step had to save. */
static void hand_over_pid(bp_pid_t *pid, deferred_input_t *input) {
    UNROLL(3)
    for (unsigned l = 0; l < BP_OUTPUTS; l++) {
        input->pid.term_q31[l] = pid->sample.term_q31[l];
    }
    input->pid.learns = pid->sample.learns;
    pid->sample.learns = false;
}

static void hand_over_predictive(const control_state_t *state, deferred_input_t *input) {
    input->load_torque_q24 = state->observer.load_torque_q24;
    input->speed_correction_q22 = state->observer.speed_correction_q22;
    input->torque_sum_q24 = state->measurement.torque_sum_q24;
    input->torque_shortfall_q24 = state->predictive.torque_shortfall_q24;
}

static void hand_over_duty(const control_parameters_t *parameters, control_state_t *state, deferred_input_t *input) {
    const control_measurement_t *measured = &state->measurement;
    const unsigned regulated = state->duty.regulated;
    if (regulated >= HAL_PHASES_MAX) {
        return;
    }
    input->regulated_angle = commutation_angle(&parameters->commutation, &measured->commutation, regulated);
    input->regulated_current_q9 = measured->current_q9[regulated];
    hand_over_pid(&state->duty.pid, input);
}

void deferred_hand_over(const control_parameters_t *parameters, control_state_t *state, const control_sample_t *sample,
                        const command_t *command, bool run) {
    deferred_request_t *request = &state->deferred_request;
    if (deferred_pending(request, &state->deferred.response)) {
        deferred_skip(request);
        return;
    }
    const control_measurement_t *measured = &state->measurement;
    deferred_input_t *input = &request->input;
    input->generation = request->generation;
    input->periods = request->skipped + 1;
    input->encoder_angle = measured->encoder_angle;
    input->dc_link_voltage_q6 = measured->dc_link_voltage_q6;
    input->command_age_us = sample->time_us - command->time_us;
    input->angle = (uint32_t)(state->observer.angle_q64 >> 32);
    input->speed_q22 = state->observer.speed_q22;
    input->run = run;
    input->torque_reference_q24 = state->torque_reference_q24;
    input->electrical = measured->commutation.electrical;
    input->current_q9 =
        measured->current_q9[misalignment_phase_index(&state->deferred.misalignment)]; /* no step is pending */
    if (parameters->bandwidth.schedule.adaptive) {
        hand_over_bandwidth(state, input);
    }
    if (parameters->torque_law == TORQUE_LAW_PREDICTIVE) {
        hand_over_predictive(state, input);
    } else if (parameters->torque_law == TORQUE_LAW_DUTY) {
        hand_over_duty(parameters, state, input);
    }
    deferred_request(request);
}
