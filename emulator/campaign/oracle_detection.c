#include "campaign/oracle_parts.h"

#include <math.h>

#include "bench_variables.h"
#include "fault_kinds.h"

#define STEP_NS ORACLE_MS_NS
#define CLOCK_DRIFT_PERCENT 8.0
#define FLUX_LINKAGES 20.0 /* of the aligned position at the trip current, applied to a phase without any effect */
#define NO_CURRENT_A 1e-3
#define PULSE_PERIODS 3.0
#define PULSE_MIN_PART 64        /* of the period, an error that the voltage of any converter has */
#define MISLED_PITCH (1.0 / 6.0) /* error of the angle at which a phase makes torque in the other direction */
#define MISLED_SPEED 0.2         /* of the base speed, above which a wrong angle shows soon, */
#define MISLED_CURRENT 0.1       /* of the trip, */
#define MISLED_NS (200 * ORACLE_MS_NS)
#define HEARD_NS (50 * ORACLE_MS_NS) /* since the last command: then the torque ramps to zero */
#define BLOCKED_NS (300 * ORACLE_MS_NS)
#define SWINGING_NS (500 * ORACLE_MS_NS)
#define BLOCKED_SPEED 0.05 /* of the base speed, commanded */
#define LOST_US 100000
#define MUTE_NS (100 * ORACLE_MS_NS) /* bus-off for the second time included */
#define RESET_NS (60 * ORACLE_MS_NS)
#define CONTESTED_NS (150 * ORACLE_MS_NS)

/* Milliseconds after which a drive in a run has to have noticed what it can see at any time; 0: not of this sort. */
static unsigned noticed_within_ms(const oracle_t *oracle, const world_event_t *event) {
    switch (event->what) {
    case FAULT_LIMIT_FLIPPED:
        return event->raw < (int32_t)oracle->limit_bits ? 10 : 0;
    case FAULT_CONSTANT_FLIPPED:
        return event->raw < (int32_t)oracle->constant_bits ? 10 : 0;
    case FAULT_FAULT_LATCH_FLIPPED:
    case FAULT_PERIOD_REGISTER_FLIPPED:
        return 10;
    case FAULT_CURRENT_SENSOR_HIGH_RAIL:
    case FAULT_DC_LINK_SENSOR_OPEN:
    case FAULT_DC_LINK_SENSOR_LOW_RAIL:
    case FAULT_DC_LINK_SENSOR_HIGH_RAIL:
        return 2;
    case FAULT_WINDING_TEMPERATURE_SENSOR_OPEN:
    case FAULT_WINDING_TEMPERATURE_SENSOR_SHORTED:
    case FAULT_INVERTER_TEMPERATURE_SENSOR_OPEN:
    case FAULT_INVERTER_TEMPERATURE_SENSOR_SHORTED:
        return 60;
    case FAULT_CLOCK_DRIFT:
        return fabs(event->value) > CLOCK_DRIFT_PERCENT ? 60 : 0;
    case FAULT_BACKGROUND_HUNG:
    case FAULT_INTERRUPT_STORM:
        return 40;
    default:
        return 0;
    }
}

/* Late or lost interrupts and a background without time: what is checked is checked late. */
static bool checks_late(const oracle_t *oracle, uint64_t time_us) {
    return oracle_any_injected(oracle, FAULT_INTERRUPT_LOST, FAULT_INTERRUPT_STORM) ||
           oracle_variable_begun(oracle, BENCH_VARIABLE_INTERRUPT_TIME_US, time_us);
}

/* A reset writes anew what has changed in memory and registers, and a set of parameters the limits and constants. */
static bool written_anew(const oracle_t *oracle, const world_event_t *event) {
    const bool of_set = event->what == FAULT_LIMIT_FLIPPED || event->what == FAULT_CONSTANT_FLIPPED;
    return event->what >= FAULT_LIMIT_FLIPPED && event->what <= FAULT_PERIOD_REGISTER_FLIPPED &&
           (oracle->reset_ns >= event->begin_us * 1000 || (of_set && oracle->applied_ns >= event->begin_us * 1000));
}

static void look_at_kinds(oracle_t *oracle, uint64_t now_ns) {
    for (unsigned i = 0; i < oracle->world->events; i++) {
        const world_event_t *event = &oracle->world->event[i];
        if (event->kind != WORLD_FAULT || !world_active(oracle->world, i, now_ns / 1000) ||
            written_anew(oracle, event)) {
            continue;
        }
        const uint64_t within_ns = noticed_within_ms(oracle, event) * ORACLE_MS_NS;
        const uint64_t begin_ns = event->begin_us * 1000;
        const uint64_t since_ns = begin_ns > oracle->state_ns ? begin_ns : oracle->state_ns;
        const bool of_processor = event->what == FAULT_BACKGROUND_HUNG || event->what == FAULT_INTERRUPT_STORM;
        if (within_ns && now_ns > since_ns + within_ns && (of_processor || !checks_late(oracle, now_ns / 1000))) {
            oracle_violate(oracle, "undetected", now_ns, event->what, event->value);
        }
    }
}

/* Phases that have been without their switches or winding for long. */
static unsigned lost_phases(const oracle_t *oracle, uint64_t now_us) {
    unsigned phases = 0, count = 0;
    for (unsigned i = 0; i < oracle->world->events; i++) {
        const world_event_t *event = &oracle->world->event[i];
        const bool open =
            event->kind == WORLD_FAULT && (event->what == FAULT_WINDING_OPEN || event->what == FAULT_SWITCH_OPEN ||
                                           event->what == FAULT_GATE_SUPPLY_LOST);
        if (open && world_active(oracle->world, i, now_us) && now_us > event->begin_us + LOST_US &&
            !(phases >> event->phase & 1u)) {
            phases |= 1u << event->phase;
            count++;
        }
    }
    return count;
}

/* With two phases lost a drive that does not follow its reference does not run on, as it does with one. */
static void look_at_lost_phases(oracle_t *oracle, const plant_t *plant) {
    const bool heard = plant->time_ns < oracle->run_ns + HEARD_NS && !oracle->bus_disturbed;
    const double reference_rad_s = fabs(oracle->meant.reference) / ORACLE_RPM_PER_RAD_S;
    const bool drives =
        heard && oracle->drive.state == STATE_RUN && oracle->meant.request == SENDER_RUN && !oracle->meant.torque &&
        oracle_can_turn(oracle) &&
        reference_rad_s * ORACLE_RPM_PER_RAD_S > MISLED_SPEED * oracle->world->machine->speed_base_rpm &&
        fabs(plant->speed_rad_s) < 0.5 * reference_rad_s;
    oracle_since(&oracle->detection.lost_ns, drives && lost_phases(oracle, plant->time_ns / 1000) > 1, plant->time_ns);
    if (oracle->detection.lost_ns && plant->time_ns > oracle->detection.lost_ns + BLOCKED_NS &&
        plant->time_ns > oracle->constant_ns + BLOCKED_NS && !checks_late(oracle, plant->time_ns / 1000)) {
        oracle_violate(oracle, "two_lost", plant->time_ns, 0, plant->speed_rad_s);
    }
}

/* Commands of a client that is not the one which has armed the drive, or that are forged; or frames that are the
 * drive's. */
static void look_at_senders(oracle_t *oracle, uint64_t now_ns) {
    if (oracle_variable_begun(oracle, BENCH_VARIABLE_TRANSMIT_ERROR_COUNTER, now_ns / 1000) ||
        oracle_variable_begun(oracle, BENCH_VARIABLE_FRAME_FAULT, now_ns / 1000) ||
        oracle_variable_begun(oracle, BENCH_VARIABLE_BUS_CONNECTION, now_ns / 1000)) {
        return; /* the drive receives no command, or late */
    }
    for (unsigned i = 0; i < oracle->world->events; i++) {
        const world_event_t *event = &oracle->world->event[i];
        const bool foreign = event->kind == WORLD_SECOND ||
                             (event->kind == WORLD_HOSTILE &&
                              (event->what == WORLD_HOSTILE_FORGED || event->what == WORLD_HOSTILE_IDENTITY));
        if (!foreign || !world_active(oracle->world, i, now_ns / 1000)) {
            continue;
        }
        const uint64_t begin_ns = event->begin_us * 1000;
        const uint64_t since_ns = begin_ns > oracle->state_ns ? begin_ns : oracle->state_ns;
        if (now_ns > since_ns + CONTESTED_NS && !oracle->succeeded) {
            oracle_violate(oracle, "contested", now_ns, event->what, (double)(now_ns - since_ns) * 1e-6);
        }
    }
}

/* A drive that is no longer heard although the bus carries frames. */
static void look_at_status(oracle_t *oracle, uint64_t now_ns) {
    static const unsigned variables[] = {BENCH_VARIABLE_BABBLE_LOAD_PERCENT, BENCH_VARIABLE_BUS_CONNECTION,
                                         BENCH_VARIABLE_FRAME_FAULT};
    for (unsigned i = 0; i < sizeof variables / sizeof *variables; i++) {
        if (oracle_variable_begun(oracle, variables[i], now_ns / 1000)) {
            return;
        }
    }
    const uint64_t heard_ns =
        oracle->detection.status_ns > oracle->reset_ns ? oracle->detection.status_ns : oracle->reset_ns;
    if (now_ns > heard_ns + MUTE_NS && !checks_late(oracle, now_ns / 1000) &&
        !oracle_other_sender(oracle, true, now_ns / 1000)) {
        oracle_violate(oracle, "mute", now_ns, 0, (double)(now_ns - heard_ns) * 1e-6);
    }
}

/* Length of the present part of a period, between two edges of the phase. */
static uint64_t part_ns(const oracle_t *oracle, const plant_t *plant, unsigned phase) {
    const half_bridge_pattern_t *pattern = &plant->pattern[phase];
    const unsigned next = plant->edge_next[phase];
    const uint64_t begin_ns = next > 0 ? pattern->delay_ns[next - 1] : 0;
    return (next < pattern->count ? pattern->delay_ns[next] : oracle->period_ns) - begin_ns;
}

/* Voltage on a phase that is followed by no current at all, in pulses of more than PULSE_PERIODS: a shorter one the
 * opposite voltage may have ended before a sample. A current that an open diode ends is gone at once. Pulses of
 * a duty near zero do not count: a look in 25 or 50 may meet each of them, and would take 10 ns for 19 us. */
static void look_at_phases(oracle_t *oracle, const plant_t *plant) {
    const bool hidden = oracle_any_injected(oracle, FAULT_CURRENT_SENSOR_OPEN, FAULT_DC_LINK_SENSOR_OFFSET) ||
                        oracle->injected[FAULT_DIODE_OPEN] || checks_late(oracle, plant->time_ns / 1000);
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        double *flux_Wb = &oracle->detection.flux_Wb[phase];
        double *pulse_Wb = &oracle->detection.pulse_Wb[phase];
        const double step_Wb = plant->bus_voltage_V * (double)ORACLE_LOOK_NS * 1e-9;
        /* Looks meet a pulse once more than it has of their steps. */
        const double short_Wb = step_Wb + PULSE_PERIODS * plant->bus_voltage_V * (double)oracle->period_ns * 1e-9;
        if (oracle->drive.state != STATE_RUN || plant_current_A(plant, phase) > NO_CURRENT_A) {
            *flux_Wb = *pulse_Wb = 0.0;
        } else if (plant->switches[phase] == 0) {
            *pulse_Wb = fmax(0.0, fmin(*pulse_Wb, short_Wb) - step_Wb);
        } else if (plant->switches[phase] == 3 && part_ns(oracle, plant, phase) > oracle->period_ns / PULSE_MIN_PART) {
            *pulse_Wb += step_Wb;
            *flux_Wb += *pulse_Wb > short_Wb ? step_Wb : 0.0;
            if (*flux_Wb > FLUX_LINKAGES * oracle->detection.largest_flux_Wb && !hidden) {
                oracle_violate(oracle, "no_current", plant->time_ns, phase, *flux_Wb);
            }
        }
    }
}

/* Time for which the rotor has stayed within a range of angles while a constant speed is commanded. */
static uint64_t stays_ns(const oracle_t *oracle, oracle_stay_t *stay, const plant_t *plant, bool commanded,
                         double range_rad) {
    const double angle_rad = plant->rotor_angle_rad;
    const double low_rad = fmin(stay->low_rad, angle_rad), high_rad = fmax(stay->high_rad, angle_rad);
    if (!commanded || stay->since_ns < oracle->constant_ns || high_rad - low_rad > range_rad) {
        *stay = (oracle_stay_t){commanded ? plant->time_ns : 0, angle_rad, angle_rad};
        return 0;
    }
    stay->low_rad = low_rad;
    stay->high_rad = high_rad;
    return plant->time_ns - stay->since_ns;
}

/* The rotor does not turn although a speed is commanded. */
static void look_at_rotor(oracle_t *oracle, const plant_t *plant) {
    oracle_detection_t *detection = &oracle->detection;
    const double stroke_rad = oracle_stroke_rad(plant);
    if (fabs(plant->rotor_angle_rad - detection->stroke_rad) > stroke_rad) {
        detection->stroke_ns = plant->time_ns;
        detection->stroke_rad = plant->rotor_angle_rad;
    }
    const bool heard = plant->time_ns < oracle->run_ns + HEARD_NS && !oracle->bus_disturbed;
    const bool pushes = heard && oracle->drive.state == STATE_RUN && oracle->meant.request == SENDER_RUN &&
                        !oracle->meant.torque && oracle_can_turn(oracle) &&
                        fabs(oracle->meant.reference) > BLOCKED_SPEED * oracle->world->machine->speed_base_rpm;
    const uint64_t held_ns = stays_ns(oracle, &detection->held, plant, pushes, 0.25 * stroke_rad);
    const uint64_t swinging_ns = stays_ns(oracle, &detection->swinging, plant, pushes, stroke_rad);
    const double three_strokes_s = 3.0 * stroke_rad * ORACLE_RPM_PER_RAD_S / fabs(oracle->meant.reference);
    const uint64_t strokes_ns = pushes ? (uint64_t)(three_strokes_s * 1e9) : 0;
    const double pitch_rad = stroke_rad * plant->machine->phases;
    const uint64_t within_pitch_ns = stays_ns(oracle, &detection->within_pitch, plant, pushes, pitch_rad);
    detection->swings = within_pitch_ns > ORACLE_STALLED_NS + strokes_ns;
    const bool hidden = checks_late(oracle, plant->time_ns / 1000) || /* or the encoder shows a rotor that turns */
                        oracle_any_injected(oracle, FAULT_ENCODER_JUMP, FAULT_ENCODER_SLIP);
    if ((held_ns > BLOCKED_NS + strokes_ns || swinging_ns > SWINGING_NS + 2 * strokes_ns) && !hidden) {
        oracle_violate(oracle, "blocked", plant->time_ns, 0, (double)swinging_ns * 1e-6);
    }
}

/* A measured angle with which the torque is not what the drive takes it for. */
static void look_at_angle(oracle_t *oracle, const plant_t *plant) {
    const double pitches = (ldexp((double)oracle->drive.angle, -32) - plant->rotor_angle_rad / ORACLE_TWO_PI -
                            oracle->encoder_offset_rev) *
                           plant->machine->rotor_poles;
    const double error_pitches = pitches - floor(pitches + 0.5);
    const world_machine_t *machine = oracle->world->machine;
    const bool turns = fabs(plant->speed_rad_s) * ORACLE_RPM_PER_RAD_S > MISLED_SPEED * machine->speed_base_rpm;
    double current_A = 0.0;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        current_A = fmax(current_A, plant_current_A(plant, phase));
    }
    oracle_since(&oracle->detection.misled_ns,
                 oracle->drive.state == STATE_RUN && turns && current_A > MISLED_CURRENT * machine->trip_current_A &&
                     fabs(error_pitches) > MISLED_PITCH,
                 plant->time_ns);
    if (oracle->detection.misled_ns && plant->time_ns > oracle->detection.misled_ns + MISLED_NS &&
        !checks_late(oracle, plant->time_ns / 1000)) {
        oracle_violate(oracle, "misled", plant->time_ns, 0, error_pitches);
    }
}

void oracle_look_at_detection(oracle_t *oracle, const plant_t *plant) {
    oracle_detection_t *detection = &oracle->detection;
    look_at_phases(oracle, plant);
    if (plant->time_ns < detection->looked_ns + STEP_NS) {
        return;
    }
    detection->looked_ns = plant->time_ns;
    const uint64_t alive_ns = oracle->interrupt_ns > oracle->reset_ns ? oracle->interrupt_ns : oracle->reset_ns;
    if (plant->time_ns > alive_ns + RESET_NS) {
        oracle_violate(oracle, "not_reset", plant->time_ns, 0, (double)(plant->time_ns - alive_ns) * 1e-6);
    }
    if (oracle->drive.state == STATE_RUN && !oracle_state_changed(oracle)) {
        look_at_kinds(oracle, plant->time_ns);
        look_at_senders(oracle, plant->time_ns);
    }
    look_at_status(oracle, plant->time_ns);
    look_at_rotor(oracle, plant);
    look_at_lost_phases(oracle, plant);
    look_at_angle(oracle, plant);
}
