#include "interrupts/supervise.h"

#include "fixed/compiler.h"
#include "fixed/fixed.h"
#include "interrupts/deferred.h"
#include "interrupts/observe.h"
#include "interrupts/torque_control.h"

/* A stop ends below this speed: 0.5 rad/s, 5 r/min. */
#define STANDSTILL_Q22 (1u << 21)

/* [SR-40] */
static void complete_record(fault_record_t *record, const control_state_t *state, uint32_t time_us) {
    const control_measurement_t *measured = &state->measurement;
    record->time_us = time_us;
    /* The estimate without this sample: the encoder may be the cause of the fault. */
    record->speed_q22 = measured->predicted_speed_q22;
    record->torque_reference_q24 = state->torque_reference_q24; /* of the previous period */
    record->current_max_q9 = (uint16_t)measured->current_max_q9;
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        record->current_q9[phase] = (uint16_t)measured->current_q9[phase];
    }
    record->angle = (uint16_t)(measured->angle >> 16);
    record->dc_link_voltage_q6 = (uint16_t)measured->dc_link_voltage_q6;
}

/* [SR-44] */
NOINLINE static void end_run(const control_parameters_t *parameters, control_state_t *state) {
    state->torque_reference_q24 = 0;
    state->slip.periods = 0;
    torque_control_reset(parameters, state);
    if (state->state_machine.state != DRIVE_STATE_FAULT) { /* else a period later */
        deferred_reset_run(state);
    }
}

/* As wide as after its reset, the observer takes the first coarse counts of a turning rotor for a load. */
static void await_load(const control_parameters_t *parameters, control_state_t *state) {
    if (parameters->bandwidth.schedule.adaptive &&
        state->bandwidth.stage < parameters->bandwidth.schedule.trigger_stage_count) {
        state->observer.load_torque_q24 = 0;
    }
}

/* Out of the way of a run, which is the longer path. The time by value: a sample whose address is passed on would have
 * to be in memory as a whole. [SR-39] [SR-40] [SR-44] */
NOINLINE static void stand(const control_parameters_t *parameters, control_state_t *state, uint32_t time_us,
                           uint64_t fault_mask, command_request_t request) {
    state_machine_t *state_machine = &state->state_machine;
    const drive_state_t before = state_machine->state;
    if (state_machine_stands(state_machine, fault_mask, request, parameters->initialise_ticks)) {
        complete_record(&state_machine->record, state, time_us);
    }
    if (before == DRIVE_STATE_RUN) {
        if (!state_machine->identifies) {
            end_run(parameters, state);
        }
    } else if (state_machine->state != before) {
        if (before == DRIVE_STATE_FAULT) {
            observe_forget_load(state); /* angle and speed of a rotor that may be turning are kept */
        }
    } else if (before == DRIVE_STATE_FAULT && state_machine->fault_free_ticks == 1) {
        deferred_reset_run(state); /* not in the period that records the fault, which would take longer than a run */
    } else {
        observe_recover(state, parameters->initialise_ticks);
        if (before != DRIVE_STATE_FAULT) {
            await_load(parameters, state);
        }
    }
}

/* [SR-06] [SR-39] */
bool supervise(const control_parameters_t *parameters, control_state_t *state, const control_sample_t *sample,
               const command_t *command, uint64_t fault_mask) {
    state_machine_t *state_machine = &state->state_machine;
    const state_machine_input_t input = {
        .fault_mask = fault_mask,
        .request = command->request,
        .at_standstill =
            command->request == COMMAND_STOP && fixed_magnitude(state->observer.speed_q22) < STANDSTILL_Q22,
    };
    if (state_machine_runs(state_machine, &input)) { /* entered from READY, which leaves nothing to reset */
        return true;
    }
    stand(parameters, state, sample->time_us, fault_mask, command->request);
    return false;
}
