#include "drive/drive.h"

#include <string.h>

#include "comms/node.h"
#include "control/modulator.h"
#include "control/position/position_configure.h"
#include "drive/background_checks.h"
#include "drive/telemetry_collect.h"
#include "fixed/compiler.h"
#include "fixed/divide.h"
#include "fixed/fixed.h"
#include "hal_encoder.h"
#include "hal_interrupt.h"
#include "hal_time.h"
#include "hal_watchdog.h"
#include "interrupts/deferred.h"
#include "interrupts/speed_control.h"
#include "interrupts/unmasked_read.h"

/* Resolution of the processor times in telemetry: 5 ns. */
#define PROCESSOR_TIME_HZ 200000000

/* True while the drive does not run and cannot begin to: a run starts with a command that only the background
 * publishes. [SR-56] */
static bool may_configure(const drive_t *drive) {
    return drive->control.state_machine.state != DRIVE_STATE_RUN && !command_needs_arming(drive->command.request);
}

/* Applies the parameters in one piece between two control periods; in a run or beside the command that starts one, in
 * parts, those that may then be changed, which are all that differ. [SR-56] */
COLD static void configure(drive_t *drive, hal_t *hal) {
    control_parameters_t control_parameters =
        configure_control(&drive->parameters, &machine_tables, drive->parameters.control_rate_hz, hal_encoder_bits(hal),
                          hal_adc_bits(hal), hal_pwm_clock_hz(hal));
    control_parameters.thermal = thermal_configure(drive->parameters.values);
    control_parameters.temperature = temperature_configure(drive->parameters.values);
    if (may_configure(drive)) {
        background_checks_reconfigure(drive, &control_parameters);
    }
    hal_critical_enter(hal);
    if (may_configure(drive)) {
        drive->control_parameters = control_parameters;
        control_prepare(&drive->control_parameters, &drive->control);
    } else {
        for (unsigned part = 0; part < CONFIGURE_TUNE_PARTS + DEFERRED_TUNE_PARTS; part++) {
            hal_critical_leave(hal);
            hal_critical_enter(hal);
            if (part < CONFIGURE_TUNE_PARTS) {
                configure_tune(&drive->control_parameters, &control_parameters, part);
            } else {
                deferred_tune(&drive->control_parameters, &drive->control, part - CONFIGURE_TUNE_PARTS);
            }
        }
    }
    drive->applied_revision = drive->parameters.revision;
    hal_critical_leave(hal);
    self_test_configured(&drive->self_test, &drive->control_parameters);
}

/* [SR-48] [SR-53] [SR-58] */
COLD bool drive_init(drive_t *drive, hal_t *hal, const drive_config_t *config) {
    const uint32_t clock_hz = hal_pwm_clock_hz(hal);
    if (!configure_rate_allowed(config->control_rate_hz, clock_hz) ||
        config->control_rate_hz < machine_tables.control_rate_min_hz || config->node > NODE_MAX) {
        return false;
    }
    (void)memset(drive, 0, sizeof *drive); /* a structure of this size as a value would be a copy on the stack */
    drive->processor_time_q24 = (uint32_t)fixed_divide((int64_t)PROCESSOR_TIME_HZ << 24, clock_hz);
    self_test_init(&drive->self_test, hal, hal_time_us(hal));
    temperature_init(&drive->temperature, hal_time_us(hal));
    parameters_init(&drive->parameters);
    parameters_set_control_rate(&drive->parameters, config->control_rate_hz);
    parameters_set_controller(&drive->parameters, (int32_t)config->controller);
    parameters_set(&drive->parameters, PARAMETER_PROTOCOL, (int32_t)config->canopen_node);
    if (config->telemetry_period_ms != 0) {
        parameters_set(&drive->parameters, PARAMETER_TELEMETRY_PERIOD_MS, (int32_t)config->telemetry_period_ms);
    }
    nvm_store_init(&drive->store, hal, &drive->parameters);
    if (config->stored_tables) {
        table_store_init(&drive->tables, hal);
    }
    comms_init(&drive->comms, config->node, hal_time_us(hal));
    comms_choose(&drive->comms, drive->parameters.values[PARAMETER_PROTOCOL], hal_time_us(hal));
    drive->thermal.step_us = hal_time_us(hal) - THERMAL_STEP_US / 2u; /* halfway between two telemetry cycles */
    xcp_init(&drive->comms.xcp, drive, DRIVE_WORDS, &drive->sampler);
    table_scale_reset(&drive->table_scale);
    configure(drive, hal);
    control_reset(&drive->control_parameters, &drive->control);
    drive->control.reported_fault_mask = self_test_faults(&drive->self_test);
    if (drive->store.inhibited) {
        drive->control.reported_fault_mask |= (uint32_t)FAULT_BIT(FAULT_PARAMETER_MEMORY);
    }
    const uint64_t at_start = (hal_reset_cause(hal) == HAL_RESET_WATCHDOG ? FAULT_BIT(FAULT_WATCHDOG) : 0) |
                              self_test_faults(&drive->self_test);
    if (at_start != 0) {
        state_machine_start_in_fault(&drive->control.state_machine, at_start);
    }
    hal_pwm_open_all(hal);
    hal_pwm_start(hal, drive->control_parameters.period_ticks);
    hal_watchdog_start(hal);
    return true;
}

static inline fault_trace_values_t trace_values(const drive_t *drive, const hal_adc_sample_t *adc) {
    return (fault_trace_values_t){
        .adc = adc,
        .compare = &drive->compare,
        .angle = drive->control.measurement.angle,
        .speed_q22 = drive->control.observer.speed_q22,
        .torque_reference_q24 = drive->control.torque_reference_q24,
    };
}

/* A period of an experiment. */
NOINLINE static void experiment(drive_t *drive, hal_t *hal, const hal_adc_sample_t *adc, uint32_t time_us) {
    control_state_t *control = &drive->control;
    const control_parameters_t *parameters = &drive->control_parameters;
    const identify_parameters_t identify_parameters = {
        .limit_q9 = parameters->duty.current_limit_q9,
        .periods_per_ms = parameters->initialise_ticks,
        .phases = machine_tables.phases,
    };
    const identify_sample_t sample = {
        .current_q9 = control->measurement.current_q9,
        .dc_link_q6 = control->measurement.dc_link_voltage_q6,
        .angle = control->measurement.encoder_angle,
    };
    if (!drive->identify.begun) {
        identify_begin(&drive->identify, sample.angle, parameters->torque_law == TORQUE_LAW_PREDICTIVE);
    }
    identify_step(&identify_parameters, &drive->identify, &sample, control->duty_q15);
    modulate(control->duty_q15, machine_tables.phases, parameters->period_ticks, false, &drive->compare);
    hal_pwm_write(hal, &drive->compare);
    const fault_trace_values_t values = trace_values(drive, adc);
    fault_trace_run(&drive->trace, &values);
    if (drive->identify.records && drive->sampler.event == SAMPLER_EVENT_IDENTIFY) {
        sampler_record(&drive->sampler, drive, DRIVE_WORDS, time_us, 0);
    }
}

/* [SR-39] */
void drive_control_interrupt(drive_t *drive, hal_t *hal) {
    hal_adc_sample_t adc;
    control_sample_t sample = {
        .adc = &adc,
        .missed_interrupts = hal_interrupt_missed_triggers(hal),
        .time_us = hal_time_us(hal),
    };
    drive->break_causes = sample.break_causes = hal_pwm_break(hal);
    hal_encoder_read(hal, &sample.encoder);
    hal_adc_read(hal, &adc);
    const bool run =
        control_step(&drive->control_parameters, &drive->control, &sample, &drive->command, &drive->compare);
    if (run) {
        hal_pwm_write(hal, &drive->compare);
        const fault_trace_values_t values = trace_values(drive, &adc);
        fault_trace_run(&drive->trace, &values);
    } else if (drive->control.state_machine.identifies) {
        experiment(drive, hal, &adc, sample.time_us);
    } else {
        drive->identify.begun = false;
        const fault_trace_values_t values = trace_values(drive, &adc);
        hal_pwm_open_all(hal);
        if (sample.break_causes != 0) {
            hal_pwm_clear_break(hal);
        }
        if (!fault_trace_kept(&drive->trace)) {
            fault_trace_stand(&drive->trace, &values, drive->control.state_machine.state);
        }
    }
    if (drive->control.deferred_request.skipped == 0) {
        hal_interrupt_request_deferred(hal);
    }
    if ((drive->sampler.event & SAMPLER_IN_CONTROL) != 0) {
        sampler_record(&drive->sampler, drive, DRIVE_WORDS, sample.time_us, drive->control.deferred_request.skipped);
    }
    drive->used_ticks = hal_interrupt_elapsed_ticks(hal);
    if (drive->used_ticks > drive->worst_ticks) {
        drive->worst_ticks = drive->used_ticks;
    }
}

/* Ticks from the trigger of the control interrupt that requested the pending deferred step. The control interrupt may
 * pre-empt this function: then the next one is a whole period away from the second attempt. */
static uint32_t deferred_elapsed_ticks(const drive_t *drive, const hal_t *hal) {
    const volatile uint32_t *skipped = &drive->control.deferred_request.skipped;
    uint32_t periods = *skipped;
    uint32_t elapsed = hal_interrupt_elapsed_ticks(hal);
    if (*skipped != periods) {
        periods = *skipped;
        elapsed = hal_interrupt_elapsed_ticks(hal);
    }
    return elapsed + periods * 2u * drive->control_parameters.period_ticks;
}

void drive_deferred_interrupt(drive_t *drive, hal_t *hal) {
    control_state_t *control = &drive->control;
    if (!deferred_pending(&control->deferred_request, &control->deferred.response)) {
        return;
    }
    deferred_compute(&drive->control_parameters, control, &drive->command);
    drive->deferred_used_ticks = deferred_elapsed_ticks(drive, hal);
    if (drive->deferred_used_ticks > drive->deferred_worst_ticks) {
        drive->deferred_worst_ticks = drive->deferred_used_ticks;
    }
    deferred_complete(&control->deferred_request, &control->deferred.response);
}

/* Both copies: background_checks.c compares them. [SR-34] */
COLD static void withdraw_command(drive_t *drive, hal_t *hal) {
    hal_critical_enter(hal);
    drive->command.request = COMMAND_OFF;
    hal_critical_leave(hal);
    drive->comms.command.request = COMMAND_OFF;
}

/* Withdraws a command to run that must not start a run later: without being armed. Silence disarms, so that none
 * becomes so old that the clock wraps and its age appears small again. [SR-34] */
static void drop_unarmed_command(drive_t *drive, hal_t *hal) {
    if (command_needs_arming(drive->command.request) && !drive->comms.commands.arming.armed &&
        drive->control.state_machine.state != DRIVE_STATE_RUN) {
        withdraw_command(drive, hal);
    }
}

/* Torque that the load leaves with a sixteenth in reserve, of the largest one, Q14. */
COLD static int16_t torque_left_q14(const drive_t *drive) {
    const int32_t most_q24 = fixed_max(drive->control_parameters.conduction.torque_max_q24, 1);
    const int32_t limit_q24 = fixed_min(drive->control.torque_limit_q24, most_q24);
    const int64_t left_q24 = (int64_t)limit_q24 - limit_q24 / 16 - fixed_abs(drive->control.observer.load_torque_q24);
    return (int16_t)fixed_clamp_64(fixed_divide(left_q24 * (1 << 14), most_q24), 0, INT16_MAX);
}

/* After bus-off a run request is without effect until the sender has withdrawn it: the present command ages until its
 * timeout, and a sender that simply continues does not start the drive again. [SR-38] */
COLD static void take_command(drive_t *drive, hal_t *hal) {
    const command_t *command = &drive->comms.command;
    bus_monitor_t *bus = &drive->comms.bus;
    /* The request as it was sent: bus-off disarms, and a request to run is published as off. */
    bus->run_inhibited = bus->run_inhibited && command_needs_arming(drive->comms.commands.requested.request);
    if (!bus->run_inhibited) {
        const bool positions = command->mode == DRIVE_MODE_POSITION;
        position_command_t position;
        if (positions) {
            if (drive->control.position.status.speed_reference_q22 == 0) { /* a move's inertia may look like a load */
                drive->left_q14 = torque_left_q14(drive);
            }
            position = position_command(&drive->control_parameters.position, &command->position,
                                        drive->control.deferred.inertia.ratio_q14, drive->left_q14);
            if (position.set_point.homing >= POSITION_HOMING_METHODS) {
                position.set_point.homing = (position_homing_t)drive->parameters.values[PARAMETER_HOMING_METHOD];
            }
        }
        hal_critical_enter(hal);
        if (drive->control.state_machine.identifies && command->request != COMMAND_IDENTIFY) {
            drive->comms.command.request = COMMAND_OFF; /* the laws take no run over that is not theirs */
        }
        drive->command = *command;
        if (positions) { /* long: the interrupts of the other modes do not wait for it */
            drive->control.position_command = position;
        }
        if (drive->identify.command.number != drive->comms.commands.identify.number) { /* it stays what it began as */
            drive->identify.command = drive->comms.commands.identify;
        }
        if (drive->identify.command.phase + 1u == drive->control.lost_phase) { /* whose switches stay open */
            drive->identify.command.kind = IDENTIFY_KIND_REST;
        }
        hal_critical_leave(hal);
        drive->ramping = false;
    }
}

/* Log of faults and storing of parameters. No operation of the memory in RUN, nor when the next control interrupt may
 * enter it: a command to run has been handed over. [SR-60] */
static void keep_memory(drive_t *drive, hal_t *hal, uint32_t time_us) {
    const drive_state_t state = drive->control.state_machine.state;
    if (state == DRIVE_STATE_FAULT) {
        hal_critical_enter(hal);
        fault_record_t record = drive->control.state_machine.record;
        hal_critical_leave(hal);
        record.self_test = telemetry_self_test(drive);
        record.sensors = telemetry_sensors_e_f(drive);
        record.phases = (uint8_t)drive->flux.phases;
        nvm_store_follow_fault(&drive->store, record.fault == FAULT_NONE ? NULL : &record);
    } else {
        nvm_store_follow_fault(&drive->store, NULL);
    }
    const bool writable = state == DRIVE_STATE_FAULT || may_configure(drive);
    nvm_store_step(&drive->store, hal, &drive->parameters, time_us, writable);
    table_store_step(&drive->tables, hal, writable);
}

/* The torque would carry the speed on, beyond the last reference. [SR-04] */
COLD static bool runs_away(const drive_t *drive, int32_t torque_q24) {
    const int32_t reference_q22 =
        speed_control_limited_q22(&drive->control_parameters, drive->command.speed_reference_q22);
    const int32_t above_q22 = fixed_subtract(drive->control.observer.speed_q22, reference_q22);
    const int32_t beyond_q22 = torque_q24 < 0 ? fixed_subtract(0, above_q22) : above_q22;
    return drive->ramp_of_speed && beyond_q22 > fixed_abs(reference_q22) / 16;
}

/* In a run whose commands are overdue: ramps the torque from its present value to zero, by commands of the torque mode
 * with the time of the last valid command, so that the interrupts need nothing for it. [SR-04] */
static void ramp_down(drive_t *drive, hal_t *hal, uint32_t time_us) {
    const uint32_t timeout_us = (uint32_t)drive->parameters.values[PARAMETER_COMMAND_TIMEOUT_MS] * 1000u;
    const uint32_t age_us = time_us - drive->command.time_us;
    if (drive->control.state_machine.state != DRIVE_STATE_RUN || age_us <= timeout_us) {
        return;
    }
    if (drive->command.request == COMMAND_IDENTIFY) { /* experiments have no torque to ramp */
        withdraw_command(drive, hal);
        return;
    }
    if (drive->ramping && time_us - drive->ramp_us < DRIVE_RAMP_STEP_US) {
        return;
    }
    if (!drive->ramping) {
        drive->ramping = true;
        drive->ramp_of_speed = drive->command.mode != DRIVE_MODE_TORQUE;
        drive->ramp_from_q24 = drive->control.torque_reference_q24;
    }
    drive->ramp_us = time_us;
    const uint32_t elapsed_us = age_us - timeout_us;
    const uint32_t rest_us = elapsed_us < DRIVE_RAMP_US ? DRIVE_RAMP_US - elapsed_us : 0;
    const int64_t torque_q39 = (int64_t)drive->ramp_from_q24 * (int32_t)((rest_us << 15) / DRIVE_RAMP_US);
    const int32_t torque_q24 = (int32_t)fixed_shift(torque_q39, 15);
    hal_critical_enter(hal);
    if (drive->control.state_machine.state == DRIVE_STATE_RUN) { /* it leaves RUN in an interrupt, never enters it */
        drive->command.request = COMMAND_RUN;
        drive->command.mode = DRIVE_MODE_TORQUE;
        drive->command.torque_reference_q24 = runs_away(drive, torque_q24) ? 0 : torque_q24;
    }
    hal_critical_leave(hal);
}

/* Two words of each interrupt: one that comes in between advances what is read after it, by one step. [SR-47] */
COLD static void kick_watchdog(drive_t *drive, hal_t *hal, uint32_t time_us) {
    const deferred_request_t *request = &drive->control.deferred_request;
    const volatile uint32_t *completed = &drive->control.deferred.response.completed;
    const uint32_t completed_before = *completed;
    if (watchdog_monitor_kick(&drive->watchdog, unmasked_read_periods(request), request->requests, completed_before,
                              time_us)) {
        hal_watchdog_kick(hal);
    }
}

/* Values of one control period. Interrupts are masked only when they leave the background less time than this takes. */
COLD static void collect_telemetry(drive_t *drive, hal_t *hal, uint32_t time_us, drive_telemetry_t *values) {
    const deferred_request_t *request = &drive->control.deferred_request;
    for (unsigned attempt = 0; attempt < UNMASKED_READ_ATTEMPTS; attempt++) {
        const uint32_t periods = unmasked_read_begin(request);
        telemetry_collect(drive, hal, time_us, values);
        if (unmasked_read_ended(request, periods)) {
            return;
        }
    }
    hal_critical_enter(hal);
    telemetry_collect(drive, hal, time_us, values);
    hal_critical_leave(hal);
}

/* Telemetry that is due. */
COLD NOINLINE static void send_telemetry(drive_t *drive, hal_t *hal, uint32_t time_us) {
    if (!comms_telemetry_due(&drive->comms, time_us)) {
        return;
    }
    bus_monitor_step(&drive->comms.bus, hal, time_us);
    if (drive->comms.bus.run_inhibited) {
        comms_bus_off(&drive->comms);
    }
    if (drive->comms.bus.status.state == HAL_CAN_BUS_OFF) {
        arming_end_configuration(&drive->comms.commands.arming);
    }
    drive_telemetry_t values;
    collect_telemetry(drive, hal, time_us, &values);
    comms_telemetry(&drive->comms, hal, &values);
    position_status_t *place = comms_place(&drive->comms);
    if (place != NULL) {
        hal_critical_enter(hal);
        *place = drive->control.position.status;
        hal_critical_leave(hal);
    }
}

COLD void drive_background(drive_t *drive, hal_t *hal) {
    const uint32_t time_us = hal_time_us(hal);
    background_checks(drive, hal, time_us);
    watchdog_monitor_pass(&drive->watchdog, WATCHDOG_CHECKED);
    keep_memory(drive, hal, time_us);
    watchdog_monitor_pass(&drive->watchdog, WATCHDOG_STORED);
    send_telemetry(drive, hal, time_us);
    const comms_objects_t objects = {
        .parameters = &drive->parameters,
        .conditions = {.running = !may_configure(drive),
                       .dc_link_voltage_q6 = drive->control.measurement.dc_link_voltage_q6},
        .store = &drive->store,
        .trace = &drive->trace,
        .self_test = &drive->self_test,
        .control_parameters = &drive->control_parameters,
        .tables = table_store_offered(&drive->tables) ? &drive->tables : NULL,
    };
    xcp_attach(&drive->comms.xcp, drive, DRIVE_WORDS, &drive->sampler);
    const bool commanded = comms_background(&drive->comms, hal, &objects, drive->control.state_machine.state, time_us);
    if (drive->parameters.revision != drive->applied_revision) {
        configure(drive, hal); /* before a command that was received after the parameters */
    }
    if (commanded) {
        take_command(drive, hal);
    }
    /* An end that the run before has left does not count. */
    if (drive->identify.begun && drive->identify.state == IDENTIFY_ENDED &&
        drive->command.request == COMMAND_IDENTIFY) {
        withdraw_command(drive, hal);
    }
    watchdog_monitor_pass(&drive->watchdog, WATCHDOG_SERVED);
    if (drive->sampler.event == SAMPLER_EVENT_BACKGROUND) {
        sampler_record(&drive->sampler, drive, DRIVE_WORDS, time_us, 0);
    }
    ramp_down(drive, hal, time_us);
    drop_unarmed_command(drive, hal);
    kick_watchdog(drive, hal, time_us);
}
