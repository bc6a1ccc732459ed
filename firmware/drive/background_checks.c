#include "drive/background_checks.h"

#include "control/conduction.h"
#include "control/modulator.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"
#include "hal_time.h"
#include "interrupts/deferred.h"
#include "interrupts/unmasked_read.h"

/* Checks of phases, encoder, stall and STO lines: in each 4 control periods at 40 kHz; in each one while a phase or the
 * encoder is in doubt, so that it is found hardly later than with a check in each period. Heat is sampled at every
 * call, because currents may repeat after a few periods. */
#define CHECKS_PER_MS 10u

/* The rotor is held at its place: within two counts, or the window, of a reference that rests. Between the counts of a
 * coarse encoder the speed reference of that error stays, though nothing is to turn. */
COLD static bool holds_position(const control_state_t *control, const control_parameters_t *parameters) {
    const position_status_t *place = &control->position.status;
    const int64_t counts = 4 * (int64_t)parameters->encoder_middle, window = parameters->position.law.window >> 16;
    const int64_t most = counts > window ? counts : window;
    return place->active && place->speed_reference_q22 == 0 && place->error <= most && place->error >= -most;
}

COLD static void read_stall_input(const control_state_t *control, const control_parameters_t *parameters,
                                  stall_input_t *input) {
    const deferred_speed_results_t *speed = &deferred_in_effect(control)->speed;
    *input = (stall_input_t){
        .speed_mode = control->state_machine.state == DRIVE_STATE_RUN && control->deferred.mode == DRIVE_MODE_SPEED &&
                      !position_seeks_stop(&control->position) && !control->state_machine.identifies,
        .speed_reference_q22 = holds_position(control, parameters) ? 0 : speed->speed_reference_q22,
        .speed_q22 = control->observer.speed_q22,
        .torque_reference_q24 = control->torque_reference_q24,
        .torque_min_q24 = speed->torque_min_q24,
        .torque_max_q24 = speed->torque_max_q24,
        .electrical = control->measurement.commutation.electrical,
    };
}

/* Inputs of the checks from the last control period: its sample, the integrals of the voltage at it, the speed law. */
typedef struct {
    stall_input_t stall;
    flux_sample_t flux;
} sample_t;

COLD static bool read_sample(const control_state_t *control, const control_parameters_t *parameters, sample_t *sample) {
    const deferred_request_t *request = &control->deferred_request;
    const control_measurement_t *measured = &control->measurement;
    flux_sample_t *input = &sample->flux;
    for (unsigned attempt = 0; attempt < UNMASKED_READ_ATTEMPTS; attempt++) {
        input->periods = unmasked_read_begin(request);
        input->run = control->state_machine.state == DRIVE_STATE_RUN && !control->state_machine.identifies;
        input->late_interrupts = control->protection.late_interrupts;
        input->electrical = measured->commutation.electrical;
        input->period_flux_q29 =
            applied_flux_period_q29(measured->dc_link_voltage_q6, parameters->predictive.period_q40);
        input->encoder_angle = measured->encoder_angle;
        input->speed_q22 = control->observer.speed_q22;
        input->torque_q24 = control->torque_reference_q24;
        const int32_t *misalignment = deferred_in_effect(control)->predictive.misalignment;
        for (unsigned phase = 0; phase < machine_tables.phases; phase++) {
            input->misalignment[phase] = misalignment[phase];
            input->current_q9[phase] = measured->current_q9[phase];
            input->flux_q29[phase] = control->applied_flux.at_sample_q29[phase];
            input->next_q29[phase] = control->applied_flux.next_q29[phase];
            input->off[phase] = control->duty_q15[phase] == -MODULATOR_DUTY_ONE_Q15;
        }
        read_stall_input(control, parameters, &sample->stall);
        if (unmasked_read_ended(request, input->periods)) {
            return true;
        }
    }
    return false;
}

/* Misalignment of the phases by their flux linkage. */
static void follow_misalignment(drive_t *drive) {
    const flux_residual_t *residual = &drive->flux.residual;
    for (unsigned phase = 0; phase < residual->phases; phase++) {
        flux_angle_t *flux_angle = &drive->flux_angle[phase];
        if (!residual->sample.run) {
            *flux_angle = (flux_angle_t){0};
            drive->control.flux_misalignment[phase] = 0;
        } else if (flux_angle_add(flux_angle, residual, phase)) {
            drive->control.flux_misalignment[phase] = flux_angle_solve(flux_angle);
        }
    }
}

/* Threshold of the integral of the voltage. */
static bool no_current(const flux_sample_t *input, unsigned phase) {
    return input->current_q9[phase] <= (int32_t)(machine_tables.current_range_q9 / APPLIED_FLUX_NO_CURRENT);
}

/* Factor by what the deferred step has found in windows of its own, read between two of its updates. */
static int32_t factor_by_shaft_q30(drive_t *drive) {
    const control_parameters_t *parameters = &drive->control_parameters;
    const deferred_t *deferred = &drive->control.deferred;
    const inertia_t *inertia = &deferred->inertia;
    const volatile uint32_t *updates = &inertia->updates;
    const uint32_t before = *updates;
    __atomic_signal_fence(__ATOMIC_ACQUIRE);
    const shaft_torque_sample_t sample = {
        .window = before >> parameters->inertia.window_shift,
        .torque_variance_q14 = inertia->torque_variance_q14,
        .acceleration_variance_q14 = inertia->acceleration_variance_q14,
        .covariance_q14 = inertia->covariance_q14,
        .counts = deferred->mode == DRIVE_MODE_TORQUE && inertia->shift == 0 &&
                  drive->table_scale.intervals >= TABLE_SCALE_INTERVALS_MIN,
        .in_effect_q30 = drive->table_scale.smooth_q30,
        .scale_q30 = drive->table_scale.scale_q30,
    };
    __atomic_signal_fence(__ATOMIC_ACQUIRE);
    if (*updates == before) {
        shaft_torque_step(&parameters->inertia, &drive->shaft_torque, &sample);
    }
    return parameters->scale_by_shaft && drive->shaft_torque.variance > 0 ? drive->shaft_torque.factor_q30
                                                                          : TABLE_SCALE_ONE_Q30;
}

/* Scale of the tables. After the corrections, which are in the integrals of the next sample. */
static void follow_table_scale(drive_t *drive, hal_t *hal, const flux_sample_t *input,
                               const int32_t correction_q29[HAL_PHASES_MAX]) {
    const control_parameters_t *parameters = &drive->control_parameters;
    const flux_residual_t *residual = &drive->flux.residual;
    const int32_t period_q40 = parameters->predictive.period_q40;
    const int32_t periods = (int32_t)(residual->elapsed & 0xffu);
    const int32_t removable_q29 = 2 * (int32_t)(parameters->initialise_ticks / CHECKS_PER_MS) * input->period_flux_q29;
    for (unsigned phase = 0; phase < machine_tables.phases; phase++) {
        const flux_residual_phase_t *state = &residual->phase[phase];
        drive->conduction_ends |= input->off[phase] && !no_current(input, phase) && state->table_q29 < removable_q29;
        const table_scale_sample_t sample = {
            .current_q9 = input->current_q9[phase],
            .flux_q29 = input->flux_q29[phase],
            .correction_q29 = correction_q29[phase],
            .table_q29 = state->table_q29,
            .periods = (uint32_t)periods,
            .drop_q29 = applied_flux_period_q29(machine_tables.device_drop_q6, period_q40) * periods,
            .zero = state->zero_at == input->periods && no_current(input, phase),
            .none = no_current(input, phase),
            .lost = residual->lost,
        };
        table_scale_add(&drive->table_scale, phase, &sample, machine_tables.current_range_q9 / 32);
    }
    table_scale_follow(&drive->table_scale, factor_by_shaft_q30(drive), parameters->table_scale_part_q31 * periods);
    const bool follows = parameters->table_scale_part_q31 != 0;
    flux_observer_parameters_t flux = parameters->predictive.flux;
    const int32_t nominal_q40 = flux.resistance_period_q40;
    if (follows) { /* from half of it to twice: copper from -70 to 280 C */
        flux.resistance_period_q40 = fixed_clamp(fixed_add(nominal_q40, drive->table_scale.smooth_resistance_q40),
                                                 nominal_q40 / 2, fixed_add(nominal_q40, nominal_q40));
    }
    const table_scale_factors_t factors =
        table_scale_factors(follows ? drive->table_scale.smooth_q30 : TABLE_SCALE_ONE_Q30, period_q40, &flux);
    hal_critical_enter(hal);
    drive->control.table_scale = factors;
    hal_critical_leave(hal);
}

/* Checks phases and encoder, and corrects the integrals. */
COLD static uint32_t check_flux(drive_t *drive, hal_t *hal, const flux_sample_t *input) {
    const uint32_t failed = flux_monitor_step(&drive->control_parameters.flux_monitor, &drive->flux, input);
    if (drive->control_parameters.torque_law == TORQUE_LAW_PREDICTIVE) {
        follow_misalignment(drive);
    }
    int32_t correction_q29[HAL_PHASES_MAX];
    flux_residual_follow(&drive->flux.residual, correction_q29);
    drive->conduction_ends = false;
    if (input->run) {
        follow_table_scale(drive, hal, input, correction_q29);
    }
    for (unsigned phase = 0; phase < machine_tables.phases; phase++) {
        int32_t *next_q29 = &drive->control.applied_flux.next_q29[phase];
        hal_critical_enter(hal);
        const int32_t corrected_q29 = fixed_add(*next_q29, correction_q29[phase]);
        *next_q29 = no_current(input, phase) ? fixed_non_negative(corrected_q29) : corrected_q29;
        hal_critical_leave(hal);
    }
    return failed;
}

/* For telemetry. Words of several moments, because interrupts come in between: each is one word. [SR-09] */
COLD static available_torque_t find_available_torque(const drive_t *drive, int32_t by_heat_q24) {
    const control_parameters_t *parameters = &drive->control_parameters;
    const control_state_t *control = &drive->control;
    const conduction_state_t *conduction = &control->deferred.conduction;
    const int32_t speed_q22 = control->observer.speed_q22, mean_q24 = drive->degraded.mean_q24;
    const bool brakes = parameters->torque_law == TORQUE_LAW_PREDICTIVE && !conduction_at_rest(speed_q22);
    const available_torque_input_t input = {
        .run = control->state_machine.state == DRIVE_STATE_RUN,
        .four_quadrant = parameters->conduction.torque_min_q24 < 0,
        .speed_q22 = speed_q22,
        .load_torque_q24 =
            fixed_add(control->observer.load_torque_q24, deferred_in_effect(control)->speed.periodic_load_q24),
        .largest_q24 = parameters->conduction.torque_max_q24,
        .by_voltage_q24 = {conduction->torque_max_q24, -conduction->torque_min_q24},
        .link_fills = conduction->room_q15 < 1u << 15,
        .by_link_q24 = brakes ? conduction_braking_q24(&parameters->conduction, control->measurement.dc_link_voltage_q6)
                              : INT32_MAX,
        .by_heat_q24 = by_heat_q24,
        .by_degraded_q24 = drive->degraded.lost != 0 && mean_q24 != 0 ? mean_q24 : INT32_MAX,
    };
    return available_torque(&input);
}

/* Each current is one word: a control interrupt in between changes none while it is read. [SR-16] [SR-17] */
COLD static void follow_heat(drive_t *drive, hal_t *hal, uint32_t time_us) {
    const control_parameters_t *parameters = &drive->control_parameters;
    const temperature_t *temperature = &drive->temperature;
    temperature_step(&parameters->temperature, &drive->temperature, hal, machine_tables.phases, time_us);
    if (thermal_sample(&parameters->thermal, &drive->thermal, drive->control.measurement.current_q9, time_us)) {
        const int32_t thermal_q24 = thermal_torque_limit_q24(&parameters->thermal, &drive->thermal);
        const int32_t by_heat_q24 = fixed_min(thermal_q24, temperature->torque_limit_q24);
        drive->control.torque_limit_q24 = fixed_min(by_heat_q24, degraded_torque_limit_q24(&drive->degraded));
        drive->available_torque = find_available_torque(drive, by_heat_q24);
    }
}

/* False when the request in effect is not the one that the bus has brought: one of both copies has changed. The last
 * one before a bus-off is not taken, and lets the one before age; the ramp of overdue commands runs after a stop, too.
 * [SR-51] */
COLD static bool is_commanded(const drive_t *drive) {
    const command_request_t received = drive->comms.command.request;
    return drive->command.request == received || drive->comms.bus.run_inhibited ||
           (drive->ramping && drive->command.request == COMMAND_RUN && received == COMMAND_STOP);
}

/* False when the arming has changed, or what decides how long it lasts: an armed drive has had its last command no
 * earlier than the last frame of its sender. [SR-52] */
COLD static bool is_arming_intact(const drive_t *drive, uint32_t time_us) {
    const commands_t *commands = &drive->comms.commands;
    const bool in_order = time_us - commands->last_received_us <= time_us - drive->comms.command.time_us;
    return arming_is_intact(&commands->arming) && (in_order || commands->arming.armed == 0);
}

/* False when one of both notes of the lost phase has changed. [SR-51] */
COLD static bool is_lost_phase_intact(const drive_t *drive) {
    const uint32_t number = drive->control.lost_phase;
    return number <= machine_tables.phases && drive->degraded.lost == UINT32_C(1) << number >> 1;
}

/* A latch that has changed is not to be trusted: the drive is in fault from here on, and of a run that this has ended
 * nothing is left. Once: what stays changed is no new fault in each call, which the log would take for many. [SR-51] */
COLD static void test_itself(drive_t *drive, hal_t *hal, uint32_t time_us) {
    self_test_t *test = &drive->self_test;
    state_machine_t *state_machine = &drive->control.state_machine;
    self_test_step(test, hal, &drive->control_parameters, &drive->parameters, time_us);
    /* Words of the background, and angles that are one word each: no interrupt has to wait for them. */
    const bool intact = is_commanded(drive) && is_arming_intact(drive, time_us) &&
                        misalignment_is_intact(&drive->control_parameters.misalignment,
                                               &drive->control.deferred.misalignment, machine_tables.phases);
    hal_critical_enter(hal);
    const bool latched = self_test_latch_intact(&drive->control);
    if (!intact || !latched || !is_lost_phase_intact(drive)) {
        test->failed |= SELF_TEST_FAULT_LATCH;
    }
    if (!latched || ((test->failed & SELF_TEST_FAULT_LATCH) != 0 && state_machine->state != DRIVE_STATE_FAULT)) {
        drive->control.torque_reference_q24 = 0;
        control_prepare(&drive->control_parameters, &drive->control);
        state_machine_start_in_fault(state_machine, FAULT_BIT(FAULT_MEMORY));
        state_machine->record.time_us = time_us;
    }
    hal_critical_leave(hal);
}

/* Heat as a part of another continuous current; torque of the shaft by another inertia; torque that is left without a
 * phase. [SR-16] [SR-31] */
COLD void background_checks_reconfigure(drive_t *drive, const control_parameters_t *coming) {
    const control_parameters_t *present = &drive->control_parameters;
    thermal_reconfigure(&present->thermal, &coming->thermal, &drive->thermal);
    if (coming->observer.acceleration_q32 != present->observer.acceleration_q32) {
        drive->shaft_torque = (shaft_torque_t){0};
    }
    drive->degraded = (degraded_t){.lost = drive->degraded.lost, .least_q24 = INT32_MAX};
}

/* With one phase lost the drive may go on: then what has failed is no fault any more. Until the fault is cleared
 * outside a run, or the parameter no longer allows it, which changes there only. [SR-31] */
COLD static uint32_t follow_lost_phase(drive_t *drive, uint32_t failed) {
    const degraded_parameters_t *parameters = &drive->control_parameters.degraded;
    const bool run = drive->control.state_machine.state == DRIVE_STATE_RUN;
    if (degraded_accepts(parameters, &drive->degraded, run, failed, drive->flux.phases)) {
        drive->control.lost_phase = (uint32_t)__builtin_ctz(drive->degraded.lost) + 1u;
        flux_monitor_forget(&drive->flux);
        failed = 0;
    } else if (!run && drive->degraded.lost != 0 &&
               (drive->command.request == COMMAND_CLEAR_FAULT || !parameters->allowed)) {
        drive->degraded.lost = 0;
        drive->control.lost_phase = 0;
        flux_monitor_forget(&drive->flux);
    }
    degraded_step(parameters, &drive->degraded, &machine_tables);
    return failed;
}

/* Checks phases, encoder, stall and STO lines, unless the sample cannot be read. [SR-03] [SR-07] [SR-24] */
COLD static void check(drive_t *drive, hal_t *hal, uint32_t time_us) {
    const control_parameters_t *parameters = &drive->control_parameters;
    sample_t sample = {.flux = {.lost_phases = drive->degraded.lost,
                                .periods_per_ms = parameters->initialise_ticks,
                                .stroke = parameters->commutation.stroke,
                                .period_q40 = parameters->predictive.period_q40,
                                .resistance_period_q40 = parameters->predictive.flux.resistance_period_q40}};
    if (!read_sample(&drive->control, parameters, &sample)) {
        return;
    }
    uint32_t failed = follow_lost_phase(drive, check_flux(drive, hal, &sample.flux));
    if (drive->control.state_machine.identifies) { /* with tables that need not be the machine's */
        flux_monitor_forget(&drive->flux);
        failed = 0;
    }
    if (stall_monitor_failed(&drive->stall, &sample.stall, time_us)) {
        failed |= (uint32_t)FAULT_BIT(FAULT_STALL);
    }
    if (sto_monitor_failed(&drive->sto, drive->break_causes, time_us)) {
        failed |= (uint32_t)FAULT_BIT(FAULT_STO_DISCREPANCY);
    }
    if (drive->flux.encoder.over_speed) {
        failed |= (uint32_t)FAULT_BIT(FAULT_OVER_SPEED);
    }
    drive->failed_checks = failed;
}

/* [SR-16] [SR-17] [SR-33] [SR-37] [SR-50] [SR-53] [SR-55] [SR-58] */
COLD void background_checks(drive_t *drive, hal_t *hal, uint32_t time_us) {
    follow_heat(drive, hal, time_us);
    test_itself(drive, hal, time_us);
    const bool suspicious = drive->flux.suspicious || drive->conduction_ends;
    const uint32_t spacing = suspicious ? 1 : drive->control_parameters.initialise_ticks / CHECKS_PER_MS;
    if (unmasked_read_periods(&drive->control.deferred_request) - drive->flux.residual.sample.periods >= spacing) {
        check(drive, hal, time_us);
    }
    uint32_t failed = drive->failed_checks | thermal_faults(&drive->thermal) | temperature_faults(&drive->temperature) |
                      self_test_faults(&drive->self_test);
    if (drive->comms.bus.conflict) {
        failed |= (uint32_t)FAULT_BIT(FAULT_IDENTIFIER_CONFLICT);
    }
    if (drive->store.inhibited) { /* since the start; inhibits the first one only */
        failed |= (uint32_t)FAULT_BIT(FAULT_PARAMETER_MEMORY);
    }
    if (drive->control.state_machine.state != DRIVE_STATE_RUN) {
        drive->comms.commands.failed = false;
    } else if (drive->comms.commands.failed) {
        failed |= (uint32_t)FAULT_BIT(FAULT_COMMAND_ERROR);
    }
    drive->control.reported_fault_mask = failed;
}
