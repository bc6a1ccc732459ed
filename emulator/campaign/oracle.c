#include "campaign/oracle.h"

#include <math.h>
#include <string.h>

#include "bench_variables.h"
#include "campaign/oracle_parts.h"
#include "fault_kinds.h"

#define RECENT_NS (2 * ORACLE_MS_NS)
#define MARGIN 1.02
#define CONDUCTING 0.1 /* of the trip current, */
#define CONDUCTED_NS (4 * ORACLE_MS_NS)
#define HALF_TURN (UINT32_C(1) << 31)
#define UNDER_VOLTAGE_PART 0.94
#define STO_DIFFERED_US 215000 /* lines of safe torque off: then both have to be off once */
#define STATUS_AGE_MAX_NS (30 * ORACLE_MS_NS)
#define LOAD_ANSWERED_NS (200 * ORACLE_MS_NS)
#define CROSSED_NS (15 * ORACLE_MS_NS)
#define SILENCE_NS (40 * ORACLE_MS_NS) /* of a client that sends each 10 ms: then the torque ramps to zero */
#define SAVING_NS (100 * ORACLE_MS_NS)
#define UNSEEN_PERIODS 3                /* from a cause to the state that follows the sample which shows it */
#define RUN_MAX_NS (502 * ORACLE_MS_NS) /* of a run, since the last request */

void oracle_init(oracle_t *oracle, const world_t *world, const plant_t *plant, uint64_t period_ns) {
    *oracle = (oracle_t){.world = world, .period_ns = period_ns};
    oracle->voltage_recent_low_V = INFINITY;
    magnetics_point_t aligned;
    magnetics_evaluate(&plant->magnetics, 0.0, world->machine->trip_current_A, &aligned);
    oracle->detection.largest_flux_Wb = aligned.flux_linkage_Wb;
    oracle_read_world(oracle);
    oracle->encoder_offset_rev = oracle_encoder_offset_rev(world);
}

void oracle_violate(oracle_t *oracle, const char *rule, uint64_t time_ns, unsigned number, double value) {
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

void oracle_since(uint64_t *begin_ns, bool holds, uint64_t now_ns) {
    *begin_ns = !holds ? 0 : *begin_ns ? *begin_ns : now_ns;
}

/* A line of safe torque off is not energised. */
static bool sto_demanded(const oracle_t *oracle, uint64_t time_us) {
    for (unsigned i = 0; i < oracle->world->events; i++) {
        const world_event_t *event = &oracle->world->event[i];
        if (event->kind == WORLD_SET && (event->what == BENCH_VARIABLE_STO_1 || event->what == BENCH_VARIABLE_STO_2) &&
            world_active(oracle->world, i, time_us)) {
            return true;
        }
    }
    return false;
}

/* Numbers of the rule `cleared`, besides those of the states initialise and fault: the cause was there a moment ago. */
enum { CLEARED_BEFORE = 4, CLEARED_UNCOUNTED, CLEARED_LINES };

/* --- Never --- */

static void look_at_currents(oracle_t *oracle, const plant_t *plant, unsigned gates) {
    const double threshold_A = plant->machine->trip_current_A;
    bool above = false;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        const double current_A = plant_current_A(plant, phase);
        oracle->current_recent_A = fmax(oracle->current_recent_A, current_A);
        oracle->surged = oracle->surged || (threshold_A > 0.0 && current_A > 2.0 * threshold_A);
        uint64_t *since_ns = &oracle->conducting_ns[phase];
        oracle_since(since_ns, current_A > CONDUCTING * oracle->world->machine->trip_current_A, plant->time_ns);
        if (*since_ns && plant->time_ns > *since_ns + CONDUCTED_NS) {
            oracle->conducted_ns[phase] = plant->time_ns;
        }
        if (!(gates >> phase & 1u) || current_A <= threshold_A || threshold_A == 0.0) {
            continue;
        }
        magnetics_point_t point;
        magnetics_evaluate(&plant->magnetics, plant_phase_angle_rad(plant, phase), current_A, &point);
        const double rise_A = plant->bus_voltage_V * (double)oracle->period_ns * 1e-9 / point.incremental_inductance_H;
        if (current_A > threshold_A + rise_A) {
            above = true;
            if (++oracle->over_current_looks >= 2) {
                oracle_violate(oracle, "over_current", plant->time_ns, phase, current_A / threshold_A);
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
        if (oracle_variable_begun(oracle, variables[i], time_us)) {
            return true;
        }
    }
    return oracle_other_sender(oracle, false, time_us) ||
           oracle_any_injected(oracle, FAULT_BACKGROUND_HUNG, FAULT_INTERRUPT_STORM);
}

/* Frames of the only sender, sent once more while it is silent, are its frames: nothing but the arming tells them. */
static bool impersonated(const oracle_t *oracle) {
    bool silent = false, replayed = false;
    for (unsigned i = 0; i < oracle->world->events; i++) {
        const world_event_t *event = world_begun(oracle->world, i, UINT64_MAX);
        if (event != NULL) {
            silent = silent || event->kind == WORLD_SILENT;
            replayed = replayed || (event->kind == WORLD_HOSTILE && event->what == WORLD_HOSTILE_REPLAY);
        }
    }
    return silent && replayed;
}

/* A frame may wait in the drive for its background, at most for the watchdog's 18 ms. */
static uint64_t request_max_ns(const oracle_t *oracle, uint64_t max_ns) {
    return max_ns + (oracle_any_injected(oracle, FAULT_BACKGROUND_HUNG, FAULT_INTERRUPT_STORM) ? 18 * ORACLE_MS_NS : 0);
}

/* A load that has begun shortly before the last request, or since, or that moves: the speed controller answers it. */
static bool answers_load(const oracle_t *oracle, uint64_t now_us) {
    bool answers = false;
    for (unsigned i = 0; i < oracle->world->events; i++) {
        const world_event_t *event = world_begun(oracle->world, i, now_us);
        if (event == NULL) {
            continue;
        }
        const bool begins = oracle_is_load(event) && event->begin_us * 1000 + LOAD_ANSWERED_NS > oracle->run_ns;
        answers = answers || begins || oracle_is_load_sine(event);
    }
    return answers;
}

static void look_at_commands(oracle_t *oracle, const plant_t *plant) {
    const uint64_t now_ns = plant->time_ns;
    if (!oracle->confirmed && !may_be_deaf(oracle, now_ns / 1000)) {
        oracle_violate(oracle, "no_command", now_ns, 1, 0.0);
    }
    if (oracle->off_seen && now_ns > oracle->off_ns + 5 * ORACLE_MS_NS && !may_be_deaf(oracle, now_ns / 1000)) {
        oracle_violate(oracle, "no_command", now_ns, 2, 0.0);
    }
    /* The plant may not have advanced to the frame yet. */
    const uint64_t age_ns = now_ns > oracle->run_ns ? now_ns - oracle->run_ns : 0;
    if (!oracle->commanded || age_ns > request_max_ns(oracle, RUN_MAX_NS)) {
        oracle_violate(oracle, "no_command", now_ns, 3, (double)age_ns * 1e-6);
    } else if (age_ns < 55 * ORACLE_MS_NS) {
        const double before_Nm = age_ns < 10 * ORACLE_MS_NS ? 0.0 : oracle->silence_torque_Nm;
        oracle->silence_torque_Nm = fmax(fabs(plant_torque_Nm(plant)), before_Nm);
    } else if (age_ns > request_max_ns(oracle, 65 * ORACLE_MS_NS) && !oracle_any_injected(oracle, 1, FAULT_COUNT - 1) &&
               !oracle->bus_disturbed && !answers_load(oracle, now_ns / 1000) &&
               (oracle->world->controller == 2 || plant->speed_rad_s > 0.0) && /* freewheeling, it generates */
               fabs(plant_torque_Nm(plant)) >
                   1.5 * oracle->silence_torque_Nm + 0.2 * oracle->world->machine->torque_max_Nm) {
        oracle_violate(oracle, "no_command", now_ns, 7, plant_torque_Nm(plant));
    } else if (age_ns > request_max_ns(oracle, 170 * ORACLE_MS_NS) && !oracle_phases_at_fault(oracle, now_ns / 1000) &&
               !oracle_encoder_faulty(oracle) &&
               fabs(plant_torque_Nm(plant)) > 0.2 * oracle->world->machine->torque_max_Nm) {
        oracle_violate(oracle, "no_command", now_ns, 4, plant_torque_Nm(plant));
    }
}

/* A link voltage below the threshold, in a run. */
static void look_at_under_voltage(oracle_t *oracle, const plant_t *plant) {
    oracle_since(&oracle->low_ns,
                 oracle->drive.state == STATE_RUN && !oracle_link_sensor_faulty(oracle) &&
                     plant->bus_voltage_V < UNDER_VOLTAGE_PART * oracle->world->machine->under_voltage_V,
                 plant->time_ns);
    if (oracle->low_ns && plant->time_ns > oracle->low_ns + 3 * ORACLE_MS_NS &&
        !oracle_drive_disturbed(oracle, plant->time_ns / 1000)) {
        oracle_violate(oracle, "under_voltage", plant->time_ns, 0,
                       plant->bus_voltage_V / oracle->world->machine->under_voltage_V);
    }
}

/* Part of the speed that an encoder shows which loses counts in each revolution, at least. */
static double shown_speed(const world_t *world) {
    double shown = 1.0;
    for (unsigned i = 0; i < world->events; i++) {
        const world_event_t *event = world_begun(world, i, UINT64_MAX);
        if (event != NULL && event->kind == WORLD_FAULT && event->what == FAULT_ENCODER_LOST_COUNTS) {
            shown = fmin(shown, 1.0 - ldexp(event->value, -(int)world->encoder_bits));
        }
    }
    return shown;
}

/* An encoder that is frozen, or does not answer from a start on, shows nothing while the load turns a rotor without
 * current. */
static bool turns_unseen(const oracle_t *oracle, const plant_t *plant) {
    return (oracle->injected[FAULT_ENCODER_STUCK] || oracle->injected[FAULT_ENCODER_NO_ANSWER]) &&
           oracle_overhauled(oracle, plant->speed_rad_s);
}

static void look_at_limits(oracle_t *oracle, const plant_t *plant, unsigned gates) {
    const world_machine_t *machine = oracle->world->machine;
    const double speed_rpm = fabs(plant->speed_rad_s) * ORACLE_RPM_PER_RAD_S;
    const double limit_rpm = MARGIN * machine->over_speed_rpm;
    oracle_since(&oracle->speed_ns,
                 gates && speed_rpm > limit_rpm && speed_rpm * shown_speed(oracle->world) > limit_rpm &&
                     !turns_unseen(oracle, plant),
                 plant->time_ns);
    if (oracle->speed_ns && plant->time_ns > oracle->speed_ns + 2 * ORACLE_MS_NS) {
        oracle_violate(oracle, "over_speed", plant->time_ns, 0, speed_rpm / machine->over_speed_rpm);
    }
    oracle_since(&oracle->voltage_ns,
                 gates && plant->machine->dc_link.capacitance_F > 0.0 && !oracle_link_sensor_faulty(oracle) &&
                     plant->bus_voltage_V > MARGIN * machine->over_voltage_V,
                 plant->time_ns);
    if (oracle->voltage_ns && plant->time_ns > oracle->voltage_ns + ORACLE_MS_NS / 5) {
        oracle_violate(oracle, "over_voltage", plant->time_ns, 0, plant->bus_voltage_V / machine->over_voltage_V);
    }
}

/* Remembers when the plant last had a reason to keep a drive in a fault. */
static void look_at_causes(oracle_t *oracle, const plant_t *plant) {
    const world_machine_t *machine = oracle->world->machine;
    const bool voltage =
        !oracle_link_sensor_faulty(oracle) && (plant->bus_voltage_V > MARGIN * machine->over_voltage_V ||
                                               plant->bus_voltage_V * MARGIN < machine->under_voltage_V);
    const bool observed = !oracle_encoder_faulty(oracle) &&
                          !oracle_any_injected(oracle, FAULT_BACKGROUND_HUNG, FAULT_INTERRUPT_STORM) &&
                          plant->time_ns > oracle->reset_ns + 10 * ORACLE_MS_NS;
    const bool speed = observed && fabs(plant->speed_rad_s) * ORACLE_RPM_PER_RAD_S > MARGIN * machine->over_speed_rpm;
    if (voltage || speed || sto_demanded(oracle, (plant->time_ns - 1) / 1000)) {
        const bool begins = oracle->cause_ns == 0 || plant->time_ns > oracle->cause_ns + 2 * ORACLE_LOOK_NS;
        oracle->cause_begin_ns = begins ? plant->time_ns : oracle->cause_begin_ns;
        oracle->cause_ns = plant->time_ns;
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
    oracle_since(&oracle->dark_ns, gates == 0, plant->time_ns);
    look_at_currents(oracle, plant, gates);
    look_at_limits(oracle, plant, gates);
    look_at_under_voltage(oracle, plant);
    look_at_causes(oracle, plant);
    oracle_look_at_detection(oracle, plant);
    oracle_look_at_recovery(oracle, plant);
    if (gates == 0) {
        return;
    }
    const uint64_t time_us = (plant->time_ns - 1) / 1000; /* a change of this instant comes after the look */
    if (sto_demanded(oracle, time_us)) {
        oracle_violate(oracle, "gate_on", plant->time_ns, 2, 0.0);
    }
    if (oracle->unacknowledged && !oracle_state_changed(oracle) && !impersonated(oracle) &&
        !oracle_other_sender(oracle, true, time_us)) {
        oracle_violate(oracle, "no_command", plant->time_ns, 8, (double)(plant->time_ns - oracle->reset_ns) * 1e-6);
    }
    const uint64_t longer = oracle->injected[FAULT_PERIOD_REGISTER_FLIPPED] ? 4 : 1; /* times the period, at most */
    if (plant->time_ns > oracle->interrupt_ns + longer * oracle->period_ns * 5 / 2) {
        oracle_violate(oracle, "gate_on", plant->time_ns, 3, (double)(plant->time_ns - oracle->interrupt_ns) * 1e-3);
    }
    look_at_commands(oracle, plant);
}

/* After bus-off a request to run has to be withdrawn before it starts the drive again. */
static void look_at_start(oracle_t *oracle, uint64_t now_ns) {
    for (unsigned i = 0; i < oracle->world->events; i++) {
        const world_event_t *event = world_begun(oracle->world, i, now_ns / 1000);
        if (event == NULL || event->kind != WORLD_SET || event->what != BENCH_VARIABLE_TRANSMIT_ERROR_COUNTER) {
            continue;
        }
        const uint64_t begin_ns = event->begin_us * 1000 + ORACLE_MS_NS;
        if (oracle->withdrawn_ns < begin_ns && oracle->reset_ns < begin_ns && now_ns > begin_ns + ORACLE_MS_NS) {
            oracle_violate(oracle, "resumed", now_ns, 0, (double)(now_ns - begin_ns) * 1e-6);
        }
    }
}

/* The encoder repeats a count, and nothing else is wrong with it. */
static bool encoder_stands(const oracle_t *oracle, uint64_t now_us) {
    for (unsigned i = 0; i < oracle->world->events; i++) {
        const world_event_t *event = &oracle->world->event[i];
        if (event->kind == WORLD_FAULT && event->what == FAULT_ENCODER_STUCK &&
            world_active(oracle->world, i, now_us)) {
            return !oracle_any_injected(oracle, FAULT_ENCODER_JUMP, FAULT_ENCODER_NO_ANSWER);
        }
    }
    return false;
}

/* Lines of safe torque off that have differed for long, and have not been off together since. */
static bool sto_discrepancy_remains(const oracle_t *oracle, uint64_t now_us) {
    uint64_t begin_us = 0, end_us = 0;
    unsigned changes = 0;
    for (unsigned i = 0; i < oracle->world->events; i++) {
        const world_event_t *event = world_begun(oracle->world, i, now_us);
        if (event != NULL && event->kind == WORLD_SET &&
            (event->what == BENCH_VARIABLE_STO_1 || event->what == BENCH_VARIABLE_STO_2)) {
            begin_us = event->begin_us;
            end_us = event->end_us != 0 && event->end_us < now_us ? event->end_us : now_us;
            changes++;
        }
    }
    return changes == 1 && end_us > begin_us + STO_DIFFERED_US && oracle->reset_ns < begin_us * 1000;
}

/* A cause that has ended a moment ago may come again; and a request to clear that was there before the fault is none.
 */
static void look_at_end_of_fault(oracle_t *oracle, uint64_t now_ns, uint8_t before) {
    if (before == STATE_FAULT && sto_discrepancy_remains(oracle, now_ns / 1000) && !oracle_state_changed(oracle)) {
        oracle_violate(oracle, "cleared", now_ns, CLEARED_LINES, 0.0);
    }
    if (before == STATE_FAULT && oracle->causes > 0 && oracle->causes < ORACLE_CAUSES_MAX &&
        oracle->cause[oracle->causes - 1] == CAUSE_ENCODER && !oracle->counted &&
        oracle->reset_ns < oracle->latched_ns && !oracle_state_changed(oracle)) {
        oracle_violate(oracle, "cleared", now_ns, CLEARED_UNCOUNTED, 0.0);
    }
    if (before == STATE_FAULT && oracle->clear_ns != 0 && oracle->clear_ns + 5 * ORACLE_MS_NS < oracle->latched_ns &&
        oracle->reset_ns < oracle->latched_ns && !oracle_state_changed(oracle) && !may_be_deaf(oracle, now_ns / 1000) &&
        !impersonated(oracle)) {
        oracle_violate(oracle, "cleared", now_ns, CLEARED_BEFORE,
                       (double)(oracle->latched_ns - oracle->clear_ns) * 1e-6);
    }
    const uint64_t gone_ns = before == STATE_FAULT ? 8 * ORACLE_MS_NS : ORACLE_MS_NS / 2;
    const bool begins = now_ns < oracle->cause_begin_ns + UNSEEN_PERIODS * oracle->period_ns ||
                        (before == STATE_INITIALISE && oracle->injected[FAULT_SUPPLY_RIPPLE]);
    if (oracle->cause_ns && now_ns < oracle->cause_ns + gone_ns && !oracle_state_changed(oracle) && !begins &&
        !oracle_any_injected(oracle, FAULT_LIMIT_FLIPPED, FAULT_CLOCK_DRIFT)) {
        oracle_violate(oracle, "cleared", now_ns, before, (double)(now_ns - oracle->cause_ns) * 1e-6);
    }
}

void oracle_after_interrupt(oracle_t *oracle, const plant_t *plant, oracle_drive_t drive) {
    const uint8_t before = oracle->drive.state;
    const double stroke_rad = oracle_stroke_rad(plant);
    oracle->turned = oracle->turned || fabs(plant->rotor_angle_rad - oracle->run_angle_rad) > stroke_rad;
    oracle->drive = drive;
    if (drive.state != before) {
        oracle->telemetry.ran = before == STATE_RUN && plant->time_ns > oracle->state_ns + 100 * ORACLE_MS_NS;
        oracle->state_ns = plant->time_ns;
    }
    oracle->interrupt_ns = plant->time_ns;
    const uint32_t moved = drive.angle - oracle->latched_angle;
    const uint32_t distance = moved < HALF_TURN ? moved : 0u - moved;
    oracle->counted = oracle->counted || distance >> (31 - oracle->world->encoder_bits) != 0;
    oracle_look_at_measurement(oracle, plant);
    oracle_remember_measurement(oracle, plant);
    oracle_look_at_motion(oracle, plant);
    if (before != drive.state && drive.state == STATE_READY && before != STATE_RUN) {
        look_at_end_of_fault(oracle, plant->time_ns, before);
    }
    unsigned gates = gates_on(plant);
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        const half_bridge_pattern_t *pattern = &plant->pattern[phase];
        for (unsigned edge = plant->edge_next[phase]; edge < pattern->count; edge++) {
            gates |= pattern->switches[edge];
        }
    }
    if (gates && drive.state != STATE_RUN) {
        oracle_violate(oracle, "gate_on", plant->time_ns, 1, drive.state);
    }
    if (drive.state == STATE_RUN && !oracle_state_changed(oracle) &&
        plant->time_ns > oracle->run_ns + request_max_ns(oracle, RUN_MAX_NS)) {
        oracle_violate(oracle, "no_command", plant->time_ns, 6, (double)(plant->time_ns - oracle->run_ns) * 1e-6);
    }
    if (drive.state == STATE_FAULT && before != STATE_FAULT) {
        oracle->confirmed = oracle->clear_seen = false;
        oracle->latched_ns = plant->time_ns;
        oracle->latched_angle = drive.angle;
        oracle->counted = !encoder_stands(oracle, plant->time_ns / 1000);
        oracle_remember_fault(oracle, plant);
        if (oracle->causes < ORACLE_CAUSES_MAX) {
            oracle->cause[oracle->causes++] = drive.fault;
        }
        if (oracle->causes == 1) {
            oracle->cause_us = plant->time_ns / 1000;
        }
        oracle_judge_cause(oracle, plant);
        const uint32_t up_to = (BIT(drive.fault) << 1) - 1;
        if (drive.checks != 0 && (drive.checks & up_to) != BIT(drive.fault) && !oracle_state_changed(oracle)) {
            oracle_violate(oracle, "not_first", plant->time_ns, drive.fault, (double)drive.checks);
        }
        if (oracle->recovered && oracle->recovery_judged && !oracle->settled && !oracle->bus_disturbed) {
            oracle_violate(oracle, "not_recovered", plant->time_ns, 3, drive.fault);
        }
    } else if (drive.state == STATE_RUN && before != STATE_RUN) {
        look_at_start(oracle, plant->time_ns);
        oracle->run_angle_rad = plant->rotor_angle_rad;
        oracle->begin_speed_rad_s = plant->speed_rad_s;
        oracle->turned = false;
        oracle_enter_run(oracle, plant);
    } else if (drive.state == STATE_READY && before == STATE_RUN) {
        oracle->confirmed = false;
        const uint64_t age_ns = plant->time_ns > oracle->run_ns ? plant->time_ns - oracle->run_ns : 0;
        /* A stop may end when the request to run is already on the bus. */
        const bool stops = oracle->meant.request == SENDER_STOP || plant->time_ns < oracle->withdrawn_ns + CROSSED_NS;
        const double rest_rpm = 20.0 + 0.05 * oracle->world->machine->speed_base_rpm +
                                oracle_added_rad_s(oracle, plant) * ORACLE_RPM_PER_RAD_S;
        const bool rests =
            stops && (oracle_encoder_faulty(oracle) || fabs(plant->speed_rad_s) * ORACLE_RPM_PER_RAD_S < rest_rpm);
        if (!oracle->off_seen && !rests && age_ns < 30 * ORACLE_MS_NS && !oracle_state_changed(oracle) &&
            !may_be_deaf(oracle, plant->time_ns / 1000)) {
            oracle_violate(oracle, "stopped", plant->time_ns, oracle->meant.request, plant->speed_rad_s);
        }
    } else if (drive.state != STATE_FAULT && before == STATE_FAULT && !oracle->clear_seen &&
               !oracle_state_changed(oracle) && !may_be_deaf(oracle, plant->time_ns / 1000) && !impersonated(oracle)) {
        oracle_violate(oracle, "no_command", plant->time_ns, 5, 0.0);
    }
}

/* By the bench, not by the watchdog. */
static bool reset_by_bench(const oracle_t *oracle, uint64_t now_us) {
    for (unsigned i = 0; i < oracle->world->events; i++) {
        const world_event_t *event = world_begun(oracle->world, i, now_us);
        if (event != NULL && event->kind == WORLD_SET && event->what == BENCH_VARIABLE_DRIVE_RESET &&
            now_us < event->begin_us + 1000) {
            return true;
        }
    }
    return false;
}

void oracle_reset(oracle_t *oracle, uint64_t time_ns, oracle_drive_t drive) {
    const bool saved = oracle->saved_ns != 0 && time_ns > oracle->saved_ns + SAVING_NS;
    oracle->applied = saved ? oracle->applied : 0;
    oracle->unacknowledged = !reset_by_bench(oracle, time_ns / 1000);
    oracle->drive = drive;
    oracle->state_ns = oracle->reset_ns = time_ns;
    oracle->clear_ns = 0; /* a request that goes on begins anew, when the drive listens again */
    oracle->confirmed = false;
}

void oracle_on_bus(oracle_t *oracle, const plant_t *plant, uint64_t time_ns, const sender_meaning_t *meaning) {
    if (!meaning->genuine) {
        return;
    }
    oracle->succeeded = oracle->succeeded || meaning->other;
    if (meaning->confirms) {
        oracle->confirmed = true;
    }
    if (!meaning->command) {
        return;
    }
    const bool runs = meaning->request == SENDER_RUN || meaning->request == SENDER_STOP;
    const bool after_silence = time_ns > oracle->run_ns + SILENCE_NS;
    if (runs) { /* a stop is a run to rest */
        oracle->run_ns = time_ns;
        oracle->commanded = oracle->commanded || meaning->request == SENDER_RUN;
    }
    oracle->off_seen = meaning->request == SENDER_RUN ? false : oracle->off_seen;
    if (!runs && !oracle->off_seen) {
        oracle->off_seen = true;
        oracle->off_ns = time_ns;
    }
    oracle->clear_seen = oracle->clear_seen || meaning->request == SENDER_CLEAR;
    oracle->unacknowledged = oracle->unacknowledged && meaning->request != SENDER_CLEAR;
    if (meaning->request == SENDER_CLEAR &&
        (oracle->meant.request != SENDER_CLEAR || oracle->drive.state == STATE_RUN)) {
        oracle->clear_ns = time_ns; /* in a run it is refused, and so begins after it */
    }
    const bool stop_begins = meaning->request == SENDER_STOP && oracle->meant.request != SENDER_STOP;
    oracle->stop_speed_rad_s = stop_begins ? plant->speed_rad_s : oracle->stop_speed_rad_s;
    oracle->stop_ns = stop_begins || after_silence ? time_ns : oracle->stop_ns;
    oracle->withdrawn_ns = meaning->request != SENDER_RUN ? time_ns : oracle->withdrawn_ns;
    if (meaning->torque != oracle->meant.torque || meaning->reference != oracle->meant.reference ||
        meaning->request != oracle->meant.request || after_silence) {
        oracle->constant_ns = time_ns;
        oracle->begin_speed_rad_s = plant->speed_rad_s;
    }
    oracle->meant = *meaning;
}

void oracle_on_status(oracle_t *oracle, uint64_t time_ns, unsigned state, unsigned fault) {
    oracle->detection.status_ns = time_ns;
    const bool differs = state != oracle->drive.state || fault != oracle->drive.fault;
    if (differs && time_ns > oracle->state_ns + STATUS_AGE_MAX_NS && !oracle_state_changed(oracle) &&
        !oracle->bus_disturbed) {
        oracle_violate(oracle, "wrong_status", time_ns, state, fault);
    }
}

void oracle_on_fault(oracle_t *oracle, const plant_t *plant, unsigned kind, bool begins) {
    oracle->fault_ns = plant->time_ns;
    if (!begins || kind >= FAULT_COUNT) {
        return;
    }
    oracle->injected[kind] = true;
    const double pitches = plant->rotor_angle_rad * plant->machine->rotor_poles / ORACLE_TWO_PI;
    const unsigned sector = (unsigned)((pitches - floor(pitches)) * ORACLE_SECTORS) % ORACLE_SECTORS;
    const unsigned cell = (kind * ORACLE_STATES + oracle->drive.state % ORACLE_STATES) * ORACLE_SECTORS + sector;
    oracle->cell[cell / 8] |= (uint8_t)(1u << cell % 8);
}
