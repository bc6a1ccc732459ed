#include "campaign/facts.h"

#include <math.h>

#include "bench_variables.h"
#include "fault_kinds.h"

/* Default parameters of the drive. */
#define WINDING_LIMIT_C 155.0
#define INVERTER_LIMIT_C 100.0
#define DERATING_K 20.0

#define OBSERVED_S 3e-3       /* until speed and load are observed: three poles at 1000 rad/s */
#define PHASE_FAULT_US 250000 /* after its end a fault of a phase may still show */
#define WATCHDOG_NS (18 * MS_NS)
#define OLD_FRAMES_NS (30 * MS_NS) /* after a reset */
#define DERATED 0.8                /* of the largest torque */
#define PUSHING_SPEED 0.05         /* of the base speed, commanded */
#define HEARD_NS (50 * MS_NS)      /* since the last command: then the torque ramps to zero */

bool facts_disturbed(const observation_t *seen, uint32_t disturbs) {
    return (seen->disturbed & disturbs) != 0;
}

bool facts_disturbed_besides(const observation_t *seen, uint32_t disturbs, unsigned kind) {
    for (unsigned each = 1; each < FAULT_COUNT; each++) {
        if (each != kind && seen->present[each] && (fault_effect(each).disturbs & disturbs) != 0) {
            return true;
        }
    }
    return false;
}

bool facts_ever_disturbed(const observation_t *seen, uint32_t disturbs) {
    return (seen->ever_disturbed & disturbs) != 0;
}

bool facts_variable(const observation_t *seen, uint32_t disturbs) {
    return (seen->variables & disturbs) != 0;
}

bool facts_bus_disturbed(const observation_t *seen) {
    return facts_variable(seen, VARIABLE_LOSES_COMMANDS | VARIABLE_LOSES_STATUS) || seen->second_sender ||
           seen->hostile_sender;
}

bool facts_undisturbed(const observation_t *seen) {
    return seen->disturbed == 0 && !facts_bus_disturbed(seen);
}

bool facts_sto_demanded(const observation_t *seen, uint64_t time_us) {
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = &seen->world->event[i];
        if (event->kind == WORLD_SET && (variable_effect(event->what).disturbs & VARIABLE_STO) != 0 &&
            world_active(seen->world, i, time_us)) {
            return true;
        }
    }
    return false;
}

bool facts_is_load(const world_event_t *event) {
    return event->kind == WORLD_SET && (variable_effect(event->what).disturbs & VARIABLE_LOAD) != 0;
}

bool facts_is_load_sine(const world_event_t *event) {
    return event->kind == WORLD_SET && (variable_effect(event->what).disturbs & VARIABLE_LOAD_SINE) != 0;
}

bool facts_overhauled(const observation_t *seen, double speed) {
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = world_begun(seen->world, i, UINT64_MAX);
        if (event != NULL && facts_is_load(event) && event->raw * speed < 0.0) {
            return true;
        }
    }
    return false;
}

unsigned facts_phases_at_fault(const observation_t *seen, uint64_t now_us) {
    unsigned phases = 0;
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = world_begun(seen->world, i, now_us);
        if (event != NULL && event->kind == WORLD_FAULT &&
            (fault_effect(event->what).disturbs & (DISTURBS_PHASE | DISTURBS_CURRENT_SENSOR)) != 0 &&
            (event->end_us == 0 || event->end_us + PHASE_FAULT_US > now_us)) {
            phases |= 1u << event->phase;
        }
    }
    return phases;
}

bool facts_impersonated(const observation_t *seen) {
    bool silent = false, replayed = false;
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = world_begun(seen->world, i, UINT64_MAX);
        if (event != NULL) {
            silent = silent || event->kind == WORLD_SILENT;
            replayed = replayed || (event->kind == WORLD_HOSTILE && event->what == WORLD_HOSTILE_REPLAY);
        }
    }
    return silent && replayed;
}

bool facts_four_quadrants(const observation_t *seen) {
    return seen->world->controller == CONTROLLER_SALIENT;
}

bool facts_state_changed(const observation_t *seen) {
    return facts_disturbed(seen, DISTURBS_STATE);
}

bool facts_checks_late(const observation_t *seen) {
    return facts_disturbed(seen, DISTURBS_PROCESSOR) || facts_variable(seen, VARIABLE_DELAYS_INTERRUPTS);
}

bool facts_drive_disturbed(const observation_t *seen) {
    return facts_disturbed(seen, DISTURBS_MEMORY | DISTURBS_CLOCK) || facts_checks_late(seen);
}

bool facts_may_be_deaf(const observation_t *seen) {
    return facts_variable(seen, VARIABLE_LOSES_COMMANDS | VARIABLE_DELAYS_INTERRUPTS) || seen->second_sender ||
           facts_disturbed(seen, DISTURBS_BACKGROUND);
}

static uint64_t last_of_event_ns(const world_event_t *event) {
    return (event->end_us > event->begin_us ? event->end_us : event->begin_us) * 1000;
}

bool facts_may_be_unarmed(const observation_t *seen) {
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = world_begun(seen->world, i, seen->time_ns / 1000);
        if (event != NULL && event->kind == WORLD_SET &&
            (variable_effect(event->what).disturbs & VARIABLE_LOSES_COMMANDS) != 0 &&
            seen->client.confirmed_ns < last_of_event_ns(event)) {
            return true;
        }
    }
    return false;
}

bool facts_may_be_degraded(const observation_t *seen) {
    const uint64_t now_us = seen->time_ns / 1000;
    bool degraded = false, lost = false;
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = world_begun(seen->world, i, now_us);
        degraded = degraded || (event != NULL && event->kind == WORLD_DEGRADED);
        lost = lost || (event != NULL && event->kind == WORLD_FAULT &&
                        (fault_effect(event->what).disturbs & (DISTURBS_PHASE | DISTURBS_CURRENT_SENSOR)) != 0);
    }
    return degraded && lost && (seen->world->recovery_us == 0 || now_us < seen->world->recovery_us);
}

bool facts_frames_are_current(const observation_t *seen) {
    return !facts_bus_disturbed(seen) && !facts_checks_late(seen) && !seen->present[FAULT_CLOCK_DRIFT] &&
           seen->time_ns >= seen->reset_ns + OLD_FRAMES_NS;
}

bool facts_speed_is_observed(const observation_t *seen) {
    return !facts_disturbed(seen, DISTURBS_ENCODER | DISTURBS_CURRENT_SENSOR | DISTURBS_SHAFT | DISTURBS_LOAD |
                                      DISTURBS_MEMORY | DISTURBS_CLOCK);
}

bool facts_can_turn(const observation_t *seen) {
    return facts_four_quadrants(seen) || seen->client.meant.reference > 0.0;
}

bool facts_runs_by_speed(const observation_t *seen) {
    return seen->drive.state == STATE_RUN && seen->client.meant.request == SENDER_RUN && !seen->client.meant.torque &&
           !seen->client.meant.position && facts_can_turn(seen);
}

/* After bus-off, which disturbed frames lead to as well, a request to run has no effect until it has been withdrawn, or
 * the drive was reset. */
static bool is_void(const observation_t *seen) {
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = world_begun(seen->world, i, seen->time_ns / 1000);
        const bool ends_in_bus_off =
            event != NULL && event->kind == WORLD_SET &&
            (event->what == BENCH_VARIABLE_TRANSMIT_ERROR_COUNTER || event->what == BENCH_VARIABLE_FRAME_FAULT);
        if (ends_in_bus_off && seen->client.withdrawn_ns < last_of_event_ns(event) &&
            seen->reset_ns < last_of_event_ns(event)) {
            return true;
        }
    }
    return false;
}

bool facts_heard(const observation_t *seen) {
    return seen->time_ns < seen->client.run_ns + HEARD_NS && !is_void(seen);
}

bool facts_pushed(const observation_t *seen) {
    return facts_heard(seen) && !facts_bus_disturbed(seen) && facts_runs_by_speed(seen) &&
           fabs(seen->client.meant.reference) > PUSHING_SPEED * seen->world->machine->speed_base_rpm;
}

uint64_t facts_request_max_ns(const observation_t *seen, uint64_t max_ns) {
    return max_ns + (facts_disturbed(seen, DISTURBS_BACKGROUND) ? WATCHDOG_NS : 0);
}

double facts_stroke_rad(const observation_t *seen) {
    return TWO_PI / (seen->plant->machine->rotor_poles * seen->plant->machine->phases);
}

uint64_t facts_strokes_ns(const observation_t *seen, double strokes) {
    return (uint64_t)(strokes * facts_stroke_rad(seen) * RPM_PER_RAD_S / fabs(seen->client.meant.reference) * 1e9);
}

double facts_speed_rpm(const observation_t *seen) {
    return fabs(seen->plant->speed_rad_s) * RPM_PER_RAD_S;
}

double facts_base_rad_s(const observation_t *seen) {
    return seen->world->machine->speed_base_rpm / RPM_PER_RAD_S;
}

double facts_largest_current_A(const observation_t *seen) {
    double current_A = 0.0;
    for (unsigned phase = 0; phase < seen->plant->machine->phases; phase++) {
        current_A = fmax(current_A, plant_current_A(seen->plant, phase));
    }
    return current_A;
}

double facts_torque_max_Nm(const observation_t *seen) {
    const world_event_t *limited = seen->limit.limited;
    return seen->world->machine->torque_max_Nm * (limited != NULL ? limited->value : 1.0);
}

double facts_inertia_kg_m2(const observation_t *seen) {
    return seen->plant->machine->inertia_kg_m2 * seen->world->inertia_gain;
}

double facts_needed_s(const observation_t *seen, double change_rad_s) {
    return facts_inertia_kg_m2(seen) * change_rad_s / (0.5 * facts_torque_max_Nm(seen));
}

double facts_limit_Nm(const observation_t *seen, const uint8_t data[8]) {
    struct drive_thermal_t thermal;
    drive_thermal_unpack(&thermal, data, 8);
    return thermal.torque_limit_nm * 256.0 * seen->world->machine->command_lsb_Nm;
}

bool facts_derated(const observation_t *seen) {
    const observation_range_t *limit_Nm = &seen->limit.limit_Nm;
    return seen->limit.last_ns != 0 && fmin(limit_Nm->low[0], limit_Nm->low[1]) < DERATED * facts_torque_max_Nm(seen);
}

double facts_cool_part(double winding_C, double switch_C) {
    const double room = fmin(WINDING_LIMIT_C - winding_C, INVERTER_LIMIT_C - switch_C) / DERATING_K;
    return fmin(fmax(room, 0.0), 1.0);
}

bool facts_sets_in_effect(const observation_t *seen) {
    return seen->limit.limited != NULL && seen->limit.applied >= 2;
}

double facts_added_rad_s(const observation_t *seen) {
    const machine_t *machine = seen->plant->machine;
    const double late_s =
        3e-9 * (double)seen->period_ns + OBSERVED_S + seen->largest_flux_Wb / machine->supply_voltage_V;
    return late_s * seen->world->machine->torque_max_Nm / facts_inertia_kg_m2(seen);
}

double facts_uncounted_rad_s(const observation_t *seen) {
    const world_t *world = seen->world;
    const double count_rad = ldexp(TWO_PI, -(int)world->encoder_bits);
    return sqrt(2.0 * world->machine->torque_max_Nm / facts_inertia_kg_m2(seen) * count_rad);
}

/* --- Positions --- */

bool facts_untouched(const observation_t *seen) {
    return seen->ever_disturbed == 0 && !seen->second_sender && !seen->hostile_sender && !seen->master->wish.unsure &&
           seen->reset_ns == 0 && !facts_had_event(seen, WORLD_MASTER);
}

double facts_position_rev(const observation_t *seen) {
    return seen->plant->rotor_angle_rad / TWO_PI + seen->encoder_offset_rev - seen->start_rev;
}

double facts_count_rev(const observation_t *seen) {
    return ldexp(1.0, -(int)seen->world->encoder_bits);
}

static bool has_event(const observation_t *seen, world_kind_t kind, uint64_t by_us) {
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = world_begun(seen->world, i, by_us);
        if (event != NULL && event->kind == kind) {
            return true;
        }
    }
    return false;
}

bool facts_has_event(const observation_t *seen, world_kind_t kind) {
    return has_event(seen, kind, UINT64_MAX);
}

bool facts_had_event(const observation_t *seen, world_kind_t kind) {
    return has_event(seen, kind, seen->time_ns / 1000);
}

uint64_t facts_load_ns(const observation_t *seen) {
    uint64_t latest_us = 0;
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = world_begun(seen->world, i, seen->time_ns / 1000);
        if (event != NULL && facts_is_load(event)) {
            latest_us = event->begin_us > latest_us ? event->begin_us : latest_us;
        }
    }
    return latest_us * 1000;
}

bool facts_chooses_mode(const observation_t *seen, unsigned mode) {
    bool chooses = seen->world->master.mode == mode;
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = world_begun(seen->world, i, UINT64_MAX);
        chooses = chooses || (event != NULL && event->kind == WORLD_MODE && event->what == mode);
    }
    return seen->world->client == WORLD_CLIENT_CANOPEN && chooses;
}
