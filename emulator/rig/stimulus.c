#include "rig/stimulus.h"

#include "bench_variables.h"
#include "plant/units.h"
#include "rig/control_period.h"
#include "rig/dynamometer.h"
#include "rig/load.h"
#include "rig/supply.h"
#include "rig_codec.h"

static void set_encoder_fault(rig_t *rig, double fault) {
    rig->sensors.encoder_fault = (sensors_encoder_fault_t)fault;
}

static void set_sto_1(rig_t *rig, double torque_off) {
    plant_advance(&rig->plant, rig->board.time_ns);
    board_set_sto(&rig->board, 0, torque_off == 0.0);
}

static void set_sto_2(rig_t *rig, double torque_off) {
    plant_advance(&rig->plant, rig->board.time_ns);
    board_set_sto(&rig->board, 1, torque_off == 0.0);
}

static void set_interrupt_time(rig_t *rig, double time_us) {
    rig->control_period.interrupt_time_ns = (uint64_t)(time_us * (double)NS_PER_US + 0.5);
}

static void set_current_sensor_delay(rig_t *rig, double delay_us) {
    rig->sensors.errors.current_delay_ns = delay_us * (double)NS_PER_US;
    control_period_schedule_hold(&rig->control_period);
}

/* Without effect on a firmware that cannot be reset: stimulus_receive rejects it. */
static void reset_drive(rig_t *rig, double reset) {
    if (reset > 0.0) {
        control_period_reset_drive(&rig->control_period, HAL_RESET_POWER);
    }
}

static void set_memory_cut_operation(rig_t *rig, double operation) {
    rig->board.nvm.cut_after = (uint32_t)operation;
}

static void set_memory_cut_kind(rig_t *rig, double kind) {
    rig->board.nvm.cut_kind = (nvm_cut_t)kind;
}

/* On multiples of the period, so that two logs of one bench have the same instants. */
static void set_truth_period(rig_t *rig, double period_us) {
    const uint64_t period_ns = rig->truth_period_ns = (uint64_t)period_us * NS_PER_US;
    rig->scheduler.due_ns[EVENT_TRUTH] =
        period_ns > 0 ? (rig->board.time_ns / period_ns + 1) * period_ns : SCHEDULER_NEVER;
}

static void set_frame_fault(rig_t *rig, double fault) {
    rig->shared_bus.bus->faults.fault = (can_fault_t)fault;
}

static void set_frame_fault_per_mille(rig_t *rig, double per_mille) {
    rig->shared_bus.bus->faults.per_mille = per_mille;
}

static void set_frame_fault_sender(rig_t *rig, double sender) {
    rig->shared_bus.bus->faults.sender = (can_fault_sender_t)sender;
}

static void set_frame_delay(rig_t *rig, double delay_us) {
    rig->shared_bus.bus->faults.delay_ns = (uint64_t)(delay_us * (double)NS_PER_US + 0.5);
}

static void set_bus_connection(rig_t *rig, double connected) {
    can_bus_disconnect(rig->shared_bus.bus, rig->board.bus_drive, connected == 0);
}

static void set_transmit_error_counter(rig_t *rig, double errors) {
    can_bus_set_transmit_errors(rig->shared_bus.bus, rig->board.bus_drive, (unsigned)errors);
}

static void set_babble_load(rig_t *rig, double load_percent) {
    rig->shared_bus.bus->babble.load = load_percent;
    can_bus_babble(rig->shared_bus.bus, rig->board.time_ns);
}

static void set_babble_identifier(rig_t *rig, double identifier) {
    rig->shared_bus.bus->babble.identifier = (uint32_t)identifier;
    can_bus_babble(rig->shared_bus.bus, rig->board.time_ns);
}

static void set_babble_length(rig_t *rig, double length) {
    rig->shared_bus.bus->babble.length = (uint8_t)length;
    can_bus_babble(rig->shared_bus.bus, rig->board.time_ns);
}

static void set_load_torque(rig_t *rig, double torque_Nm) {
    load_set_torque(&rig->load, torque_Nm);
}

static void set_load_ramp(rig_t *rig, double rate_Nm_s) {
    load_set_ramp(&rig->load, rate_Nm_s);
}

static void set_load_sine_amplitude(rig_t *rig, double amplitude_Nm) {
    load_set_sine_amplitude(&rig->load, amplitude_Nm);
}

static void set_load_sine_frequency(rig_t *rig, double frequency_Hz) {
    load_set_sine_frequency(&rig->load, frequency_Hz);
}

static void set_load_profile(rig_t *rig, double torque_Nm) {
    load_set_profile(&rig->load, torque_Nm);
}

static void set_held_speed(rig_t *rig, double speed_rpm) {
    dynamometer_set_speed(&rig->dynamometer, speed_rpm);
}

static void set_supply_voltage(rig_t *rig, double voltage_V) {
    supply_set_voltage(&rig->supply, voltage_V);
}

static void set_supply_ripple_frequency(rig_t *rig, double frequency_Hz) {
    supply_set_ripple_frequency(&rig->supply, frequency_Hz);
}

static void set_current_sensor_gain(rig_t *rig, double gain) {
    rig->sensors.errors.current_gain = gain;
}

static void set_current_noise(rig_t *rig, double noise_A) {
    rig->sensors.errors.current_noise_A = noise_A;
}

static void set_current_sensor_offset(rig_t *rig, double offset_A) {
    rig->sensors.errors.current_offset_A = offset_A;
}

static void set_current_sensor_limit(rig_t *rig, double limit_A) {
    rig->sensors.errors.current_limit_A = limit_A;
}

static void set_encoder_eccentricity(rig_t *rig, double eccentricity_deg) {
    rig->sensors.errors.encoder_eccentricity_deg = eccentricity_deg;
}

static void set_encoder_offset(rig_t *rig, double offset_deg) {
    rig->sensors.encoder_offset_deg = offset_deg;
}

static void set_minimum_pulse(rig_t *rig, double pulse_ns) {
    rig->plant.minimum_pulse_ns = pulse_ns;
}

static void set_ambient(rig_t *rig, double ambient_C) {
    rig->heat.ambient_C = ambient_C;
}

static void set_held_winding(rig_t *rig, double held_C) {
    rig->heat.winding.held_C = held_C;
}

static void set_held_inverter(rig_t *rig, double held_C) {
    rig->heat.inverter.held_C = held_C;
}

static void set_gains(rig_t *rig, const plant_gains_t *gains) {
    plant_advance(&rig->plant, rig->board.time_ns);
    plant_set_gains(&rig->plant, gains);
}

static void set_flux_linkage_gain(rig_t *rig, double gain) {
    plant_gains_t gains = rig->plant.gains;
    gains.flux_linkage = gain;
    set_gains(rig, &gains);
}

static void set_resistance_gain(rig_t *rig, double gain) {
    plant_gains_t gains = rig->plant.gains;
    gains.resistance = gain;
    set_gains(rig, &gains);
}

static void set_inertia_gain(rig_t *rig, double gain) {
    plant_gains_t gains = rig->plant.gains;
    gains.inertia = gain;
    set_gains(rig, &gains);
}

static void set_friction_gain(rig_t *rig, double gain) {
    plant_gains_t gains = rig->plant.gains;
    gains.friction = gain;
    set_gains(rig, &gains);
}

/* The effect of each bench variable, from the present time on. */
static void (*const setters[BENCH_VARIABLE_COUNT])(rig_t *rig, double value) = {
    [BENCH_VARIABLE_LOAD_TORQUE_NM] = set_load_torque,
    [BENCH_VARIABLE_SUPPLY_VOLTAGE_V] = set_supply_voltage,
    [BENCH_VARIABLE_ENCODER_FAULT] = set_encoder_fault,
    [BENCH_VARIABLE_INTERRUPT_TIME_US] = set_interrupt_time,
    [BENCH_VARIABLE_CURRENT_SENSOR_GAIN] = set_current_sensor_gain,
    [BENCH_VARIABLE_TRUTH_PERIOD_US] = set_truth_period,
    [BENCH_VARIABLE_CURRENT_NOISE_A] = set_current_noise,
    [BENCH_VARIABLE_CURRENT_SENSOR_OFFSET_A] = set_current_sensor_offset,
    [BENCH_VARIABLE_CURRENT_SENSOR_LIMIT_A] = set_current_sensor_limit,
    [BENCH_VARIABLE_CURRENT_SENSOR_DELAY_US] = set_current_sensor_delay,
    [BENCH_VARIABLE_ENCODER_ECCENTRICITY_DEG] = set_encoder_eccentricity,
    [BENCH_VARIABLE_FLUX_LINKAGE_GAIN] = set_flux_linkage_gain,
    [BENCH_VARIABLE_RESISTANCE_GAIN] = set_resistance_gain,
    [BENCH_VARIABLE_INERTIA_GAIN] = set_inertia_gain,
    [BENCH_VARIABLE_FRICTION_GAIN] = set_friction_gain,
    [BENCH_VARIABLE_ENCODER_OFFSET_DEG] = set_encoder_offset,
    [BENCH_VARIABLE_MINIMUM_PULSE_NS] = set_minimum_pulse,
    [BENCH_VARIABLE_LOAD_RAMP_NM_S] = set_load_ramp,
    [BENCH_VARIABLE_LOAD_SINE_AMPLITUDE_NM] = set_load_sine_amplitude,
    [BENCH_VARIABLE_LOAD_SINE_FREQUENCY_HZ] = set_load_sine_frequency,
    [BENCH_VARIABLE_LOAD_PROFILE_NM] = set_load_profile,
    [BENCH_VARIABLE_HELD_SPEED_RPM] = set_held_speed,
    [BENCH_VARIABLE_SUPPLY_RIPPLE_FREQUENCY_HZ] = set_supply_ripple_frequency,
    [BENCH_VARIABLE_STO_1] = set_sto_1,
    [BENCH_VARIABLE_STO_2] = set_sto_2,
    [BENCH_VARIABLE_DRIVE_RESET] = reset_drive,
    [BENCH_VARIABLE_MEMORY_CUT_OPERATION] = set_memory_cut_operation,
    [BENCH_VARIABLE_MEMORY_CUT_KIND] = set_memory_cut_kind,
    [BENCH_VARIABLE_AMBIENT_C] = set_ambient,
    [BENCH_VARIABLE_HELD_WINDING_C] = set_held_winding,
    [BENCH_VARIABLE_HELD_INVERTER_C] = set_held_inverter,
    [BENCH_VARIABLE_LOAD_TORQUE_COARSE_NM] = set_load_torque,
    [BENCH_VARIABLE_LOAD_RAMP_COARSE_NM_S] = set_load_ramp,
    [BENCH_VARIABLE_LOAD_SINE_AMPLITUDE_COARSE_NM] = set_load_sine_amplitude,
    [BENCH_VARIABLE_FRAME_FAULT] = set_frame_fault,
    [BENCH_VARIABLE_FRAME_FAULT_PER_MILLE] = set_frame_fault_per_mille,
    [BENCH_VARIABLE_FRAME_FAULT_SENDER] = set_frame_fault_sender,
    [BENCH_VARIABLE_FRAME_DELAY_US] = set_frame_delay,
    [BENCH_VARIABLE_BUS_CONNECTION] = set_bus_connection,
    [BENCH_VARIABLE_TRANSMIT_ERROR_COUNTER] = set_transmit_error_counter,
    [BENCH_VARIABLE_BABBLE_LOAD_PERCENT] = set_babble_load,
    [BENCH_VARIABLE_BABBLE_IDENTIFIER] = set_babble_identifier,
    [BENCH_VARIABLE_BABBLE_LENGTH] = set_babble_length,
};

static void apply(rig_t *rig, const stimulus_t *stimulus) {
    setters[stimulus->variable](rig, stimulus->value);
}

static void schedule(rig_t *rig) {
    rig->scheduler.due_ns[EVENT_BENCH_VARIABLE] = stimulus_queue_next_ns(&rig->stimuli);
}

void stimulus_event(void *context, uint64_t now_ns) {
    (void)now_ns;
    rig_t *rig = context;
    const stimulus_t stimulus = stimulus_queue_pop(&rig->stimuli);
    schedule(rig);
    apply(rig, &stimulus);
    shared_bus_start(&rig->shared_bus);
}

stimulus_reply_t stimulus_receive(rig_t *rig, const uint8_t *data) {
    struct rig_set_t message = {0};
    rig_set_unpack(&message, data, RIG_SET_LENGTH);
    stimulus_reply_t reply = {
        .variable = message.quantity, .status = RIG_SET_REPLY_STATUS_DONE_CHOICE, .at_us = message.at_us};
    const bool resets = message.quantity == BENCH_VARIABLE_DRIVE_RESET;
    if (message.quantity >= BENCH_VARIABLE_COUNT || !bench_variables[message.quantity].name ||
        (resets && !rig->control_period.firmware.restart)) {
        reply.status = RIG_SET_REPLY_STATUS_NO_SUCH_QUANTITY_CHOICE;
        return reply;
    }
    const bench_variable_t *variable = &bench_variables[message.quantity];
    const int32_t raw = bench_variable_raw(data);
    const stimulus_t stimulus = {
        .at_ns = message.at_us * NS_PER_US, .variable = message.quantity, .value = (double)raw * variable->scale};
    if (raw < variable->raw_minimum || raw > variable->raw_maximum) {
        reply.status = RIG_SET_REPLY_STATUS_OUT_OF_RANGE_CHOICE;
    } else if (message.at_us == 0 || stimulus.at_ns == rig->board.time_ns) {
        apply(rig, &stimulus);
    } else if (stimulus.at_ns < rig->board.time_ns) {
        reply.status = RIG_SET_REPLY_STATUS_IN_THE_PAST_CHOICE;
    } else if (!stimulus_queue_push(&rig->stimuli, &stimulus)) {
        reply.status = RIG_SET_REPLY_STATUS_QUEUE_FULL_CHOICE;
    }
    schedule(rig);
    return reply;
}
