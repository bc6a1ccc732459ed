#include "rig/faults.h"

#include <string.h>

#include "fault_kinds.h"
#include "plant/units.h"
#include "rig/control_period.h"
#include "rig/dynamometer.h"
#include "rig/load.h"
#include "rig/memory_flips.h"
#include "rig/supply.h"
#include "rig/truth.h"
#include "rig_codec.h"

#define PERCENT 0.01

_Static_assert(FAULT_COUNT <= FAULT_KINDS_MAX, "room for every kind");

/* Kind and place of a fault as one number, for the queue. */
static unsigned pack(const fault_request_t *request) {
    return request->kind | (unsigned)request->phase << 8 | (unsigned)request->leg << 11 |
           (unsigned)request->begins << 12;
}

void faults_init(rig_t *rig) {
    rig->faults.changes.count = 0;
    memset(&rig->faults.present, 0, sizeof rig->faults.present);
}

static const fault_presence_t *at(const rig_t *rig, unsigned kind, unsigned phase, unsigned leg) {
    return &rig->faults.present[kind][phase][leg];
}

static bool present(const rig_t *rig, unsigned kind) {
    return at(rig, kind, 0, 0)->present;
}

/* The attribute of a fault without a place, 0 while it is absent. */
static double value(const rig_t *rig, unsigned kind) {
    return present(rig, kind) ? at(rig, kind, 0, 0)->value : 0.0;
}

/* Phases at which a kind is present, bit j phase j. */
static uint8_t phases(const rig_t *rig, unsigned kind, unsigned leg) {
    unsigned mask = 0;
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        mask |= (unsigned)at(rig, kind, phase, leg)->present << phase;
    }
    return (uint8_t)mask;
}

static half_bridge_switches_t legs(const rig_t *rig, unsigned kind) {
    return (half_bridge_switches_t){.upper = phases(rig, kind, 1), .lower = phases(rig, kind, 0)};
}

/* --- Effects: each sets a part of the rig from the faults that are present --- */

static void apply_plant(rig_t *rig) {
    const uint8_t without_gates = phases(rig, FAULT_GATE_SUPPLY_LOST, 0);
    plant_faults_t faults = {
        .winding_open = phases(rig, FAULT_WINDING_OPEN, 0),
        .switch_open = legs(rig, FAULT_SWITCH_OPEN),
        .switch_shorted = legs(rig, FAULT_SWITCH_SHORTED),
        .diode_open = legs(rig, FAULT_DIODE_OPEN),
        .chopper_open = present(rig, FAULT_CHOPPER_OPEN),
        .coulomb_Nm = value(rig, FAULT_COULOMB_FRICTION),
        .static_Nm = value(rig, FAULT_STATIC_FRICTION),
    };
    faults.switch_open.upper |= without_gates;
    faults.switch_open.lower |= without_gates;
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        const fault_presence_t *shorted = at(rig, FAULT_WINDING_SHORTED, phase, 0);
        faults.shorted_turns[phase] = shorted->present ? PERCENT * shorted->value : 0.0;
        const fault_presence_t *earth = at(rig, FAULT_WINDING_TO_EARTH, phase, 0);
        faults.earth_ohm[phase] = earth->present ? earth->value : 0.0;
    }
    plant_set_faults(&rig->plant, &faults);
}

/* Kinds of faults of one analogue input. */
typedef struct {
    unsigned open, stuck, low, high, gain, offset;
} input_kinds_t;

static sensors_input_fault_t input_fault(const rig_t *rig, const input_kinds_t *kinds, unsigned phase) {
    const fault_presence_t *stuck = at(rig, kinds->stuck, phase, 0);
    const fault_presence_t *gain = at(rig, kinds->gain, phase, 0), *offset = at(rig, kinds->offset, phase, 0);
    const bool low = at(rig, kinds->open, phase, 0)->present || at(rig, kinds->low, phase, 0)->present;
    const bool high = at(rig, kinds->high, phase, 0)->present;
    return (sensors_input_fault_t){
        .held = stuck->present || low || high,
        .code = high  ? UINT16_MAX
                : low ? 0
                      : (uint16_t)stuck->value,
        .scaled = gain->present || offset->present,
        .gain = gain->present ? gain->value : 1.0,
        .offset = offset->present ? offset->value : 0.0,
    };
}

static void apply_current_sensors(rig_t *rig) {
    static const input_kinds_t kinds = {FAULT_CURRENT_SENSOR_OPEN,     FAULT_CURRENT_SENSOR_STUCK,
                                        FAULT_CURRENT_SENSOR_LOW_RAIL, FAULT_CURRENT_SENSOR_HIGH_RAIL,
                                        FAULT_CURRENT_SENSOR_GAIN,     FAULT_CURRENT_SENSOR_OFFSET};
    unsigned *line = rig->sensors.current_line;
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        rig->sensors.current_fault[phase] = input_fault(rig, &kinds, phase);
        line[phase] = phase;
    }
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        const fault_presence_t *swapped = at(rig, FAULT_CURRENT_SENSOR_SWAPPED, phase, 0);
        if (swapped->present) {
            const unsigned other = (unsigned)swapped->value, own = line[phase];
            line[phase] = line[other];
            line[other] = own;
        }
    }
}

static void apply_dc_link_sensor(rig_t *rig) {
    static const input_kinds_t kinds = {FAULT_DC_LINK_SENSOR_OPEN,     FAULT_DC_LINK_SENSOR_STUCK,
                                        FAULT_DC_LINK_SENSOR_LOW_RAIL, FAULT_DC_LINK_SENSOR_HIGH_RAIL,
                                        FAULT_DC_LINK_SENSOR_GAIN,     FAULT_DC_LINK_SENSOR_OFFSET};
    rig->sensors.dc_link_fault = input_fault(rig, &kinds, 0);
}

static void apply_encoder(rig_t *rig) {
    const sensors_encoder_faults_t faults = {
        .stuck = present(rig, FAULT_ENCODER_STUCK),
        .no_answer = present(rig, FAULT_ENCODER_NO_ANSWER),
        .reversed = present(rig, FAULT_ENCODER_REVERSED),
        .jump_deg = value(rig, FAULT_ENCODER_JUMP),
        .noise_deg = value(rig, FAULT_ENCODER_NOISE),
        .slip_deg_s = value(rig, FAULT_ENCODER_SLIP),
        .lost_counts_per_turn = value(rig, FAULT_ENCODER_LOST_COUNTS),
    };
    sensors_set_encoder_faults(&rig->sensors, &rig->plant, &faults);
}

static void apply_supply(rig_t *rig) {
    const double factor = 1.0 - PERCENT * value(rig, FAULT_SUPPLY_SAGGED) + PERCENT * value(rig, FAULT_SUPPLY_SURGED);
    supply_set_fault(&rig->supply, present(rig, FAULT_SUPPLY_LOST) ? 0.0 : factor,
                     present(rig, FAULT_SUPPLY_LOST) ? 0.0 : value(rig, FAULT_SUPPLY_RIPPLE));
}

static void apply_lock(rig_t *rig) {
    dynamometer_lock(&rig->dynamometer, present(rig, FAULT_SHAFT_LOCKED));
}

static void apply_load(rig_t *rig) {
    load_drop(&rig->load, present(rig, FAULT_LOAD_DROPPED));
}

static void apply_processor(rig_t *rig) {
    const bool storm = present(rig, FAULT_INTERRUPT_STORM);
    rig->control_period.interrupts_lost = present(rig, FAULT_INTERRUPT_LOST) || storm;
    rig->control_period.background_hung = present(rig, FAULT_BACKGROUND_HUNG) || storm;
    rig->control_period.interrupt_late_ns = (uint64_t)value(rig, FAULT_INTERRUPT_LATE) * NS_PER_US;
}

static void apply_temperature_sensors(rig_t *rig) {
    static const input_kinds_t kinds[] = {
        {.high = FAULT_WINDING_TEMPERATURE_SENSOR_OPEN,
         .low = FAULT_WINDING_TEMPERATURE_SENSOR_SHORTED,
         .stuck = FAULT_WINDING_TEMPERATURE_SENSOR_STUCK,
         .offset = FAULT_WINDING_TEMPERATURE_SENSOR_OFFSET},
        {.high = FAULT_INVERTER_TEMPERATURE_SENSOR_OPEN,
         .low = FAULT_INVERTER_TEMPERATURE_SENSOR_SHORTED,
         .stuck = FAULT_INVERTER_TEMPERATURE_SENSOR_STUCK,
         .offset = FAULT_INVERTER_TEMPERATURE_SENSOR_OFFSET},
    };
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) { /* kind 0 is no fault: neither open nor gain */
        rig->heat.winding.sensor_fault[phase] = input_fault(rig, &kinds[0], phase);
        rig->heat.inverter.sensor_fault[phase] = input_fault(rig, &kinds[1], phase);
    }
}

/* Kinds of flipped bits by object. */
static const unsigned flip_kinds[MEMORY_OBJECTS] = {
    [MEMORY_LIMITS] = FAULT_LIMIT_FLIPPED, [MEMORY_CONSTANTS] = FAULT_CONSTANT_FLIPPED,
    [MEMORY_STATE] = FAULT_STATE_FLIPPED,  [MEMORY_FAULT_LATCH] = FAULT_FAULT_LATCH_FLIPPED,
    [MEMORY_CODE] = FAULT_CODE_FLIPPED,    [MEMORY_STACK_GUARD] = FAULT_STACK_GUARD_FLIPPED,
};

static void apply_flips(rig_t *rig) {
    control_period_t *period = &rig->control_period;
    for (unsigned object = 0; object < MEMORY_OBJECTS; object++) {
        memory_flips_set(&period->flips, &period->firmware, (memory_object_t)object, present(rig, flip_kinds[object]),
                         (uint32_t)value(rig, flip_kinds[object]));
    }
}

static uint16_t flipped_period_ticks(const rig_t *rig, double bit) {
    return (uint16_t)(rig->board.period_written ^ 1u << (unsigned)bit);
}

static void apply_period_register(rig_t *rig) {
    rig->board.period_ticks = present(rig, FAULT_PERIOD_REGISTER_FLIPPED)
                                  ? flipped_period_ticks(rig, value(rig, FAULT_PERIOD_REGISTER_FLIPPED))
                                  : rig->board.period_written;
    control_period_set_length(&rig->control_period);
}

static void apply_clock(rig_t *rig) {
    board_set_reference_rate(&rig->board, 1.0 + PERCENT * value(rig, FAULT_CLOCK_DRIFT));
}

typedef void (*effect_t)(rig_t *rig);

static const effect_t effects[FAULT_COUNT] = {
    [FAULT_WINDING_OPEN] = apply_plant,
    [FAULT_SWITCH_OPEN] = apply_plant,
    [FAULT_SWITCH_SHORTED] = apply_plant,
    [FAULT_DIODE_OPEN] = apply_plant,
    [FAULT_GATE_SUPPLY_LOST] = apply_plant,
    [FAULT_WINDING_SHORTED] = apply_plant,
    [FAULT_WINDING_TO_EARTH] = apply_plant,
    [FAULT_CURRENT_SENSOR_OPEN] = apply_current_sensors,
    [FAULT_CURRENT_SENSOR_STUCK] = apply_current_sensors,
    [FAULT_CURRENT_SENSOR_LOW_RAIL] = apply_current_sensors,
    [FAULT_CURRENT_SENSOR_HIGH_RAIL] = apply_current_sensors,
    [FAULT_CURRENT_SENSOR_GAIN] = apply_current_sensors,
    [FAULT_CURRENT_SENSOR_OFFSET] = apply_current_sensors,
    [FAULT_CURRENT_SENSOR_SWAPPED] = apply_current_sensors,
    [FAULT_DC_LINK_SENSOR_OPEN] = apply_dc_link_sensor,
    [FAULT_DC_LINK_SENSOR_STUCK] = apply_dc_link_sensor,
    [FAULT_DC_LINK_SENSOR_LOW_RAIL] = apply_dc_link_sensor,
    [FAULT_DC_LINK_SENSOR_HIGH_RAIL] = apply_dc_link_sensor,
    [FAULT_DC_LINK_SENSOR_GAIN] = apply_dc_link_sensor,
    [FAULT_DC_LINK_SENSOR_OFFSET] = apply_dc_link_sensor,
    [FAULT_ENCODER_STUCK] = apply_encoder,
    [FAULT_ENCODER_JUMP] = apply_encoder,
    [FAULT_ENCODER_LOST_COUNTS] = apply_encoder,
    [FAULT_ENCODER_NOISE] = apply_encoder,
    [FAULT_ENCODER_REVERSED] = apply_encoder,
    [FAULT_ENCODER_SLIP] = apply_encoder,
    [FAULT_ENCODER_NO_ANSWER] = apply_encoder,
    [FAULT_SHAFT_LOCKED] = apply_lock,
    [FAULT_COULOMB_FRICTION] = apply_plant,
    [FAULT_STATIC_FRICTION] = apply_plant,
    [FAULT_LOAD_DROPPED] = apply_load,
    [FAULT_SUPPLY_LOST] = apply_supply,
    [FAULT_SUPPLY_SAGGED] = apply_supply,
    [FAULT_SUPPLY_SURGED] = apply_supply,
    [FAULT_SUPPLY_RIPPLE] = apply_supply,
    [FAULT_CHOPPER_OPEN] = apply_plant,
    [FAULT_INTERRUPT_LOST] = apply_processor,
    [FAULT_BACKGROUND_HUNG] = apply_processor,
    [FAULT_WINDING_TEMPERATURE_SENSOR_OPEN] = apply_temperature_sensors,
    [FAULT_WINDING_TEMPERATURE_SENSOR_SHORTED] = apply_temperature_sensors,
    [FAULT_WINDING_TEMPERATURE_SENSOR_STUCK] = apply_temperature_sensors,
    [FAULT_WINDING_TEMPERATURE_SENSOR_OFFSET] = apply_temperature_sensors,
    [FAULT_INVERTER_TEMPERATURE_SENSOR_OPEN] = apply_temperature_sensors,
    [FAULT_INVERTER_TEMPERATURE_SENSOR_SHORTED] = apply_temperature_sensors,
    [FAULT_INVERTER_TEMPERATURE_SENSOR_STUCK] = apply_temperature_sensors,
    [FAULT_INVERTER_TEMPERATURE_SENSOR_OFFSET] = apply_temperature_sensors,
    [FAULT_LIMIT_FLIPPED] = apply_flips,
    [FAULT_CONSTANT_FLIPPED] = apply_flips,
    [FAULT_STATE_FLIPPED] = apply_flips,
    [FAULT_FAULT_LATCH_FLIPPED] = apply_flips,
    [FAULT_CODE_FLIPPED] = apply_flips,
    [FAULT_STACK_GUARD_FLIPPED] = apply_flips,
    [FAULT_PERIOD_REGISTER_FLIPPED] = apply_period_register,
    [FAULT_CLOCK_DRIFT] = apply_clock,
    [FAULT_INTERRUPT_LATE] = apply_processor,
    [FAULT_INTERRUPT_STORM] = apply_processor,
};

/* --- Requests --- */

static void change(rig_t *rig, unsigned packed, double attribute) {
    const unsigned kind = packed & 0xFFu, phase = packed >> 8 & 7u, leg = packed >> 11 & 1u;
    const bool begins = packed >> 12 & 1u;
    rig->faults.present[kind][phase][leg] = (fault_presence_t){.present = begins, .value = attribute};
    plant_advance(&rig->plant, rig->board.time_ns);
    effects[kind](rig);
    transport_frame_t frame;
    truth_pack_fault(kind, phase, leg, begins, &frame);
    transport_frame_set_node(&frame, rig->config.node);
    transport_send(rig->config.transport, rig->board.time_ns, TRANSPORT_FROM_EMULATOR, &frame);
}

static void schedule(rig_t *rig) {
    rig->scheduler.due_ns[EVENT_FAULT] = stimulus_queue_next_ns(&rig->faults.changes);
}

void faults_event(void *context, uint64_t now_ns) {
    (void)now_ns;
    rig_t *rig = context;
    const stimulus_t next = stimulus_queue_pop(&rig->faults.changes);
    schedule(rig);
    change(rig, next.variable, next.value);
}

/* Shortest half period of the timer that a drive is asked to live with: 1 us. */
#define PERIOD_TICKS_MIN 200

static bool unsupported(const rig_t *rig, const fault_request_t *request) {
    const unsigned kind = request->kind;
    if (kind == FAULT_CHOPPER_OPEN) {
        return rig->plant.machine->dc_link.capacitance_F == 0.0 ||
               rig->plant.machine->dc_link.chopper_resistance_ohm == 0.0;
    }
    if (kind == FAULT_PERIOD_REGISTER_FLIPPED) { /* the timer of a target whose instructions take time is its own */
        return !rig->control_period.firmware.restart ||
               (request->begins && flipped_period_ticks(rig, (double)request->raw) < PERIOD_TICKS_MIN);
    }
    for (unsigned object = 0; object < MEMORY_OBJECTS; object++) {
        if (kind == flip_kinds[object]) {
            return (rig->control_period.firmware.flip_objects >> object & 1u) == 0;
        }
    }
    return false;
}

static bool has_place(const rig_t *rig, const fault_request_t *request) {
    const fault_kind_t *kind = &fault_kinds[request->kind];
    const unsigned machine_phases = rig->plant.machine->phases;
    return (kind->has_phase ? request->phase < machine_phases : request->phase == 0) &&
           (kind->has_leg || request->leg == 0) &&
           !(request->kind == FAULT_CURRENT_SENSOR_SWAPPED && request->begins &&
             request->raw >= (int32_t)machine_phases);
}

static bool in_range(const fault_request_t *request) {
    const fault_kind_t *kind = &fault_kinds[request->kind];
    return !request->begins || (request->raw >= kind->raw_minimum && request->raw <= kind->raw_maximum);
}

uint8_t faults_receive(rig_t *rig, const uint8_t *data) {
    const fault_request_t request = fault_request(data);
    const stimulus_t entry = {.at_ns = request.at_us * NS_PER_US,
                              .variable = pack(&request),
                              .value = (double)request.raw *
                                       (request.kind < FAULT_COUNT ? fault_kinds[request.kind].scale : 0.0)};
    if (request.kind >= FAULT_COUNT || !fault_kinds[request.kind].name) {
        return RIG_FAULT_REPLY_STATUS_NO_SUCH_FAULT_CHOICE;
    }
    if (!has_place(rig, &request)) {
        return RIG_FAULT_REPLY_STATUS_NO_SUCH_PLACE_CHOICE;
    }
    if (!in_range(&request)) {
        return RIG_FAULT_REPLY_STATUS_OUT_OF_RANGE_CHOICE;
    }
    if (unsupported(rig, &request)) {
        return RIG_FAULT_REPLY_STATUS_UNSUPPORTED_CHOICE;
    }
    if (request.at_us == 0 || entry.at_ns == rig->board.time_ns) {
        change(rig, entry.variable, entry.value);
    } else if (entry.at_ns < rig->board.time_ns) {
        return RIG_FAULT_REPLY_STATUS_IN_THE_PAST_CHOICE;
    } else if (!stimulus_queue_push(&rig->faults.changes, &entry)) {
        return RIG_FAULT_REPLY_STATUS_QUEUE_FULL_CHOICE;
    }
    schedule(rig);
    return RIG_FAULT_REPLY_STATUS_DONE_CHOICE;
}
