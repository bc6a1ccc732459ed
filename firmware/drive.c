#include "drive.h"

#include "hal_encoder.h"
#include "hal_interrupt.h"
#include "hal_time.h"

#include "fixed/fixed.h"

static void configure(drive_t *drive) {
    const control_parameters_t control_parameters =
        configure_control(&drive->parameters, drive->tables, drive->control_rate_hz, hal_encoder_bits(drive->hal),
                          hal_adc_bits(drive->hal));
    hal_critical_enter(drive->hal);
    drive->control_parameters = control_parameters;
    control_prepare(&drive->control_parameters, &drive->control); /* parameters change outside of RUN only */
    hal_critical_leave(drive->hal);
    drive->configured_changes = drive->parameters.changes;
}

bool drive_init(drive_t *drive, hal_t *hal, const machine_tables_t *tables, const drive_config_t *config) {
    if (!configure_rate_allowed(config->control_rate_hz)) {
        return false;
    }
    *drive = (drive_t){.hal = hal, .tables = tables, .control_rate_hz = config->control_rate_hz};
    parameters_init(&drive->parameters);
    parameters_set_default(&drive->parameters, PARAMETER_CONTROLLER, (int32_t)config->controller);
    parameters_set_default(&drive->parameters, PARAMETER_INERTIA_KG_M2, tables->inertia_q30);
    parameters_set_default(&drive->parameters, PARAMETER_FRICTION_NM_S, tables->friction_q30);
    parameters_set_default(&drive->parameters, PARAMETER_RESISTANCE_OHM, tables->resistance_q24);
    comms_init(&drive->comms, tables->phases, config->control_rate_hz, hal_time_us(hal));
    configure(drive);
    control_reset(&drive->control_parameters, &drive->control);
    hal_pwm_open_all(hal);
    hal_pwm_start(hal, drive->control_parameters.period_ticks);
    return true;
}

void drive_control_interrupt(drive_t *drive) {
    control_sample_t *sample = &drive->sample;
    sample->missed_interrupts = hal_interrupt_missed_triggers(drive->hal);
    sample->time_us = hal_time_us(drive->hal);
    if (sample->missed_interrupts != 0) {
        drive->late_interrupts++; /* the one before this */
    }
    hal_encoder_read(drive->hal, &sample->encoder);
    hal_adc_read(drive->hal, &sample->adc);
    hal_pwm_compare_t compare;
    if (control_step(&drive->control_parameters, &drive->control, sample, &compare)) {
        hal_pwm_write(drive->hal, &compare);
    } else {
        hal_pwm_open_all(drive->hal);
    }
    drive->used_ticks = hal_interrupt_elapsed_ticks(drive->hal);
    if (drive->used_ticks > drive->worst_ticks) {
        drive->worst_ticks = drive->used_ticks;
    }
}

/* A gain in duty per scaled error as duty per N m, both Q15. */
static int32_t gain_per_Nm_q15(const drive_t *drive, unsigned gain) {
    return fixed_multiply(drive->control.duty.pid.gain_q24[gain],
                          drive->control_parameters.duty.pid.error_scale_inverse_q24, 33);
}

/* Mean of the phases, mechanical, 2^-32 turn. */
static int32_t misalignment(const drive_t *drive) {
    const int32_t phases = drive->tables->phases;
    int64_t sum = 0;
    for (int32_t phase = 0; phase < phases; phase++) {
        sum += drive->control.misalignment.phase[phase].offset;
    }
    return (int32_t)sum / (phases * drive->tables->rotor_poles);
}

static telemetry_snapshot_t snapshot(const drive_t *drive, uint32_t time_us) {
    const control_diagnostics_t d = control_diagnose(&drive->control_parameters, &drive->control);
    const state_machine_t *machine = &drive->control.machine;
    telemetry_snapshot_t s = {
        .time_us = time_us,
        .state = (uint8_t)machine->state,
        .controller = (uint8_t)drive->control_parameters.controller,
        .fault = (uint8_t)machine->record.fault,
        .voltage_saturated = d.voltage_saturated,
        .speed_q22 = d.speed_q22,
        .speed_reference_q22 = d.speed_reference_q22,
        .rotor_angle = d.angle,
        .torque_reference_q24 = d.torque_reference_q24,
        .torque_estimate_q24 = d.torque_q24,
        .load_torque_estimate_q24 = d.load_torque_q24,
        .bus_voltage_q6 = d.bus_voltage_q6,
        .kp_q15 = gain_per_Nm_q15(drive, 0),
        .ki_q15 = gain_per_Nm_q15(drive, 1),
        .kd_q15 = gain_per_Nm_q15(drive, 2),
        .duty_q15 = d.duty_q15,
        .trim_torque_q24 = d.trim_torque_q24,
        .misalignment = misalignment(drive),
        .torque_missing_q24 = d.torque_missing_q24,
        .observer_bandwidth_rad_s = d.observer_bandwidth_rad_s,
        .used_ticks = drive->used_ticks,
        .worst_ticks = drive->worst_ticks,
        .available_ticks = 2u * drive->control_parameters.period_ticks,
        .late_interrupts = drive->late_interrupts,
        .last_fault = machine->record,
    };
    for (unsigned phase = 0; phase < TELEMETRY_PHASES; phase++) {
        s.current_q9[phase] = d.current_q9[phase];
    }
    return s;
}

/* Forgets a command whose sender fell silent long ago: the clock wraps, and then its age would look small again. Twice
 * the timeout, so that the interrupt has seen the timeout before. */
static void forget_stale_command(drive_t *drive, uint32_t time_us) {
    const uint32_t age_us = time_us - drive->sample.command.time_us;
    if (drive->sample.command.request != COMMAND_OFF &&
        age_us > 2u * drive->control_parameters.protection.command_timeout_us) {
        hal_critical_enter(drive->hal);
        drive->sample.command.request = COMMAND_OFF;
        hal_critical_leave(drive->hal);
    }
}

void drive_background(drive_t *drive) {
    const uint32_t time_us = hal_time_us(drive->hal);
    if (comms_telemetry_due(&drive->comms, time_us)) {
        hal_critical_enter(drive->hal);
        const telemetry_snapshot_t s = snapshot(drive, time_us);
        hal_critical_leave(drive->hal);
        comms_telemetry(&drive->comms, drive->hal, &s);
    }
    /* Enumerations are read in one access: the interrupt may change the state, not tear it. */
    const bool writable = drive->control.machine.state != DRIVE_STATE_RUN;
    if (comms_background(&drive->comms, drive->hal, &drive->parameters, writable, time_us)) {
        hal_critical_enter(drive->hal);
        drive->sample.command = drive->comms.command;
        hal_critical_leave(drive->hal);
    }
    forget_stale_command(drive, time_us);
    if (drive->parameters.changes != drive->configured_changes) {
        configure(drive);
    }
}
