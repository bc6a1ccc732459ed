#include "campaign/oracle_parts.h"

#include <math.h>

#include "bench_variables.h"
#include "fault_kinds.h"

_Static_assert(FAULT_COUNT <= ORACLE_KINDS, "room for every kind");

/* A drive cannot tell apart what its current sensors show alike. */
#define PHASE (BIT(CAUSE_CURRENT_SENSOR) | BIT(CAUSE_PHASE_OPEN) | BIT(CAUSE_PHASE_SHORTED))
#define CURRENT (BIT(CAUSE_OVER_CURRENT) | BIT(CAUSE_HARDWARE_OVER_CURRENT))
#define ENCODER (BIT(CAUSE_ENCODER) | BIT(CAUSE_ENCODER_ANGLE))
#define STOPPED                                                                                                        \
    (BIT(CAUSE_INTERRUPT_OVERRUN) | BIT(CAUSE_WATCHDOG) | BIT(CAUSE_COMMAND_TIMEOUT) | BIT(CAUSE_COMMAND_ERROR))
#define WINDING_TEMPERATURE (BIT(CAUSE_TEMPERATURE_SENSOR) | BIT(CAUSE_WINDING_OVERLOAD) | BIT(CAUSE_STALL))
#define INVERTER_TEMPERATURE (BIT(CAUSE_TEMPERATURE_SENSOR) | BIT(CAUSE_INVERTER_OVERLOAD) | BIT(CAUSE_STALL))
#define OVERLOAD (BIT(CAUSE_WINDING_OVERLOAD) | BIT(CAUSE_INVERTER_OVERLOAD))
#define MECHANICS (BIT(CAUSE_STALL) | OVERLOAD)

/* A wrong voltage within its limits has no name of its own: it shows in the flux linkages that are integrated from it,
 * as an error of phases or of the angle. */
#define LINK_VOLTAGE (BIT(CAUSE_UNDER_VOLTAGE) | BIT(CAUSE_OVER_VOLTAGE) | PHASE | ENCODER)

/* First causes that a fault may have, from what it does to the quantities that a drive measures. */
static const uint32_t causes_of[FAULT_COUNT] = {
    [FAULT_WINDING_OPEN] = BIT(CAUSE_PHASE_OPEN) | BIT(CAUSE_CURRENT_SENSOR) | BIT(CAUSE_STALL),
    [FAULT_SWITCH_OPEN] = BIT(CAUSE_PHASE_OPEN) | BIT(CAUSE_CURRENT_SENSOR) | BIT(CAUSE_STALL),
    [FAULT_GATE_SUPPLY_LOST] = BIT(CAUSE_PHASE_OPEN) | BIT(CAUSE_CURRENT_SENSOR) | BIT(CAUSE_STALL),
    [FAULT_SWITCH_SHORTED] = PHASE | CURRENT,
    [FAULT_DIODE_OPEN] = PHASE | CURRENT,
    [FAULT_WINDING_SHORTED] = PHASE | CURRENT | BIT(CAUSE_STALL), /* without a torque of its own */
    [FAULT_WINDING_TO_EARTH] = PHASE | CURRENT | BIT(CAUSE_STALL),
    [FAULT_CURRENT_SENSOR_OPEN] = PHASE | CURRENT | MECHANICS,
    [FAULT_CURRENT_SENSOR_STUCK] = PHASE | CURRENT | MECHANICS,
    [FAULT_CURRENT_SENSOR_LOW_RAIL] = PHASE | CURRENT | MECHANICS,
    [FAULT_CURRENT_SENSOR_HIGH_RAIL] = PHASE | CURRENT | MECHANICS,
    [FAULT_CURRENT_SENSOR_GAIN] = PHASE | CURRENT | MECHANICS,
    [FAULT_CURRENT_SENSOR_OFFSET] = PHASE | CURRENT | MECHANICS,
    /* The currents of other phases are those of another angle, or of the other direction. */
    [FAULT_CURRENT_SENSOR_SWAPPED] = PHASE | CURRENT | MECHANICS | BIT(CAUSE_ENCODER_ANGLE),
    [FAULT_DC_LINK_SENSOR_OPEN] = BIT(CAUSE_UNDER_VOLTAGE),
    [FAULT_DC_LINK_SENSOR_LOW_RAIL] = BIT(CAUSE_UNDER_VOLTAGE),
    [FAULT_DC_LINK_SENSOR_HIGH_RAIL] = BIT(CAUSE_OVER_VOLTAGE),
    [FAULT_DC_LINK_SENSOR_STUCK] = LINK_VOLTAGE,
    [FAULT_DC_LINK_SENSOR_GAIN] = LINK_VOLTAGE,
    [FAULT_DC_LINK_SENSOR_OFFSET] = LINK_VOLTAGE,
    [FAULT_ENCODER_STUCK] = ENCODER | BIT(CAUSE_STALL),
    [FAULT_ENCODER_JUMP] = ENCODER | BIT(CAUSE_STALL), /* one that stays is a wrong position of the sensor */
    [FAULT_ENCODER_NOISE] = ENCODER,
    /* About the angle of the reversal one phase looks as before, and two as if their currents were exchanged. */
    [FAULT_ENCODER_REVERSED] = ENCODER | PHASE | BIT(CAUSE_STALL),
    /* The angle is that of one phase's tolerance after the other, and then that of a current in another phase. */
    [FAULT_ENCODER_SLIP] = ENCODER | PHASE | BIT(CAUSE_STALL),
    [FAULT_ENCODER_LOST_COUNTS] =
        ENCODER | PHASE | BIT(CAUSE_STALL) | BIT(CAUSE_OVER_SPEED), /* of the counts, where they jump */
    [FAULT_ENCODER_NO_ANSWER] = ENCODER | BIT(CAUSE_STALL),
    [FAULT_SHAFT_LOCKED] = ENCODER | MECHANICS,
    [FAULT_COULOMB_FRICTION] = ENCODER | MECHANICS,
    [FAULT_STATIC_FRICTION] = ENCODER | MECHANICS,
    [FAULT_LOAD_DROPPED] = 0,
    [FAULT_SUPPLY_LOST] = BIT(CAUSE_UNDER_VOLTAGE),
    [FAULT_SUPPLY_SAGGED] = BIT(CAUSE_UNDER_VOLTAGE) | BIT(CAUSE_STALL),
    [FAULT_SUPPLY_SURGED] = BIT(CAUSE_OVER_VOLTAGE),
    [FAULT_SUPPLY_RIPPLE] = BIT(CAUSE_UNDER_VOLTAGE) | BIT(CAUSE_OVER_VOLTAGE),
    [FAULT_CHOPPER_OPEN] = BIT(CAUSE_OVER_VOLTAGE),
    [FAULT_INTERRUPT_LOST] = BIT(CAUSE_INTERRUPT_OVERRUN) | BIT(CAUSE_WATCHDOG) | BIT(CAUSE_COMMAND_TIMEOUT),
    [FAULT_BACKGROUND_HUNG] = BIT(CAUSE_WATCHDOG) | BIT(CAUSE_COMMAND_TIMEOUT) | BIT(CAUSE_COMMAND_ERROR),
    [FAULT_INTERRUPT_LATE] =
        STOPPED | BIT(CAUSE_ENCODER), /* which turns further from one to the next than in a period */
    [FAULT_INTERRUPT_STORM] = STOPPED,
    [FAULT_WINDING_TEMPERATURE_SENSOR_OPEN] = WINDING_TEMPERATURE,
    [FAULT_WINDING_TEMPERATURE_SENSOR_SHORTED] = WINDING_TEMPERATURE,
    [FAULT_WINDING_TEMPERATURE_SENSOR_STUCK] = WINDING_TEMPERATURE,
    [FAULT_WINDING_TEMPERATURE_SENSOR_OFFSET] = WINDING_TEMPERATURE,
    [FAULT_INVERTER_TEMPERATURE_SENSOR_OPEN] = INVERTER_TEMPERATURE,
    [FAULT_INVERTER_TEMPERATURE_SENSOR_SHORTED] = INVERTER_TEMPERATURE,
    [FAULT_INVERTER_TEMPERATURE_SENSOR_STUCK] = INVERTER_TEMPERATURE,
    [FAULT_INVERTER_TEMPERATURE_SENSOR_OFFSET] = INVERTER_TEMPERATURE,
    /* What is judged by a wrong limit or constant before the change is noticed may fail in any way. */
    [FAULT_LIMIT_FLIPPED] = UINT32_MAX,
    [FAULT_CONSTANT_FLIPPED] = UINT32_MAX,
    [FAULT_STATE_FLIPPED] = UINT32_MAX,       /* another state than that of the checks, for its duration */
    [FAULT_FAULT_LATCH_FLIPPED] = UINT32_MAX, /* another name of what is latched */
    [FAULT_CODE_FLIPPED] = BIT(CAUSE_CODE),
    [FAULT_STACK_GUARD_FLIPPED] = BIT(CAUSE_MEMORY),
    [FAULT_PERIOD_REGISTER_FLIPPED] = BIT(CAUSE_MEMORY) | BIT(CAUSE_CLOCK) | BIT(CAUSE_OVER_SPEED) | PHASE | CURRENT |
                                      ENCODER | STOPPED, /* all of which it counts in periods */
    [FAULT_CLOCK_DRIFT] = BIT(CAUSE_CLOCK),
};

#define BUS (BIT(CAUSE_COMMAND_TIMEOUT) | BIT(CAUSE_COMMAND_ERROR) | BIT(CAUSE_IDENTIFIER_CONFLICT))

static uint32_t causes_of_variable(unsigned variable) {
    switch (variable) {
    case BENCH_VARIABLE_STO_1:
    case BENCH_VARIABLE_STO_2:
        return BIT(CAUSE_STO) | BIT(CAUSE_STO_DISCREPANCY);
    case BENCH_VARIABLE_INTERRUPT_TIME_US:
        return BIT(CAUSE_INTERRUPT_OVERRUN) | BIT(CAUSE_WATCHDOG) | BIT(CAUSE_COMMAND_TIMEOUT) |
               BIT(CAUSE_COMMAND_ERROR);
    case BENCH_VARIABLE_BABBLE_LOAD_PERCENT:
    case BENCH_VARIABLE_BUS_CONNECTION:
    case BENCH_VARIABLE_TRANSMIT_ERROR_COUNTER:
    case BENCH_VARIABLE_FRAME_FAULT:
        return BUS;
    default:
        return 0;
    }
}

static uint32_t causes_of_script(const world_event_t *event) {
    const bool refused = event->kind == WORLD_BEYOND ||
                         (event->kind == WORLD_REQUEST && event->what == WORLD_REQUEST_CLEAR); /* in a run */
    return event->kind == WORLD_SILENT || refused ? BIT(CAUSE_COMMAND_TIMEOUT) | BIT(CAUSE_COMMAND_ERROR)
           : event->kind == WORLD_HOSTILE || event->kind == WORLD_SECOND ? BUS
                                                                         : 0;
}

/* Torque that heat and the client leave. Telemetry that may be disturbed is not looked at: then the temperatures tell
 * that the drive has measured. */
static double torque_left_Nm(const oracle_t *oracle) {
    const oracle_heat_t heat = oracle->drive.heat;
    const double announced_Nm = oracle->telemetry.limit_ns != 0 ? oracle->telemetry.limit_Nm.low[0] : INFINITY;
    return fmin(announced_Nm, oracle_cool_part(heat.winding_C, heat.switch_C) * oracle_torque_max_Nm(oracle));
}

/* The load is the torque that is left. A rotor that a load turns backwards has less of it in the mean: one quadrant
 * takes the phases in the order of forward motion, and backwards each of them ends its part where its torque, at the
 * limit of the current, is small. */
static bool overloaded(const oracle_t *oracle, const plant_t *plant) {
    const bool driven_back = oracle->world->controller != 2 && plant->speed_rad_s < 0.0 && plant->load_torque_Nm > 0.0;
    return fabs(plant->load_torque_Nm) > (driven_back ? 0.7 : 0.9) * torque_left_Nm(oracle);
}

/* What the plant itself shows. */
static bool true_of_plant(const oracle_t *oracle, unsigned cause, const plant_t *plant) {
    const world_machine_t *machine = oracle->world->machine;
    double current_A = oracle->current_recent_A;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        current_A = fmax(current_A, plant_current_A(plant, phase));
    }
    switch (cause) {
    case CAUSE_OVER_CURRENT:
    case CAUSE_HARDWARE_OVER_CURRENT:
        return current_A > 0.95 * machine->trip_current_A;
    case CAUSE_OVER_VOLTAGE:
        return fmax(oracle->voltage_recent_high_V, plant->bus_voltage_V) > 0.98 * machine->over_voltage_V;
    case CAUSE_UNDER_VOLTAGE:
        return fmin(oracle->voltage_recent_low_V, plant->bus_voltage_V) < 1.02 * machine->under_voltage_V;
    case CAUSE_OVER_SPEED:
        return fmax(oracle->speed_recent_rad_s, fabs(plant->speed_rad_s)) * ORACLE_RPM_PER_RAD_S >
               0.95 * machine->over_speed_rpm;
    case CAUSE_STALL:
        return plant->time_ns > oracle->detection.stroke_ns + ORACLE_STALLED_NS || oracle->detection.swings ||
               overloaded(oracle, plant);
    default:
        return false;
    }
}

unsigned oracle_phases_at_fault(const oracle_t *oracle, uint64_t now_us) {
    const world_t *world = oracle->world;
    unsigned phases = 0;
    for (unsigned i = 0; i < world->events; i++) {
        const world_event_t *event = world_begun(world, i, now_us);
        if (event != NULL && event->kind == WORLD_FAULT && event->what <= FAULT_CURRENT_SENSOR_SWAPPED &&
            (event->end_us == 0 || event->end_us + 250000 > now_us)) {
            phases |= 1u << event->phase;
        }
    }
    return phases;
}

/* What the plant shows is not the drive's own work. A drive with healthy sensors, phases, supply and processor does not
 * exceed its current; without a load that drives it neither its speed, nor the voltage of a link that is fed as it
 * should be, even when the link takes no energy. */
static bool has_reason(const oracle_t *oracle, unsigned cause, const plant_t *plant) {
    const uint64_t now_us = plant->time_ns / 1000;
    const bool unsound = oracle_any_injected(oracle, FAULT_WINDING_OPEN, FAULT_LOAD_DROPPED) ||
                         oracle_any_injected(oracle, FAULT_INTERRUPT_LOST, FAULT_INTERRUPT_STORM) ||
                         oracle_variable_begun(oracle, BENCH_VARIABLE_INTERRUPT_TIME_US, now_us) ||
                         oracle_overhauled(oracle, plant->speed_rad_s);
    const double near = oracle->world->controller == 2 ? 0.97 : 0.8; /* an overshoot of one quadrant stays */
    const bool coasts = oracle->dark_ns != 0 && plant->time_ns > oracle->dark_ns + ORACLE_MS_NS;
    const bool near_limit = coasts || (!oracle->meant.torque &&
                                       fabs(oracle->meant.reference) > near * oracle->world->machine->over_speed_rpm);
    switch (cause) {
    case CAUSE_OVER_CURRENT:
    case CAUSE_HARDWARE_OVER_CURRENT:
        return oracle_any_injected(oracle, FAULT_WINDING_OPEN, FAULT_ENCODER_NO_ANSWER) ||
               oracle_any_injected(oracle, FAULT_SUPPLY_LOST, FAULT_SUPPLY_RIPPLE) ||
               oracle_drive_disturbed(oracle, now_us);
    case CAUSE_OVER_SPEED:
        return unsound || near_limit;
    case CAUSE_OVER_VOLTAGE:
        return unsound || oracle_any_injected(oracle, FAULT_SUPPLY_LOST, FAULT_SUPPLY_RIPPLE) ||
               oracle_any_injected(oracle, FAULT_LIMIT_FLIPPED, FAULT_CLOCK_DRIFT);
    default:
        return true;
    }
}

/* Begin of the latest fault of a phase or of the encoder. */
static uint64_t latest_fault_ns(const oracle_t *oracle, uint64_t now_us) {
    uint64_t latest_us = 0;
    for (unsigned i = 0; i < oracle->world->events; i++) {
        const world_event_t *event = world_begun(oracle->world, i, now_us);
        const bool shows = event != NULL && event->kind == WORLD_FAULT && event->what <= FAULT_ENCODER_NO_ANSWER;
        latest_us = shows && event->begin_us > latest_us ? event->begin_us : latest_us;
    }
    return latest_us * 1000;
}

/* No two phases without a fault have had a current to speak of since the latest one and in the last quarter of a
 * second: one for the encoder's angle and one against it tell nothing. */
static bool conducts_alone(const oracle_t *oracle, const plant_t *plant) {
    const unsigned faulty = oracle_phases_at_fault(oracle, plant->time_ns / 1000);
    const uint64_t since_ns = latest_fault_ns(oracle, plant->time_ns / 1000);
    unsigned conducting = 0;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        const uint64_t last_ns = oracle->conducted_ns[phase];
        conducting += !(faulty >> phase & 1u) && last_ns > since_ns && plant->time_ns < last_ns + 250 * ORACLE_MS_NS;
    }
    return conducting < 2;
}

/* One of the causes has been an earlier one. */
static bool named(const oracle_t *oracle, uint32_t causes) {
    bool any = false;
    for (unsigned i = 0; i + 1 < oracle->causes; i++) {
        any = any || (causes >> oracle->cause[i] & 1u);
    }
    return any;
}

void oracle_judge_cause(oracle_t *oracle, const plant_t *plant) {
    const world_t *world = oracle->world;
    const uint64_t now_us = plant->time_ns / 1000;
    uint32_t allowed = 0;
    bool any = false;
    for (unsigned kind = 1; kind < FAULT_COUNT; kind++) {
        if (oracle->injected[kind]) {
            allowed |= causes_of[kind];
            any = true;
        }
    }
    for (unsigned i = 0; i < world->events; i++) {
        const world_event_t *event = world_begun(world, i, now_us);
        if (event != NULL) {
            const uint32_t causes =
                event->kind == WORLD_SET ? causes_of_variable(event->what) : causes_of_script(event);
            allowed |= causes;
            any = any || causes;
        }
    }
    /* With one phase that has conducted lately a wrong current and a wrong angle, or one that does not move, are the
     * same; and two phases with faults of their own are what a wrong angle looks like. */
    const unsigned phases = oracle_phases_at_fault(oracle, now_us);
    const bool of_phase = oracle_any_injected(oracle, FAULT_WINDING_OPEN, FAULT_CURRENT_SENSOR_SWAPPED);
    const bool of_encoder = oracle_any_injected(oracle, FAULT_ENCODER_STUCK, FAULT_ENCODER_SLIP);
    if (!oracle->turned || conducts_alone(oracle, plant)) {
        allowed |= (of_phase ? ENCODER : 0) | (of_encoder ? PHASE : 0);
    }
    /* What has been named, and is run with again, is wrong from the start. */
    if (of_encoder && named(oracle, ENCODER)) {
        allowed |= PHASE;
    }
    if (of_phase && named(oracle, PHASE | CURRENT)) {
        allowed |= ENCODER;
    }
    if ((phases & (phases - 1u)) != 0) {
        allowed |= BIT(CAUSE_ENCODER_ANGLE);
    }
    /* From a shorted switch through the earth flows a current that no drive can end, also before the first run. */
    if (oracle->injected[FAULT_SWITCH_SHORTED] && oracle->injected[FAULT_WINDING_TO_EARTH]) {
        allowed |= OVERLOAD;
    }
    const unsigned cause = oracle->drive.fault;
    if ((allowed >> cause & 1u) || (true_of_plant(oracle, cause, plant) && has_reason(oracle, cause, plant))) {
        return;
    }
    oracle_violate(oracle, any ? "wrong_cause" : "false_alarm", plant->time_ns, cause, (double)oracle->drive.checks);
}
