#include "rig/stimulus.h"

#include <stddef.h>

#include "bench_variables.h"
#include "rig/bus_events.h"
#include "rig/control_period.h"
#include "rig/dynamometer.h"
#include "rig/load.h"
#include "rig/supply.h"
#include "rig_codec.h"

#define NS_PER_US UINT64_C(1000)

/* What a bench variable changes: a function's work, a machine parameter that plant_set_gains scales, or a double of
 * the rig. One of the three; the offsets are one above offsetof, so that 0 is none. */
typedef struct {
    void (*set)(rig_t *rig, double value);
    size_t gain;   /* in plant_gains_t */
    size_t member; /* in rig_t */
} target_t;

#define GAIN(field)                                                                                                    \
    { .gain = offsetof(plant_gains_t, field) + 1 }
#define MEMBER(field)                                                                                                  \
    { .member = offsetof(rig_t, field) + 1 }

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
    rig->interrupt_time_ns = (uint64_t)(time_us * (double)NS_PER_US + 0.5);
}

static void set_current_sensor_delay(rig_t *rig, double delay_us) {
    rig->sensors.errors.current_delay_ns = delay_us * (double)NS_PER_US;
    control_period_schedule_hold(rig);
}

/* Without effect on a firmware that cannot be reset: stimulus_receive rejects it. */
static void reset_drive(rig_t *rig, double reset) {
    if (reset > 0.0) {
        rig_reset_drive(rig, HAL_RESET_POWER);
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
    rig->first->bus.faults.fault = (can_fault_t)fault;
}

static void set_frame_fault_per_mille(rig_t *rig, double per_mille) {
    rig->first->bus.faults.per_mille = per_mille;
}

static void set_frame_fault_sender(rig_t *rig, double sender) {
    rig->first->bus.faults.sender = (can_fault_sender_t)sender;
}

static void set_frame_delay(rig_t *rig, double delay_us) {
    rig->first->bus.faults.delay_ns = (uint64_t)(delay_us * (double)NS_PER_US + 0.5);
}

static void set_bus_connection(rig_t *rig, double connected) {
    can_bus_disconnect(&rig->first->bus, rig->board.bus_drive, connected == 0);
}

static void set_transmit_error_counter(rig_t *rig, double errors) {
    can_bus_set_transmit_errors(&rig->first->bus, rig->board.bus_drive, (unsigned)errors);
}

static void set_babble_load(rig_t *rig, double load_percent) {
    rig->first->bus.babble.load = load_percent;
    can_bus_babble(&rig->first->bus, rig->board.time_ns);
}

static void set_babble_identifier(rig_t *rig, double identifier) {
    rig->first->bus.babble.identifier = (uint32_t)identifier;
    can_bus_babble(&rig->first->bus, rig->board.time_ns);
}

static void set_babble_length(rig_t *rig, double length) {
    rig->first->bus.babble.length = (uint8_t)length;
    can_bus_babble(&rig->first->bus, rig->board.time_ns);
}

static const target_t targets[BENCH_VARIABLE_COUNT] = {
    [BENCH_VARIABLE_LOAD_TORQUE_NM] = {.set = load_set_torque},
    [BENCH_VARIABLE_SUPPLY_VOLTAGE_V] = {.set = supply_set_voltage},
    [BENCH_VARIABLE_ENCODER_FAULT] = {.set = set_encoder_fault},
    [BENCH_VARIABLE_INTERRUPT_TIME_US] = {.set = set_interrupt_time},
    [BENCH_VARIABLE_CURRENT_SENSOR_GAIN] = MEMBER(sensors.errors.current_gain),
    [BENCH_VARIABLE_TRUTH_PERIOD_US] = {.set = set_truth_period},
    [BENCH_VARIABLE_CURRENT_NOISE_A] = MEMBER(sensors.errors.current_noise_A),
    [BENCH_VARIABLE_CURRENT_SENSOR_OFFSET_A] = MEMBER(sensors.errors.current_offset_A),
    [BENCH_VARIABLE_CURRENT_SENSOR_LIMIT_A] = MEMBER(sensors.errors.current_limit_A),
    [BENCH_VARIABLE_CURRENT_SENSOR_DELAY_US] = {.set = set_current_sensor_delay},
    [BENCH_VARIABLE_ENCODER_ECCENTRICITY_DEG] = MEMBER(sensors.errors.encoder_eccentricity_deg),
    [BENCH_VARIABLE_FLUX_LINKAGE_GAIN] = GAIN(flux_linkage),
    [BENCH_VARIABLE_RESISTANCE_GAIN] = GAIN(resistance),
    [BENCH_VARIABLE_INERTIA_GAIN] = GAIN(inertia),
    [BENCH_VARIABLE_FRICTION_GAIN] = GAIN(friction),
    [BENCH_VARIABLE_ENCODER_OFFSET_DEG] = MEMBER(sensors.encoder_offset_deg),
    [BENCH_VARIABLE_MINIMUM_PULSE_NS] = MEMBER(plant.minimum_pulse_ns),
    [BENCH_VARIABLE_LOAD_RAMP_NM_S] = {.set = load_set_ramp},
    [BENCH_VARIABLE_LOAD_SINE_AMPLITUDE_NM] = {.set = load_set_sine_amplitude},
    [BENCH_VARIABLE_LOAD_SINE_FREQUENCY_HZ] = {.set = load_set_sine_frequency},
    [BENCH_VARIABLE_LOAD_PROFILE_NM] = {.set = load_set_profile},
    [BENCH_VARIABLE_HELD_SPEED_RPM] = {.set = dynamometer_set_speed},
    [BENCH_VARIABLE_SUPPLY_RIPPLE_FREQUENCY_HZ] = {.set = supply_set_ripple_frequency},
    [BENCH_VARIABLE_STO_1] = {.set = set_sto_1},
    [BENCH_VARIABLE_STO_2] = {.set = set_sto_2},
    [BENCH_VARIABLE_DRIVE_RESET] = {.set = reset_drive},
    [BENCH_VARIABLE_MEMORY_CUT_OPERATION] = {.set = set_memory_cut_operation},
    [BENCH_VARIABLE_MEMORY_CUT_KIND] = {.set = set_memory_cut_kind},
    [BENCH_VARIABLE_AMBIENT_C] = MEMBER(heat.ambient_C),
    [BENCH_VARIABLE_HELD_WINDING_C] = MEMBER(heat.winding.held_C),
    [BENCH_VARIABLE_HELD_INVERTER_C] = MEMBER(heat.inverter.held_C),
    [BENCH_VARIABLE_LOAD_TORQUE_COARSE_NM] = {.set = load_set_torque},
    [BENCH_VARIABLE_LOAD_RAMP_COARSE_NM_S] = {.set = load_set_ramp},
    [BENCH_VARIABLE_LOAD_SINE_AMPLITUDE_COARSE_NM] = {.set = load_set_sine_amplitude},
    [BENCH_VARIABLE_FRAME_FAULT] = {.set = set_frame_fault},
    [BENCH_VARIABLE_FRAME_FAULT_PER_MILLE] = {.set = set_frame_fault_per_mille},
    [BENCH_VARIABLE_FRAME_FAULT_SENDER] = {.set = set_frame_fault_sender},
    [BENCH_VARIABLE_FRAME_DELAY_US] = {.set = set_frame_delay},
    [BENCH_VARIABLE_BUS_CONNECTION] = {.set = set_bus_connection},
    [BENCH_VARIABLE_TRANSMIT_ERROR_COUNTER] = {.set = set_transmit_error_counter},
    [BENCH_VARIABLE_BABBLE_LOAD_PERCENT] = {.set = set_babble_load},
    [BENCH_VARIABLE_BABBLE_IDENTIFIER] = {.set = set_babble_identifier},
    [BENCH_VARIABLE_BABBLE_LENGTH] = {.set = set_babble_length},
};

static void apply(rig_t *rig, const stimulus_t *stimulus) {
    const target_t *target = &targets[stimulus->variable];
    if (target->set) {
        target->set(rig, stimulus->value);
    } else if (target->gain > 0) {
        plant_gains_t gains = rig->plant.gains;
        *(double *)((char *)&gains + (target->gain - 1)) = stimulus->value;
        plant_advance(&rig->plant, rig->board.time_ns);
        plant_set_gains(&rig->plant, &gains);
    } else if (target->member > 0) {
        *(double *)((char *)rig + (target->member - 1)) = stimulus->value;
    }
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
    bus_start(rig);
}

stimulus_reply_t stimulus_receive(rig_t *rig, const uint8_t *data) {
    struct rig_set_t message = {0};
    rig_set_unpack(&message, data, RIG_SET_LENGTH);
    stimulus_reply_t reply = {
        .variable = message.quantity, .status = RIG_SET_REPLY_STATUS_DONE_CHOICE, .at_us = message.at_us};
    const bool resets = message.quantity == BENCH_VARIABLE_DRIVE_RESET;
    if (message.quantity >= BENCH_VARIABLE_COUNT || !bench_variables[message.quantity].name ||
        (resets && !rig->firmware.restart)) {
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
