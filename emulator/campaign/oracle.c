#include "campaign/oracle.h"

#include <math.h>
#include <string.h>

#include "bench_variables.h"
#include "fault_kinds.h"

#define RPM_PER_RAD_S (30.0 / 3.14159265358979323846)
#define TWO_PI (2.0 * 3.14159265358979323846)
#define MS_NS UINT64_C(1000000)
#define RECENT_NS (2 * MS_NS)
#define MARGIN 1.02
#define RUN_MAX_NS (502 * MS_NS) /* of a run, since the last request */
#define OBSERVED_S 1e-3          /* time constant of a speed that is observed */
#define STRETCH_COUNTS 16.0
#define STRETCH_MIN_NS (2 * MS_NS)
#define STRETCH_MAX_NS (32 * MS_NS)
#define STRETCH_SPEED 0.1 /* change of the speed, at most */
#define ANGLE_ERROR_MAX_COUNTS 0.75
#define TIMER_TICK_S 5e-9

enum { STATE_INITIALISE, STATE_READY, STATE_RUN, STATE_FAULT };

/* Numbers of drive.dbc. */
enum {
    CAUSE_OVER_CURRENT = 1,
    CAUSE_OVER_VOLTAGE,
    CAUSE_UNDER_VOLTAGE,
    CAUSE_OVER_SPEED,
    CAUSE_ENCODER,
    CAUSE_COMMAND_TIMEOUT,
    CAUSE_INTERRUPT_OVERRUN,
    CAUSE_COMMAND_ERROR,
    CAUSE_IDENTIFIER_CONFLICT,
    CAUSE_PARAMETER_MEMORY,
    CAUSE_HARDWARE_OVER_CURRENT,
    CAUSE_STO,
    CAUSE_STO_DISCREPANCY,
    CAUSE_STALL,
    CAUSE_CURRENT_SENSOR,
    CAUSE_PHASE_OPEN,
    CAUSE_PHASE_SHORTED,
    CAUSE_ENCODER_ANGLE,
    CAUSE_WINDING_OVERLOAD,
    CAUSE_INVERTER_OVERLOAD,
    CAUSE_TEMPERATURE_SENSOR,
    CAUSE_WATCHDOG,
    CAUSE_MEMORY,
    CAUSE_CODE,
    CAUSE_CLOCK,
};

_Static_assert(FAULT_COUNT <= ORACLE_KINDS, "room for every kind");

#define BIT(cause) (UINT32_C(1) << (cause))
/* A drive cannot tell apart what its current sensors show alike. */
#define PHASE (BIT(CAUSE_CURRENT_SENSOR) | BIT(CAUSE_PHASE_OPEN) | BIT(CAUSE_PHASE_SHORTED))
#define CURRENT (BIT(CAUSE_OVER_CURRENT) | BIT(CAUSE_HARDWARE_OVER_CURRENT))
#define ENCODER (BIT(CAUSE_ENCODER) | BIT(CAUSE_ENCODER_ANGLE))
#define STOPPED                                                                                                        \
    (BIT(CAUSE_INTERRUPT_OVERRUN) | BIT(CAUSE_WATCHDOG) | BIT(CAUSE_COMMAND_TIMEOUT) | BIT(CAUSE_COMMAND_ERROR))
#define WINDING_TEMPERATURE (BIT(CAUSE_TEMPERATURE_SENSOR) | BIT(CAUSE_WINDING_OVERLOAD) | BIT(CAUSE_STALL))
#define INVERTER_TEMPERATURE (BIT(CAUSE_TEMPERATURE_SENSOR) | BIT(CAUSE_INVERTER_OVERLOAD) | BIT(CAUSE_STALL))
#define MECHANICS (BIT(CAUSE_STALL) | BIT(CAUSE_WINDING_OVERLOAD) | BIT(CAUSE_INVERTER_OVERLOAD))

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
    [FAULT_WINDING_SHORTED] = PHASE | CURRENT,
    [FAULT_WINDING_TO_EARTH] = PHASE | CURRENT,
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
    [FAULT_ENCODER_JUMP] = ENCODER,
    [FAULT_ENCODER_LOST_COUNTS] = ENCODER | BIT(CAUSE_STALL),
    [FAULT_ENCODER_NOISE] = ENCODER,
    [FAULT_ENCODER_REVERSED] = ENCODER | BIT(CAUSE_STALL),
    [FAULT_ENCODER_SLIP] = ENCODER | BIT(CAUSE_STALL),
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
    [FAULT_INTERRUPT_LATE] = STOPPED,
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
    return event->kind == WORLD_SILENT ? BIT(CAUSE_COMMAND_TIMEOUT) | BIT(CAUSE_COMMAND_ERROR)
           : event->kind == WORLD_HOSTILE || event->kind == WORLD_SECOND ? BUS
                                                                         : 0;
}

/* Of the encoder on the shaft, in revolutions. */
static double encoder_offset_rev(const world_t *world) {
    double offset_deg = 0.0;
    for (unsigned i = 0; i < world->events; i++) {
        const world_event_t *event = &world->event[i];
        if (event->kind == WORLD_SET && event->what == BENCH_VARIABLE_ENCODER_OFFSET_DEG && world_active(world, i, 0)) {
            offset_deg = event->raw * bench_variables[event->what].scale;
        }
    }
    return offset_deg / 360.0;
}

void oracle_init(oracle_t *oracle, const world_t *world, const sender_t *sender, uint64_t period_ns) {
    *oracle = (oracle_t){.world = world, .sender = sender, .period_ns = period_ns};
    oracle->voltage_recent_low_V = INFINITY;
    oracle->encoder_offset_rev = encoder_offset_rev(world);
}

static bool any_injected(const oracle_t *oracle, unsigned first, unsigned last) {
    bool any = false;
    for (unsigned kind = first; kind <= last; kind++) {
        any = any || oracle->injected[kind];
    }
    return any;
}

/* The state of the drive, or what it takes for it, was changed from outside. */
static bool state_changed(const oracle_t *oracle) {
    return any_injected(oracle, FAULT_STATE_FLIPPED, FAULT_FAULT_LATCH_FLIPPED);
}

static void violate(oracle_t *oracle, const char *rule, uint64_t time_ns, unsigned number, double value) {
    for (unsigned i = 0; i < oracle->violations; i++) {
        if (strcmp(oracle->violation[i].rule, rule) == 0 && oracle->violation[i].number == number) {
            return;
        }
    }
    if (oracle->violations < ORACLE_VIOLATIONS_MAX) {
        oracle->violation[oracle->violations++] =
            (oracle_violation_t){.rule = rule, .time_us = time_ns / 1000, .number = number, .value = value};
    }
}

/* Any event that has begun and is not over since after_us. */
static bool variable_begun(const oracle_t *oracle, unsigned variable, uint64_t time_us) {
    for (unsigned i = 0; i < oracle->world->events; i++) {
        const world_event_t *event = &oracle->world->event[i];
        if (event->kind == WORLD_SET && event->what == variable && (oracle->world->kept >> i & 1u) &&
            event->begin_us <= time_us) {
            return true;
        }
    }
    return false;
}

static bool variable_active(const oracle_t *oracle, unsigned variable, uint64_t time_us) {
    for (unsigned i = 0; i < oracle->world->events; i++) {
        if (oracle->world->event[i].kind == WORLD_SET && oracle->world->event[i].what == variable &&
            world_active(oracle->world, i, time_us)) {
            return true;
        }
    }
    return false;
}

/* A second sender of valid frames; with a hostile one as well when its frames may be in the way of others. */
static bool other_sender(const oracle_t *oracle, bool hostile, uint64_t time_us) {
    for (unsigned i = 0; i < oracle->world->events; i++) {
        const world_event_t *event = &oracle->world->event[i];
        if ((event->kind == WORLD_SECOND || (hostile && event->kind == WORLD_HOSTILE)) &&
            (oracle->world->kept >> i & 1u) && event->begin_us <= time_us) {
            return true;
        }
    }
    return false;
}

/* --- Never --- */

static void look_at_currents(oracle_t *oracle, const plant_t *plant, unsigned gates) {
    const double threshold_A = plant->machine->trip_current_A;
    bool above = false;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        const double current_A = plant_current_A(plant, phase);
        oracle->current_recent_A = fmax(oracle->current_recent_A, current_A);
        if (!(gates >> phase & 1u) || current_A <= threshold_A || threshold_A == 0.0) {
            continue;
        }
        magnetics_point_t point;
        magnetics_evaluate(&plant->magnetics, plant_phase_angle_rad(plant, phase), current_A, &point);
        const double rise_A = plant->bus_voltage_V * (double)oracle->period_ns * 1e-9 / point.incremental_inductance_H;
        if (current_A > threshold_A + rise_A) {
            above = true;
            if (++oracle->over_current_looks >= 2) {
                violate(oracle, "over_current", plant->time_ns, phase, current_A / threshold_A);
            }
        }
    }
    if (!above) {
        oracle->over_current_looks = 0;
    }
}

/* What was on the bus may not have reached the drive, or not in time. */
static bool may_be_deaf(const oracle_t *oracle, uint64_t time_us) {
    static const unsigned variables[] = {BENCH_VARIABLE_FRAME_FAULT, BENCH_VARIABLE_BUS_CONNECTION,
                                         BENCH_VARIABLE_TRANSMIT_ERROR_COUNTER, BENCH_VARIABLE_INTERRUPT_TIME_US};
    for (unsigned i = 0; i < sizeof variables / sizeof *variables; i++) {
        if (variable_begun(oracle, variables[i], time_us)) {
            return true;
        }
    }
    return other_sender(oracle, false, time_us) || any_injected(oracle, FAULT_BACKGROUND_HUNG, FAULT_INTERRUPT_STORM);
}

/* Frames of the only sender, sent once more while it is silent, are its frames: nothing but the arming tells them. */
static bool impersonated(const oracle_t *oracle) {
    bool silent = false, replayed = false;
    for (unsigned i = 0; i < oracle->world->events; i++) {
        const world_event_t *event = &oracle->world->event[i];
        const bool kept = oracle->world->kept >> i & 1u;
        silent = silent || (kept && event->kind == WORLD_SILENT);
        replayed = replayed || (kept && event->kind == WORLD_HOSTILE && event->what == WORLD_HOSTILE_REPLAY);
    }
    return silent && replayed;
}

static void look_at_commands(oracle_t *oracle, const plant_t *plant) {
    const uint64_t now_ns = plant->time_ns;
    const bool deaf = may_be_deaf(oracle, now_ns / 1000);
    if (!oracle->confirmed && !deaf) {
        violate(oracle, "no_command", now_ns, 1, 0.0);
    }
    if (oracle->off_seen && now_ns > oracle->off_ns + 5 * MS_NS && !deaf) {
        violate(oracle, "no_command", now_ns, 2, 0.0);
    }
    /* The plant may not have advanced to the frame yet. */
    const uint64_t age_ns = now_ns > oracle->run_ns ? now_ns - oracle->run_ns : 0;
    if (!oracle->commanded || age_ns > RUN_MAX_NS) {
        violate(oracle, "no_command", now_ns, 3, (double)age_ns * 1e-6);
    } else if (age_ns > 170 * MS_NS && fabs(plant_torque_Nm(plant)) > 0.2 * oracle->world->machine->torque_max_Nm) {
        violate(oracle, "no_command", now_ns, 4, plant_torque_Nm(plant));
    }
}

static bool link_sensor_faulty(const oracle_t *oracle) {
    return any_injected(oracle, FAULT_DC_LINK_SENSOR_OPEN, FAULT_DC_LINK_SENSOR_OFFSET);
}

static void since(uint64_t *begin_ns, bool holds, uint64_t now_ns) {
    *begin_ns = !holds ? 0 : *begin_ns ? *begin_ns : now_ns;
}

static void look_at_limits(oracle_t *oracle, const plant_t *plant, unsigned gates) {
    const world_machine_t *machine = oracle->world->machine;
    const double speed_rpm = fabs(plant->speed_rad_s) * RPM_PER_RAD_S;
    since(&oracle->speed_ns, gates && speed_rpm > MARGIN * machine->over_speed_rpm, plant->time_ns);
    if (oracle->speed_ns && plant->time_ns > oracle->speed_ns + 2 * MS_NS) {
        violate(oracle, "over_speed", plant->time_ns, 0, speed_rpm / machine->over_speed_rpm);
    }
    since(&oracle->voltage_ns,
          gates && plant->machine->dc_link.capacitance_F > 0.0 && !link_sensor_faulty(oracle) &&
              plant->bus_voltage_V > MARGIN * machine->over_voltage_V,
          plant->time_ns);
    if (oracle->voltage_ns && plant->time_ns > oracle->voltage_ns + MS_NS / 5) {
        violate(oracle, "over_voltage", plant->time_ns, 0, plant->bus_voltage_V / machine->over_voltage_V);
    }
}

/* What the encoder reads, or when, is not the rotor's motion alone, or memory of the drive was changed. */
static bool angle_disturbed(const oracle_t *oracle, uint64_t time_us) {
    return any_injected(oracle, FAULT_ENCODER_STUCK, FAULT_ENCODER_NO_ANSWER) ||
           any_injected(oracle, FAULT_INTERRUPT_LOST, FAULT_INTERRUPT_STORM) ||
           any_injected(oracle, FAULT_LIMIT_FLIPPED, FAULT_CLOCK_DRIFT) ||
           variable_begun(oracle, BENCH_VARIABLE_INTERRUPT_TIME_US, time_us);
}

/* At the instant of the measurement. */
static void look_at_angle(oracle_t *oracle, const plant_t *plant) {
    oracle_stretch_t *stretch = &oracle->stretch;
    if (oracle->drive.state != STATE_RUN) {
        stretch->samples = 0;
        return;
    }
    const double counts_per_rev = ldexp(1.0, (int)oracle->world->encoder_bits);
    const double true_rev = plant->rotor_angle_rad / TWO_PI + oracle->encoder_offset_rev;
    const double counts = true_rev * counts_per_rev;
    const bool steady = fabs(plant->speed_rad_s - stretch->speed_rad_s) <= STRETCH_SPEED * fabs(stretch->speed_rad_s);
    if (stretch->samples == 0 || !steady || plant->time_ns > stretch->begin_ns + STRETCH_MAX_NS) {
        *stretch =
            (oracle_stretch_t){.begin_ns = plant->time_ns, .begin_counts = counts, .speed_rad_s = plant->speed_rad_s};
    }
    const double error_rev = ldexp((double)oracle->drive.angle, -32) - true_rev;
    stretch->error_counts += (error_rev - floor(error_rev + 0.5)) * counts_per_rev;
    stretch->samples++;
    if (fabs(counts - stretch->begin_counts) < STRETCH_COUNTS || plant->time_ns < stretch->begin_ns + STRETCH_MIN_NS) {
        return;
    }
    const double mean_counts = stretch->error_counts / stretch->samples;
    const double tick_counts = fabs(plant->speed_rad_s) / TWO_PI * TIMER_TICK_S * counts_per_rev;
    if (fabs(mean_counts) > ANGLE_ERROR_MAX_COUNTS + tick_counts && !angle_disturbed(oracle, plant->time_ns / 1000)) {
        violate(oracle, "wrong_angle", plant->time_ns, 0, mean_counts);
    }
    stretch->samples = 0;
}

/* --- Eventually --- */

double oracle_recovery_speed_rpm(oracle_t *oracle, const plant_t *plant) {
    const world_machine_t *machine = oracle->world->machine;
    const double now_rpm = plant->speed_rad_s * RPM_PER_RAD_S;
    /* A drive of one quadrant cannot slow down. */
    oracle->recovery_rpm = fmax(fabs(now_rpm) * 1.1, 0.2 * machine->speed_base_rpm);
    if (oracle->world->controller == 2 && now_rpm < 0.0) {
        oracle->recovery_rpm = -oracle->recovery_rpm;
    }
    oracle->recovery_judged = fabs(oracle->recovery_rpm) <= 0.9 * machine->speed_base_rpm &&
                              fabs(oracle->recovery_rpm) <= 0.95 * machine->speed_command_max_rpm &&
                              (now_rpm >= 0.0 || oracle->world->controller == 2);
    return fmin(fabs(oracle->recovery_rpm), machine->speed_command_max_rpm) * (oracle->recovery_rpm < 0.0 ? -1.0 : 1.0);
}

/* Part of the speed that a drive of one quadrant may have at most: it cannot take away what the torque limit adds in
 * three periods, while its speed is observed and while the voltage removes the largest flux linkage. */
static double most_of_one_quadrant(const oracle_t *oracle, const plant_t *plant) {
    const machine_t *machine = plant->machine;
    magnetics_point_t aligned;
    magnetics_evaluate(&plant->magnetics, 0.0, oracle->world->machine->trip_current_A, &aligned);
    const double late_s =
        3e-9 * (double)oracle->period_ns + OBSERVED_S + aligned.flux_linkage_Wb / machine->supply_voltage_V;
    const double added_rad_s =
        late_s * oracle->world->machine->torque_max_Nm / (machine->inertia_kg_m2 * oracle->world->inertia_gain);
    return fmax(1.2, 1.05 + added_rad_s * RPM_PER_RAD_S / fabs(oracle->recovery_rpm));
}

static void look_at_recovery(oracle_t *oracle, const plant_t *plant) {
    if (!oracle->recovered) {
        return;
    }
    const double part = plant->speed_rad_s * RPM_PER_RAD_S / oracle->recovery_rpm;
    /* A drive of one quadrant waits for the friction to take an overshoot. */
    const double most = oracle->world->controller == 2 ? 1.005 : most_of_one_quadrant(oracle, plant);
    since(&oracle->in_band_ns, part >= 0.995 && part <= most, plant->time_ns);
    oracle->settled = oracle->settled || (oracle->in_band_ns && plant->time_ns >= oracle->in_band_ns + 2 * MS_NS);
}

/* Lines of safe torque off that differed for 200 ms keep a drive in a fault until both have been without energy. */
static bool sto_lines_differed(const oracle_t *oracle) {
    const world_t *world = oracle->world;
    for (unsigned i = 0; i < world->events; i++) {
        const world_event_t *event = &world->event[i];
        if ((world->kept >> i & 1u) && event->kind == WORLD_SET &&
            (event->what == BENCH_VARIABLE_STO_1 || event->what == BENCH_VARIABLE_STO_2) &&
            (event->end_us == 0 || event->end_us > event->begin_us + 195000)) {
            return true;
        }
    }
    return false;
}

/* True when what keeps a drive in a fault is still there: nothing to be judged. */
static bool cause_remains(const oracle_t *oracle) {
    if (any_injected(oracle, FAULT_LIMIT_FLIPPED, FAULT_PERIOD_REGISTER_FLIPPED)) {
        return true; /* memory that has changed: until a reset */
    }
    if (sto_lines_differed(oracle)) {
        return true;
    }
    const uint8_t last = oracle->causes ? oracle->cause[oracle->causes - 1] : 0;
    return last == CAUSE_WINDING_OVERLOAD || last == CAUSE_INVERTER_OVERLOAD || last == CAUSE_IDENTIFIER_CONFLICT;
}

static bool bus_disturbed(const oracle_t *oracle) {
    static const unsigned variables[] = {BENCH_VARIABLE_BABBLE_LOAD_PERCENT, BENCH_VARIABLE_BUS_CONNECTION,
                                         BENCH_VARIABLE_TRANSMIT_ERROR_COUNTER, BENCH_VARIABLE_FRAME_FAULT};
    for (unsigned i = 0; i < 4; i++) {
        if (variable_begun(oracle, variables[i], UINT64_MAX)) {
            return true;
        }
    }
    return other_sender(oracle, true, UINT64_MAX);
}

/* A drive takes an encoder for frozen until it counts, which at rest only a hand on the shaft or a reset can end. */
static bool held_by_encoder(const oracle_t *oracle, const plant_t *plant) {
    const bool any = any_injected(oracle, FAULT_ENCODER_STUCK, FAULT_ENCODER_NO_ANSWER) ||
                     any_injected(oracle, FAULT_SHAFT_LOCKED, FAULT_STATIC_FRICTION);
    return any && !oracle->recovered && fabs(plant->speed_rad_s) < 2.0;
}

void oracle_finish(oracle_t *oracle, const plant_t *plant) {
    oracle->held = held_by_encoder(oracle, plant);
    if (oracle->held || !oracle->recovery_judged || cause_remains(oracle) || bus_disturbed(oracle)) {
        return;
    }
    if (!oracle->recovered) {
        violate(oracle, "not_recovered", plant->time_ns, 1, oracle->drive.state);
    } else if (!oracle->settled && plant->time_ns > oracle->settle_by_ns) {
        violate(oracle, "not_recovered", plant->time_ns, 2, plant->speed_rad_s * RPM_PER_RAD_S / oracle->recovery_rpm);
    }
}

/* --- Events --- */

/* Not 0 when a switch of any phase is on. */
static unsigned gates_on(const plant_t *plant) {
    unsigned gates = 0;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        gates |= plant->switches[phase];
    }
    return gates;
}

static void remember(oracle_t *oracle, const plant_t *plant) {
    if (plant->time_ns > oracle->recent_ns + RECENT_NS) {
        oracle->recent_ns = plant->time_ns;
        oracle->current_recent_A = oracle->speed_recent_rad_s = oracle->voltage_recent_high_V = 0.0;
        oracle->voltage_recent_low_V = INFINITY;
    }
    oracle->speed_recent_rad_s = fmax(oracle->speed_recent_rad_s, fabs(plant->speed_rad_s));
    oracle->voltage_recent_high_V = fmax(oracle->voltage_recent_high_V, plant->bus_voltage_V);
    oracle->voltage_recent_low_V = fmin(oracle->voltage_recent_low_V, plant->bus_voltage_V);
}

void oracle_look(oracle_t *oracle, const plant_t *plant) {
    remember(oracle, plant);
    const unsigned gates = gates_on(plant);
    since(&oracle->dark_ns, gates == 0, plant->time_ns);
    look_at_currents(oracle, plant, gates);
    look_at_limits(oracle, plant, gates);
    look_at_recovery(oracle, plant);
    if (gates == 0) {
        return;
    }
    const uint64_t time_us = (plant->time_ns - 1) / 1000; /* a change of this instant comes after the look */
    if (variable_active(oracle, BENCH_VARIABLE_STO_1, time_us) ||
        variable_active(oracle, BENCH_VARIABLE_STO_2, time_us)) {
        violate(oracle, "gate_on", plant->time_ns, 2, 0.0);
    }
    const uint64_t longer = oracle->injected[FAULT_PERIOD_REGISTER_FLIPPED] ? 4 : 1; /* times the period, at most */
    if (plant->time_ns > oracle->interrupt_ns + longer * oracle->period_ns * 5 / 2) {
        violate(oracle, "gate_on", plant->time_ns, 3, (double)(plant->time_ns - oracle->interrupt_ns) * 1e-3);
    }
    look_at_commands(oracle, plant);
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
        return fmax(oracle->speed_recent_rad_s, fabs(plant->speed_rad_s)) * RPM_PER_RAD_S >
               0.95 * machine->over_speed_rpm;
    default:
        return false;
    }
}

/* Phases with a fault of their own in the last quarter of a second. */
static unsigned phases_at_fault(const oracle_t *oracle, uint64_t now_us) {
    const world_t *world = oracle->world;
    unsigned phases = 0;
    for (unsigned i = 0; i < world->events; i++) {
        const world_event_t *event = &world->event[i];
        const bool recent = event->begin_us <= now_us && (event->end_us == 0 || event->end_us + 250000 > now_us);
        if ((world->kept >> i & 1u) && event->kind == WORLD_FAULT && event->what <= FAULT_CURRENT_SENSOR_SWAPPED &&
            recent) {
            phases |= 1u << event->phase;
        }
    }
    return phases;
}

static void judge_cause(oracle_t *oracle, const plant_t *plant) {
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
        const world_event_t *event = &world->event[i];
        if ((world->kept >> i & 1u) && event->begin_us <= now_us) {
            const uint32_t causes =
                event->kind == WORLD_SET ? causes_of_variable(event->what) : causes_of_script(event);
            allowed |= causes;
            any = any || causes;
        }
    }
    /* With one phase that has conducted so far a wrong current and a wrong angle are the same; and two phases with
     * faults of their own are what a wrong angle looks like. */
    const unsigned phases = phases_at_fault(oracle, now_us);
    const bool of_phase = any_injected(oracle, FAULT_WINDING_OPEN, FAULT_CURRENT_SENSOR_SWAPPED);
    if ((of_phase && !oracle->turned) || (phases & (phases - 1u)) != 0) {
        allowed |= BIT(CAUSE_ENCODER_ANGLE);
    }
    const unsigned cause = oracle->drive.fault;
    const bool own_work = cause == CAUSE_OVER_CURRENT || cause == CAUSE_HARDWARE_OVER_CURRENT; /* of the drive */
    if ((allowed >> cause & 1u) || ((any || !own_work) && true_of_plant(oracle, cause, plant))) {
        return;
    }
    violate(oracle, any ? "wrong_cause" : "false_alarm", plant->time_ns, cause, (double)oracle->drive.checks);
}

static void enter_run(oracle_t *oracle, const plant_t *plant) {
    if (oracle->recovered || oracle->world->recovery_us == 0 ||
        plant->time_ns < oracle->world->recovery_us * 1000 + 25 * MS_NS) {
        return;
    }
    const machine_t *machine = plant->machine;
    const double change_rad_s = fabs(oracle->recovery_rpm / RPM_PER_RAD_S - plant->speed_rad_s);
    const double needed_s = machine->inertia_kg_m2 * oracle->world->inertia_gain * change_rad_s /
                            (0.5 * oracle->world->machine->torque_max_Nm);
    oracle->recovered = true;
    oracle->settle_by_ns = plant->time_ns + (uint64_t)((0.1 + needed_s) * 1e9);
}

void oracle_after_interrupt(oracle_t *oracle, const plant_t *plant, oracle_drive_t drive) {
    const uint8_t before = oracle->drive.state;
    const double stroke_rad = TWO_PI / (plant->machine->rotor_poles * plant->machine->phases);
    oracle->turned = oracle->turned || fabs(plant->rotor_angle_rad - oracle->run_angle_rad) > stroke_rad;
    oracle->drive = drive;
    oracle->interrupt_ns = plant->time_ns;
    look_at_angle(oracle, plant);
    unsigned gates = gates_on(plant);
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        const half_bridge_pattern_t *pattern = &plant->pattern[phase];
        for (unsigned edge = plant->edge_next[phase]; edge < pattern->count; edge++) {
            gates |= pattern->switches[edge];
        }
    }
    if (gates && drive.state != STATE_RUN) {
        violate(oracle, "gate_on", plant->time_ns, 1, drive.state);
    }
    if (drive.state == STATE_RUN && !state_changed(oracle) && plant->time_ns > oracle->run_ns + RUN_MAX_NS) {
        violate(oracle, "no_command", plant->time_ns, 6, (double)(plant->time_ns - oracle->run_ns) * 1e-6);
    }
    if (drive.state == STATE_FAULT && before != STATE_FAULT) {
        oracle->confirmed = oracle->clear_seen = false;
        if (oracle->causes < ORACLE_CAUSES_MAX) {
            oracle->cause[oracle->causes++] = drive.fault;
        }
        if (oracle->causes == 1) {
            oracle->cause_us = plant->time_ns / 1000;
        }
        judge_cause(oracle, plant);
        const uint32_t up_to = (BIT(drive.fault) << 1) - 1;
        if (drive.checks != 0 && (drive.checks & up_to) != BIT(drive.fault) && !state_changed(oracle)) {
            violate(oracle, "not_first", plant->time_ns, drive.fault, (double)drive.checks);
        }
        if (oracle->recovered && oracle->recovery_judged && !oracle->settled && !bus_disturbed(oracle)) {
            violate(oracle, "not_recovered", plant->time_ns, 3, drive.fault);
        }
    } else if (drive.state == STATE_RUN && before != STATE_RUN) {
        oracle->run_angle_rad = plant->rotor_angle_rad;
        oracle->turned = false;
        enter_run(oracle, plant);
    } else if (drive.state == STATE_READY && before == STATE_RUN) {
        const uint64_t age_ns = plant->time_ns > oracle->run_ns ? plant->time_ns - oracle->run_ns : 0;
        if (!oracle->off_seen && age_ns < 30 * MS_NS && !state_changed(oracle) &&
            !may_be_deaf(oracle, plant->time_ns / 1000)) {
            violate(oracle, "stopped", plant->time_ns, 0, 0.0);
        }
    } else if (drive.state != STATE_FAULT && before == STATE_FAULT && !oracle->clear_seen && !state_changed(oracle) &&
               !may_be_deaf(oracle, plant->time_ns / 1000) && !impersonated(oracle)) {
        violate(oracle, "no_command", plant->time_ns, 5, 0.0);
    }
}

void oracle_reset(oracle_t *oracle, oracle_drive_t drive) {
    oracle->drive = drive;
    oracle->confirmed = false;
}

void oracle_on_bus(oracle_t *oracle, uint64_t time_ns, const sender_meaning_t *meaning) {
    if (!meaning->genuine) {
        return;
    }
    if (meaning->confirms) {
        oracle->confirmed = true;
    } else if (meaning->command && meaning->request == SENDER_RUN) {
        oracle->run_ns = time_ns;
        oracle->commanded = true;
        oracle->off_seen = false;
    }
    oracle->clear_seen = oracle->clear_seen || (meaning->command && meaning->request == SENDER_CLEAR);
    if (meaning->command && meaning->request != SENDER_RUN && !oracle->off_seen) {
        oracle->off_seen = true;
        oracle->off_ns = time_ns;
    }
}

void oracle_on_fault(oracle_t *oracle, const plant_t *plant, unsigned kind, bool begins) {
    if (!begins || kind >= FAULT_COUNT) {
        return;
    }
    oracle->injected[kind] = true;
    const double pitches = plant->rotor_angle_rad * plant->machine->rotor_poles / TWO_PI;
    const unsigned sector = (unsigned)((pitches - floor(pitches)) * ORACLE_SECTORS) % ORACLE_SECTORS;
    const unsigned cell = (kind * ORACLE_STATES + oracle->drive.state % ORACLE_STATES) * ORACLE_SECTORS + sector;
    oracle->cell[cell / 8] |= (uint8_t)(1u << cell % 8);
}
