#include "interrupts/control_step.h"

#include "control/modulator.h"
#include "interrupts/deferred.h"
#include "interrupts/measure.h"
#include "interrupts/observe.h"
#include "interrupts/speed_control.h"
#include "interrupts/supervise.h"
#include "interrupts/torque_control.h"

void control_reset(const control_parameters_t *parameters, control_state_t *state) {
    *state = (control_state_t){0};
    state->torque_limit_q24 = INT32_MAX;
    state_machine_reset(&state->state_machine);
    control_prepare(parameters, state);
    state->deferred_request.initial.observer = load_observer_inertia(&parameters->observer, 0);
    state->table_scale =
        table_scale_factors(TABLE_SCALE_ONE_Q30, parameters->predictive.period_q40, &parameters->predictive.flux);
}

/* [SR-44] */
void control_prepare(const control_parameters_t *parameters, control_state_t *state) {
    bp_pid_clear_telemetry(&state->duty.pid); /* of a law that the parameters have changed */
    torque_control_reset(parameters, state);
    deferred_reset_run(state);
}

/* The first sample initialises what compares successive samples; all else is as after control_reset. */
static void first_sample(control_state_t *state) {
    state->started = true;
    load_observer_reset(&state->observer, state->measurement.angle);
    protection_reset(&state->protection, state->measurement.encoder_angle);
}

static uint64_t protect(const control_parameters_t *parameters, control_state_t *state,
                        const control_sample_t *sample) {
    const control_measurement_t *measured = &state->measurement;
    const protection_input_t input = {
        .current_max_q9 = measured->current_max_q9,
        .dc_link_voltage_q6 = measured->dc_link_voltage_q6,
        .encoder_angle = measured->encoder_angle,
        .missed_interrupts = sample->missed_interrupts,
        .break_causes = sample->break_causes,
        .skipped_deferred = state->deferred_request.skipped,
    };
    return protection_check(&parameters->protection, &state->protection, &input);
}

/* [SR-39] */
bool control_step(const control_parameters_t *parameters, control_state_t *state, const control_sample_t *sample,
                  const command_t *command, hal_pwm_compare_t *compare) {
    const deferred_results_t *deferred = deferred_in_effect(state);
    measure(parameters, state, deferred, sample);
    if (!state->started) {
        first_sample(state);
    }
    const uint64_t fault_mask = protect(parameters, state, sample) | deferred->fault_mask;
    measure_torque(parameters, state, deferred->predictive.misalignment, fault_mask != 0);
    observe(parameters, state, deferred);
    const bool run = supervise(parameters, state, sample, command, fault_mask);
    if (run) {
        state->torque_reference_q24 = speed_control_torque_q24(parameters, &state->observer, sample, deferred);
        torque_control(parameters, state, deferred);
        modulate(state->duty_q15, machine_tables.phases, parameters->period_ticks, parameters->interleaved_pwm,
                 compare);
    } else {
        *compare = (hal_pwm_compare_t){{0}, {0}};
    }
    deferred_hand_over(parameters, state, sample, command, run);
    return run;
}
