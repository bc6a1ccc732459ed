#include "drive/telemetry_collect.h"

#include "comms/units.h"
#include "drive_codec.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"
#include "interrupts/deferred.h"
#include "interrupts/speed_control.h"
#include "interrupts/torque_control.h"

/* Gain of the BP-PID in duty per N m, Q15, from duty per scaled error. */
static uint32_t gain_per_Nm_q15(const drive_t *drive, unsigned gain) {
    return (uint32_t)fixed_multiply(drive->control.duty.pid.gain_q24[gain],
                                    drive->control_parameters.duty.pid.error_scale_inverse_q24, 33);
}

/* Ticks of the timer in 5 ns, the resolution of the DBC. */
static uint32_t processor_time(const drive_t *drive, uint32_t ticks) {
    return (uint32_t)((uint64_t)ticks * drive->processor_time_q24 >> 24);
}

/* 0.01 % from Q16, below 2^22. */
static uint32_t percent(uint32_t load_q16) {
    return (uint32_t)(((uint64_t)load_q16 * 10000u + (1u << 15)) >> 16);
}

/* Mean of the phases, mechanical, 2^-32 turn, within an LSB for each phase. Six offsets have a sum beyond 32 bits,
 * whose division in software, within a critical section, would take longer than the control interrupt. */
static int32_t misalignment(const drive_t *drive) {
    const int32_t phases = machine_tables.phases, divisor = phases * machine_tables.rotor_poles;
    int32_t mean = 0;
    for (int32_t phase = 0; phase < phases; phase++) {
        mean += drive->control.deferred.misalignment.phase[phase].offset / divisor;
    }
    return mean;
}

uint16_t telemetry_self_test(const drive_t *drive) {
    const uint8_t *sensors = drive->temperature.failed_sensors;
    const unsigned winding = sensors[TEMPERATURE_WINDING] & 0xFu, inverter = sensors[TEMPERATURE_INVERTER] & 0xFu;
    return (uint16_t)(winding | inverter << 4 | drive->self_test.failed << SELF_TEST_TELEMETRY_BIT);
}

uint8_t telemetry_sensors_e_f(const drive_t *drive) {
    const uint8_t *sensors = drive->temperature.failed_sensors;
    return (uint8_t)((sensors[TEMPERATURE_WINDING] >> 4 & 3u) | (sensors[TEMPERATURE_INVERTER] >> 4 & 3u) << 2);
}

#if HAL_PHASES_MAX > 4 /* otherwise the drive has no such message */
static void collect_phases_e_f(const drive_t *drive, drive_telemetry_t *telemetry) {
    const int32_t *current_q9 = drive->control.measurement.current_q9;
    const unsigned sensors = telemetry_sensors_e_f(drive);
    telemetry->phases_e_f.current_e_a = (uint32_t)current_q9[4];
    telemetry->phases_e_f.current_f_a = (uint32_t)current_q9[5];
    telemetry->phases_e_f.phase_e = drive->flux.phases >> 4 & 1u;
    telemetry->phases_e_f.phase_f = drive->flux.phases >> 5 & 1u;
    telemetry->phases_e_f.lost_phase_e = drive->degraded.lost >> 4 & 1u;
    telemetry->phases_e_f.lost_phase_f = drive->degraded.lost >> 5 & 1u;
    telemetry->phases_e_f.winding_sensor_e = sensors & 1u;
    telemetry->phases_e_f.winding_sensor_f = sensors >> 1 & 1u;
    telemetry->phases_e_f.inverter_sensor_e = sensors >> 2 & 1u;
    telemetry->phases_e_f.inverter_sensor_f = sensors >> 3 & 1u;
}
#endif

static bool is_speed_limited(const drive_t *drive) {
    const command_t *command = &drive->command;
    return drive->control.state_machine.state == DRIVE_STATE_RUN && command->request == COMMAND_RUN &&
           command->mode == DRIVE_MODE_SPEED &&
           speed_control_limited_q22(&drive->control_parameters, command->speed_reference_q22) !=
               command->speed_reference_q22;
}

/* The torque at the present angle only while it is of interest: it takes a look at the tables for each phase. */
static void collect_degraded(const drive_t *drive, drive_telemetry_t *telemetry) {
    const degraded_t *state = &drive->degraded;
    const bool lost = state->lost != 0;
    const uint32_t electrical = drive->control.measurement.commutation.electrical;
    telemetry->degraded.degraded = lost;
    telemetry->degraded.lost_phase_a = state->lost & 1u;
    telemetry->degraded.lost_phase_b = state->lost >> 1 & 1u;
    telemetry->degraded.lost_phase_c = state->lost >> 2 & 1u;
    telemetry->degraded.lost_phase_d = state->lost >> 3 & 1u;
    telemetry->degraded.torque_mean_nm = units_torque_q8(lost ? state->mean_q24 : 0);
    telemetry->degraded.torque_least_nm = units_torque_q8(lost && state->mean_q24 != 0 ? state->least_q24 : 0);
    telemetry->degraded.torque_here_nm = units_torque_q8(
        lost ? degraded_torque_q24(&drive->control_parameters.degraded, state, &machine_tables, electrical) : 0);
}

/* Ts R in ohm s, Q-9.40, times the rate: R in Q7.24. */
static void collect_estimates(const drive_t *drive, drive_telemetry_t *telemetry) {
    const int64_t error_q40 = (int64_t)drive->table_scale.resistance_q40 * drive->parameters.control_rate_hz;
    const int32_t resistance_q16 =
        fixed_saturate(fixed_shift(drive->parameters.values[PARAMETER_RESISTANCE_OHM] + (error_q40 >> 16), 8));
    telemetry->estimates.table_scale = (uint32_t)((1 << 15) + fixed_shift(drive->control.table_scale.excess_q31, 16));
    telemetry->estimates.resistance_ohm = (uint32_t)fixed_non_negative(resistance_q16);
}

static drive_position_state_t position_state(const position_status_t *status) {
    if (!status->active) {
        return DRIVE_POSITION_STATE_INACTIVE;
    }
    if (status->following_error) {
        return DRIVE_POSITION_STATE_FOLLOWING_ERROR;
    }
    if (status->homing) {
        return DRIVE_POSITION_STATE_HOMING;
    }
    if (status->in_position) {
        return DRIVE_POSITION_STATE_IN_POSITION;
    }
    return status->reference_ended ? DRIVE_POSITION_STATE_ARRIVED : DRIVE_POSITION_STATE_MOVING;
}

static void collect_position(const drive_t *drive, drive_telemetry_t *telemetry) {
    const position_status_t *status = &drive->control.position.status;
    telemetry->position.position_deg = units_position_q18(status->position);
    telemetry->position.following_error_deg = units_deviation_q20(status->error);
    telemetry->position.position_state = (uint32_t)position_state(status);
    telemetry->position.homed = status->homed;
    telemetry->position.homing_failed = status->homing_failed;
    telemetry->position.target_limited = status->limited;
}

void telemetry_collect(const drive_t *drive, const hal_t *hal, uint32_t time_us, drive_telemetry_t *telemetry) {
    const control_parameters_t *parameters = &drive->control_parameters;
    const control_state_t *control = &drive->control;
    const control_measurement_t *measured = &control->measurement;
    const fault_record_t *record = &control->state_machine.record;
    const commands_counters_t *counters = &drive->comms.commands.counters;
    const bus_monitor_t *bus = &drive->comms.bus;
    const bool run = control->state_machine.state == DRIVE_STATE_RUN;
    const bool salient = run && parameters->controller == DRIVE_CONTROLLER_SALIENT;

    telemetry->status.time_us = time_us;
    telemetry->status.state = control->state_machine.state;
    telemetry->status.controller = parameters->controller;
    telemetry->status.speed_limited = is_speed_limited(drive);
    telemetry->status.fault = record->fault;
    telemetry->status.voltage_saturated = run && torque_control_voltage_saturated(parameters, control);
    telemetry->status.mode = control->position.status.active ? DRIVE_MODE_POSITION : control->deferred.mode;
    telemetry->status.start_inhibited_by = state_machine_first_fault(control->state_machine.start_inhibit_mask);
    telemetry->status.single_pulse = run && control->deferred.conduction.single_pulse;
    telemetry->status.cycle = drive->comms.telemetry.cycle;

    telemetry->motion.speed_rpm = units_milli_rpm(control->observer.speed_q22);
    telemetry->motion.speed_reference_rpm = units_milli_rpm(deferred_in_effect(control)->speed.speed_reference_q22);
    telemetry->motion.rotor_angle_deg = units_angle_u16(measured->angle);

    collect_position(drive, telemetry);

    telemetry->torque.torque_reference_nm = units_torque_q8(control->torque_reference_q24);
    telemetry->torque.torque_estimate_nm = units_torque_q8(measured->torque_sum_q24);
    telemetry->torque.load_torque_estimate_nm = units_torque_q8(
        fixed_add(control->observer.load_torque_q24, deferred_in_effect(control)->speed.periodic_load_q24));
    telemetry->torque.bus_voltage_v = (uint32_t)measured->dc_link_voltage_q6;

    telemetry->currents.current_a_a = (uint32_t)measured->current_q9[0];
    telemetry->currents.current_b_a = (uint32_t)measured->current_q9[1];
    telemetry->currents.current_c_a = (uint32_t)measured->current_q9[2];
    telemetry->currents.current_d_a = (uint32_t)measured->current_q9[3];

    telemetry->bp_pid.kp_per_nm = gain_per_Nm_q15(drive, 0);
    telemetry->bp_pid.ki_per_nm = gain_per_Nm_q15(drive, 1);
    telemetry->bp_pid.kd_per_nm = gain_per_Nm_q15(drive, 2);
    telemetry->bp_pid.duty = (control->duty.pid.duty_q23 + (1 << 7)) >> 8;

    telemetry->adaptation.misalignment_deg = units_deviation_q20(misalignment(drive));
    telemetry->adaptation.torque_missing_nm = salient ? units_torque_q8(control->predictive.torque_shortfall_q24) : 0;
    telemetry->adaptation.observer_bandwidth_rad_s =
        observer_bandwidth_stage(&parameters->bandwidth, control->bandwidth.stage)->bandwidth_rad_s;

    telemetry->fault_cause.time_us = record->time_us;
    telemetry->fault_cause.fault = record->fault;
    telemetry->fault_cause.state = record->state;
    telemetry->fault_cause.checks = (uint16_t)record->fault_mask;

    telemetry->fault_snapshot.speed_rpm = units_quarter_rpm(units_milli_rpm(record->speed_q22));
    telemetry->fault_snapshot.bus_voltage_v = record->dc_link_voltage_q6;
    telemetry->fault_snapshot.current_max_a = record->current_max_q9;
    telemetry->fault_snapshot.torque_reference_nm = units_torque_q8(record->torque_reference_q24);

    telemetry->fault_mask = record->fault_mask;

    telemetry->command_counters.wrong_length = counters->wrong_length;
    telemetry->command_counters.wrong_checksum = counters->wrong_checksum;
    telemetry->command_counters.wrong_counter = counters->wrong_counter;
    telemetry->command_counters.out_of_range = counters->out_of_range;

    const arming_t *arming = &drive->comms.commands.arming;
    telemetry->arming.challenge = arming->challenge;
    telemetry->arming.attempt = arming->attempt;
    telemetry->arming.armed = arming->armed != 0;
    telemetry->arming.configuring = arming->configuring != 0;
    telemetry->arming.refused = arming->refused;
    telemetry->arming.run_unarmed = counters->run_unarmed;

    telemetry->bus_counters.unknown_frame = counters->unknown_frame;
    telemetry->bus_counters.receive_overflow = hal_can_receive_overflows(hal);
    telemetry->bus_counters.command_accepted = counters->accepted;

    telemetry->bus_state.bus_state = bus->status.state;
    telemetry->bus_state.receive_error_counter = bus->status.receive_errors;
    telemetry->bus_state.transmit_error_counter = bus->status.transmit_errors;
    telemetry->bus_state.bus_off_count = bus->bus_off_count;
    telemetry->bus_state.foreign_identifier_count = bus->foreign_count;

    telemetry->processor.used_us = processor_time(drive, drive->used_ticks);
    telemetry->processor.worst_us = processor_time(drive, drive->worst_ticks);
    telemetry->processor.available_us = processor_time(drive, 2u * parameters->period_ticks);
    telemetry->processor.late_interrupts = drive->control.protection.late_interrupts;

    telemetry->deferred.used_us = processor_time(drive, drive->deferred_used_ticks);
    telemetry->deferred.worst_us = processor_time(drive, drive->deferred_worst_ticks);
    telemetry->deferred.skipped_periods = control->deferred_request.skipped_total;

    telemetry->gates = drive->break_causes;      /* the DBC has the bits of HAL_PWM_BREAK_* */
    telemetry->phase_fault = drive->flux.phases; /* the DBC has a bit for each phase */
    telemetry->thermal.winding_load = percent(thermal_winding_load_q16(&drive->thermal));
    telemetry->thermal.switch_load = percent(thermal_switch_load_q16(&drive->thermal));
    telemetry->thermal.torque_limit_nm = units_torque_q8(control->torque_limit_q24);
    telemetry->thermal.winding_temperature_c =
        (uint32_t)fixed_non_negative(temperature_C(&drive->temperature, TEMPERATURE_WINDING));
    telemetry->thermal.inverter_temperature_c =
        (uint32_t)fixed_non_negative(temperature_C(&drive->temperature, TEMPERATURE_INVERTER));
    telemetry->self_test = telemetry_self_test(drive);

    collect_degraded(drive, telemetry);
#if HAL_PHASES_MAX > 4
    collect_phases_e_f(drive, telemetry);
#endif

    collect_estimates(drive, telemetry);

    telemetry->available_torque.forward_nm = units_torque_q8(drive->available_torque.forward.torque_q24);
    telemetry->available_torque.backward_nm = units_torque_q8(-drive->available_torque.backward.torque_q24);
    telemetry->available_torque.forward_limited_by = drive->available_torque.forward.limited_by;
    telemetry->available_torque.backward_limited_by = drive->available_torque.backward.limited_by;
    telemetry->available_torque.load_exceeds = drive->available_torque.load_exceeds;

    telemetry->identity.firmware_major = SALIENT_VERSION_MAJOR;
    telemetry->identity.firmware_minor = SALIENT_VERSION_MINOR;
    telemetry->identity.firmware_patch = SALIENT_VERSION_PATCH;
    telemetry->identity.dbc_hash = machine_tables.dbc_hash;
    telemetry->machine.machine_hash = machine_tables.machine_hash;

    telemetry->heartbeat.state = control->state_machine.state;
    telemetry->heartbeat.fault = record->fault;
    telemetry->heartbeat.controller = parameters->controller;
    telemetry->heartbeat.phases = machine_tables.phases;
    telemetry->heartbeat.control_rate_hz = drive->parameters.control_rate_hz;
}
