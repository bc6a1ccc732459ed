#include "drive/control.h"

#include "control/modulator.h"
#include "drive/measure.h"
#include "drive/observe.h"
#include "drive/speed_control.h"
#include "drive/supervise.h"
#include "drive/torque_control.h"

void control_reset(const control_parameters_t *parameters, control_state_t *state) {
    *state = (control_state_t){0};
    state_machine_reset(&state->state_machine);
    control_prepare(parameters, state);
}

void control_prepare(const control_parameters_t *parameters, control_state_t *state) {
    speed_control_reset(state);
    torque_control_reset(parameters, state);
}

/* The first sample initialises what compares successive samples. */
static void start(control_state_t *state, const control_measurement_t *measured) {
    state->started = true;
    observe_reset(state, measured);
    protection_reset(&state->protection, measured->encoder_angle);
}

static uint64_t protect(const control_parameters_t *parameters, control_state_t *state, const control_sample_t *sample,
                        const command_t *command, const control_measurement_t *measured) {
    const protection_input_t input = {
        .current_max_q9 = measured->current_max_q9,
        .dc_link_voltage_q6 = measured->dc_link_voltage_q6,
        .speed_q22 = state->observer.speed_q22,
        .encoder_angle = measured->encoder_angle,
        .missed_interrupts = sample->missed_interrupts,
        .command_age_us = sample->time_us - command->time_us,
    };
    return protection_check(&parameters->protection, &state->protection, &input);
}

bool control_step(const control_parameters_t *parameters, control_state_t *state, const control_sample_t *sample,
                  const command_t *command, hal_pwm_compare_t *compare) {
    control_measurement_t *measured = &state->measurement;
    measure(parameters, &state->observer, &state->misalignment, sample, measured);
    if (!state->started) {
        start(state, measured);
    }
    observe(parameters, state, measured);
    const uint64_t fault_mask = protect(parameters, state, sample, command, measured);
    *compare = (hal_pwm_compare_t){{0}, {0}};
    const bool was_running = state->state_machine.state == DRIVE_STATE_RUN;
    if (!supervise(parameters, state, sample, command, measured, fault_mask)) {
        if (was_running) {
            control_prepare(parameters, state);
        }
        return false;
    }
    speed_control(parameters, state, sample, command);
    torque_control(parameters, state, measured);
    modulate(state->duty_q15, parameters->tables->phases, parameters->period_ticks, parameters->interleaved_pwm,
             compare);
    return true;
}
