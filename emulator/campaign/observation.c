#include "campaign/observation.h"

#include <math.h>
#include <string.h>

#include "bench_variables.h"
#include "campaign/facts.h"
#include "fault_kinds.h"

#define RECENT_NS (2 * MS_NS)
#define CONDUCTING 0.1 /* fraction of the trip current above which a phase counts as conducting */
#define CONDUCTED_NS (4 * MS_NS)
#define BEYOND_LIMIT 1.02            /* a limit is exceeded for certain */
#define OBSERVER_NS (10 * MS_NS)     /* after a reset the drive does not know its speed */
#define SILENCE_NS (40 * MS_NS)      /* of a client that sends each 10 ms: then the torque ramps to zero */
#define SAVING_NS (100 * MS_NS)      /* until a set of parameters has been written */
#define LIMIT_WINDOW_NS (50 * MS_NS) /* one frame of the limit at least */
#define STALLED_NS (200 * MS_NS)     /* without a stroke */
#define SETTLING_S 0.1               /* of the speed, after what half of the torque needs */
#define IN_BAND_NS (2 * MS_NS)
#define HALF_TURN (UINT32_C(1) << 31)
#define AT_REST_RAD_S 2.0

_Static_assert(FAULT_COUNT <= OBSERVATION_KINDS_MAX, "room for every kind");

/* --- Tools --- */

void observation_since(uint64_t *begin_ns, bool holds, uint64_t now_ns) {
    *begin_ns = !holds ? 0 : *begin_ns ? *begin_ns : now_ns;
}

uint64_t observation_stays_ns(const observation_t *seen, observation_stay_t *stay, bool asked, double range_rad) {
    const double angle_rad = seen->plant->rotor_angle_rad;
    const double low_rad = fmin(stay->low_rad, angle_rad), high_rad = fmax(stay->high_rad, angle_rad);
    if (!asked || stay->since_ns < seen->client.constant_ns || high_rad - low_rad > range_rad) {
        *stay = (observation_stay_t){asked ? seen->time_ns : 0, angle_rad, angle_rad};
        return 0;
    }
    stay->low_rad = low_rad;
    stay->high_rad = high_rad;
    return seen->time_ns - stay->since_ns;
}

void observation_widen(observation_range_t *range, double value, bool renew) {
    if (renew) {
        range->low[1] = range->low[0];
        range->high[1] = range->high[0];
        range->low[0] = range->high[0] = value;
    }
    range->low[0] = fmin(range->low[0], value);
    range->high[0] = fmax(range->high[0], value);
}

bool observation_is_within(const observation_range_t *range, double value, double error) {
    return value >= fmin(range->low[0], range->low[1]) - error && value <= fmax(range->high[0], range->high[1]) + error;
}

/* --- Start --- */

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

static const world_event_t *limited(const world_t *world) {
    for (unsigned i = 0; i < world->events; i++) {
        const world_event_t *event = world_begun(world, i, UINT64_MAX);
        if (event != NULL && event->kind == WORLD_LIMITED) {
            return event;
        }
    }
    return NULL;
}

/* A bus-off has no end of its own. */
static bool is_present(const observation_t *seen, unsigned i) {
    const world_event_t *event = world_begun(seen->world, i, (seen->time_ns + MS_NS) / 1000);
    if (event == NULL) {
        return false;
    }
    const bool momentary = event->kind == WORLD_SET && event->what == BENCH_VARIABLE_TRANSMIT_ERROR_COUNTER;
    const uint64_t end_us = momentary ? event->begin_us : event->end_us != 0 ? event->end_us : UINT64_MAX / 2000;
    return seen->time_ns < end_us * 1000 + OBSERVATION_AFTER_NS;
}

static void look_at_events(observation_t *seen) {
    seen->disturbed = seen->ever_disturbed & DISTURBS_MEMORY ? seen->disturbed & (DISTURBS_MEMORY | DISTURBS_STATE) : 0;
    for (unsigned kind = 1; kind < FAULT_COUNT; kind++) {
        const uint64_t ended_ns = seen->ended_ns[kind];
        seen->present[kind] = seen->active[kind] || (ended_ns != 0 && seen->time_ns < ended_ns + OBSERVATION_AFTER_NS);
        seen->disturbed |= seen->present[kind] ? fault_effect(kind).disturbs : 0;
    }
    seen->variables = 0;
    seen->second_sender = seen->hostile_sender = false;
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = &seen->world->event[i];
        if (!is_present(seen, i)) {
            continue;
        }
        seen->variables |= event->kind == WORLD_SET ? variable_effect(event->what).disturbs : 0;
        seen->second_sender = seen->second_sender || event->kind == WORLD_SECOND;
        seen->hostile_sender = seen->hostile_sender || event->kind == WORLD_HOSTILE;
    }
}

void observation_start(observation_t *seen, const world_t *world, const plant_t *plant, uint64_t period_ns) {
    *seen = (observation_t){.world = world, .plant = plant, .period_ns = period_ns};
    seen->recent.voltage_low_V = INFINITY;
    magnetics_point_t aligned;
    magnetics_evaluate(&plant->magnetics, 0.0, world->machine->trip_current_A, &aligned);
    seen->largest_flux_Wb = aligned.flux_linkage_Wb;
    seen->encoder_offset_rev = encoder_offset_rev(world);
    seen->start_rev = floor(plant->rotor_angle_rad / TWO_PI + seen->encoder_offset_rev);
    seen->limit.limited = limited(world);
    look_at_events(seen);
}

/* --- The plant --- */

static void remember_recent(observation_t *seen) {
    const plant_t *plant = seen->plant;
    observation_recent_t *recent = &seen->recent;
    if (seen->time_ns > recent->begin_ns + RECENT_NS) {
        *recent = (observation_recent_t){.begin_ns = seen->time_ns, .voltage_low_V = INFINITY};
    }
    recent->speed_rad_s = fmax(recent->speed_rad_s, fabs(plant->speed_rad_s));
    recent->voltage_high_V = fmax(recent->voltage_high_V, plant->bus_voltage_V);
    recent->voltage_low_V = fmin(recent->voltage_low_V, plant->bus_voltage_V);
    recent->current_A = fmax(recent->current_A, facts_largest_current_A(seen));
}

static void look_at_phases(observation_t *seen) {
    const plant_t *plant = seen->plant;
    const double trip_A = plant->machine->trip_current_A;
    seen->gates = 0;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        seen->gates |= plant->switches[phase];
        const double current_A = plant_current_A(plant, phase);
        seen->surged = seen->surged || (trip_A > 0.0 && current_A > 2.0 * trip_A);
        uint64_t *since_ns = &seen->conducting_ns[phase];
        observation_since(since_ns, current_A > CONDUCTING * seen->world->machine->trip_current_A, seen->time_ns);
        if (*since_ns && seen->time_ns > *since_ns + CONDUCTED_NS) {
            seen->conducted_ns[phase] = seen->time_ns;
        }
    }
    observation_since(&seen->dark_ns, seen->gates == 0, seen->time_ns);
}

/* When the plant last had a reason to keep a drive in a fault. */
static void look_at_reasons(observation_t *seen) {
    const world_machine_t *machine = seen->world->machine;
    const double link_V = seen->plant->bus_voltage_V;
    const bool voltage =
        !facts_disturbed(seen, DISTURBS_DC_LINK_SENSOR) &&
        (link_V > BEYOND_LIMIT * machine->over_voltage_V || link_V * BEYOND_LIMIT < machine->under_voltage_V);
    const bool speed = !facts_disturbed(seen, DISTURBS_ENCODER | DISTURBS_BACKGROUND) &&
                       seen->time_ns > seen->reset_ns + OBSERVER_NS &&
                       facts_speed_rpm(seen) > BEYOND_LIMIT * machine->over_speed_rpm;
    if (voltage || speed || facts_sto_demanded(seen, (seen->time_ns - 1) / 1000)) {
        const bool begins = seen->reason_ns == 0 || seen->time_ns > seen->reason_ns + 2 * OBSERVATION_LOOK_NS;
        seen->reason_begin_ns = begins ? seen->time_ns : seen->reason_begin_ns;
        seen->reason_ns = seen->time_ns;
    }
}

/* Fraction of the commanded speed that a drive of one quadrant may have at most. */
static double most_of_one_quadrant(const observation_t *seen) {
    return fmax(1.2, 1.05 + facts_added_rad_s(seen) * RPM_PER_RAD_S / fabs(seen->recovery.speed_rpm));
}

static void look_at_recovery(observation_t *seen) {
    observation_recovery_t *recovery = &seen->recovery;
    if (!recovery->restarted) {
        return;
    }
    const double part = seen->plant->speed_rad_s * RPM_PER_RAD_S / recovery->speed_rpm;
    /* A drive of one quadrant waits for the friction to take an overshoot. */
    const double most = facts_four_quadrants(seen) ? 1.005 : most_of_one_quadrant(seen);
    observation_since(&recovery->in_band_ns, part >= 0.995 && part <= most, seen->time_ns);
    recovery->settled =
        recovery->settled || (recovery->in_band_ns && seen->time_ns >= recovery->in_band_ns + IN_BAND_NS);
}

void observation_on_look(observation_t *seen) {
    seen->time_ns = seen->plant->time_ns;
    remember_recent(seen);
    look_at_phases(seen);
    look_at_reasons(seen);
    look_at_recovery(seen);
}

void observation_on_millisecond(observation_t *seen) {
    look_at_events(seen);
    observation_rotor_t *rotor = &seen->rotor;
    const double stroke_rad = facts_stroke_rad(seen), angle_rad = seen->plant->rotor_angle_rad;
    if (fabs(angle_rad - rotor->stroke_rad) > stroke_rad) {
        rotor->stroke_ns = seen->time_ns;
        rotor->stroke_rad = angle_rad;
    }
    const bool pushed = facts_pushed(seen);
    const double pitch_rad = stroke_rad * seen->plant->machine->phases;
    const uint64_t within_pitch_ns = observation_stays_ns(seen, &rotor->within_pitch, pushed, pitch_rad);
    rotor->swings = within_pitch_ns > STALLED_NS + (pushed ? facts_strokes_ns(seen, 3.0) : 0);
}

/* --- The drive --- */

/* The encoder repeats a count, and nothing else is wrong with it. */
static bool encoder_stands(const observation_t *seen) {
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = &seen->world->event[i];
        if (event->kind == WORLD_FAULT && event->what == FAULT_ENCODER_STUCK &&
            world_active(seen->world, i, seen->time_ns / 1000)) {
            return !facts_disturbed_besides(seen, DISTURBS_ENCODER, FAULT_ENCODER_STUCK);
        }
    }
    return false;
}

static void enter_fault(observation_t *seen) {
    seen->client.confirmed = seen->client.clear_seen = false;
    seen->latched_ns = seen->time_ns;
    seen->latched_angle = seen->drive.angle;
    seen->counted = !encoder_stands(seen);
    if (seen->causes < OBSERVATION_CAUSES_MAX) {
        seen->cause[seen->causes++] = seen->drive.fault;
    }
    if (seen->causes == 1) {
        seen->cause_us = seen->time_ns / 1000;
    }
}

static void enter_run(observation_t *seen) {
    const plant_t *plant = seen->plant;
    observation_recovery_t *recovery = &seen->recovery;
    seen->rotor.run_angle_rad = plant->rotor_angle_rad;
    seen->rotor.turned = false;
    seen->client.begin_speed_rad_s = plant->speed_rad_s;
    if (recovery->restarted || seen->world->recovery_us == 0 ||
        seen->time_ns < seen->world->recovery_us * 1000 + 25 * MS_NS) {
        return;
    }
    const double change_rad_s = fabs(recovery->speed_rpm / RPM_PER_RAD_S - plant->speed_rad_s);
    recovery->restarted = true;
    recovery->restart_angle_rad = plant->rotor_angle_rad;
    recovery->settle_by_ns = seen->time_ns + (uint64_t)((SETTLING_S + facts_needed_s(seen, change_rad_s)) * 1e9);
}

void observation_on_interrupt(observation_t *seen, observation_drive_t drive) {
    observation_rotor_t *rotor = &seen->rotor;
    seen->time_ns = seen->plant->time_ns;
    rotor->turned = rotor->turned || fabs(seen->plant->rotor_angle_rad - rotor->run_angle_rad) > facts_stroke_rad(seen);
    seen->before = seen->drive.state;
    seen->drive = drive;
    seen->interrupt_ns = seen->time_ns;
    const uint32_t moved = drive.angle - seen->latched_angle;
    const uint32_t distance = moved < HALF_TURN ? moved : 0u - moved;
    seen->counted = seen->counted || distance >> (31 - seen->world->encoder_bits) != 0;
    if (drive.state == seen->before) {
        return;
    }
    seen->before_ns = seen->time_ns - seen->state_ns;
    seen->state_ns = seen->time_ns;
    if (drive.state == STATE_FAULT) {
        enter_fault(seen);
    } else if (drive.state == STATE_RUN) {
        enter_run(seen);
    } else if (drive.state == STATE_READY && seen->before == STATE_RUN) {
        seen->client.confirmed = false;
    }
}

/* By the bench, not by the watchdog. */
static bool reset_by_bench(const observation_t *seen) {
    const uint64_t now_us = seen->time_ns / 1000;
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = world_begun(seen->world, i, now_us);
        if (event != NULL && event->kind == WORLD_SET && event->what == BENCH_VARIABLE_DRIVE_RESET &&
            now_us < event->begin_us + 1000) {
            return true;
        }
    }
    return false;
}

void observation_on_reset(observation_t *seen, uint64_t time_ns, observation_drive_t drive) {
    observation_limit_t *limit = &seen->limit;
    seen->time_ns = time_ns;
    const bool saved = limit->saved_ns != 0 && time_ns > limit->saved_ns + SAVING_NS;
    limit->applied = saved ? limit->applied : 0;
    seen->client.unacknowledged = !reset_by_bench(seen);
    seen->client.clear_ns = 0; /* a request that goes on begins again, when the drive listens again */
    seen->client.confirmed = false;
    seen->drive = drive;
    seen->state_ns = seen->reset_ns = time_ns;
}

/* --- Frames --- */

static void see_switching(observation_client_t *client, uint64_t time_ns, sender_request_t request) {
    const bool runs = request == SENDER_RUN || request == SENDER_STOP; /* a stop is a run to rest */
    if (runs) {
        client->run_ns = time_ns;
        client->commanded = client->commanded || request == SENDER_RUN;
    }
    client->off_seen = request == SENDER_RUN ? false : client->off_seen;
    if (!runs && !client->off_seen) {
        client->off_seen = true;
        client->off_ns = time_ns;
    }
    client->withdrawn_ns = request != SENDER_RUN ? time_ns : client->withdrawn_ns;
}

static void see_clearing(observation_t *seen, sender_request_t request) {
    observation_client_t *client = &seen->client;
    client->clear_seen = client->clear_seen || request == SENDER_CLEAR;
    client->unacknowledged = client->unacknowledged && request != SENDER_CLEAR;
    if (request == SENDER_CLEAR && (client->meant.request != SENDER_CLEAR || seen->drive.state == STATE_RUN)) {
        client->clear_ns = seen->time_ns; /* in a run it is refused, and so begins after it */
    }
}

static void see_change(observation_t *seen, const sender_meaning_t *meaning, bool after_silence) {
    observation_client_t *client = &seen->client;
    const sender_meaning_t *last = &client->meant;
    const bool stop_begins = meaning->request == SENDER_STOP && last->request != SENDER_STOP;
    client->stop_speed_rad_s = stop_begins ? seen->plant->speed_rad_s : client->stop_speed_rad_s;
    client->stop_ns = stop_begins || after_silence ? seen->time_ns : client->stop_ns;
    if (meaning->torque != last->torque || meaning->reference != last->reference || meaning->request != last->request ||
        after_silence) {
        client->constant_ns = seen->time_ns;
        client->begin_speed_rad_s = seen->plant->speed_rad_s;
    }
}

void observation_on_command(observation_t *seen, uint64_t time_ns, const sender_meaning_t *meaning) {
    observation_client_t *client = &seen->client;
    seen->time_ns = time_ns;
    if (!meaning->genuine) {
        return;
    }
    client->succeeded = client->succeeded || meaning->other;
    client->confirmed = client->confirmed || meaning->confirms;
    client->confirmed_ns = meaning->confirms ? time_ns : client->confirmed_ns;
    if (!meaning->command) {
        return;
    }
    const bool after_silence = time_ns > client->run_ns + SILENCE_NS;
    see_switching(client, time_ns, meaning->request);
    see_clearing(seen, meaning->request);
    see_change(seen, meaning, after_silence);
    client->meant = *meaning;
}

static void see_set(observation_t *seen, const uint8_t data[8]) {
    observation_limit_t *limit = &seen->limit;
    struct drive_parameter_response_t response;
    drive_parameter_response_unpack(&response, data, 8);
    if (response.operation != DRIVE_PARAMETER_RESPONSE_OPERATION_SET_CONTROL_CHOICE ||
        response.status != DRIVE_PARAMETER_RESPONSE_STATUS_DONE_CHOICE) {
        return;
    }
    const unsigned step = (uint8_t)response.value; /* the counter of the request is above it */
    if (step == DRIVE_PARAMETER_SET_CONTROL_STEP_SAVE_CHOICE) {
        limit->saved_ns = seen->time_ns;
    } else if (step == DRIVE_PARAMETER_SET_CONTROL_STEP_APPLY_CHOICE) {
        limit->applied++;
        limit->applied_ns = seen->time_ns;
    }
}

void observation_on_frame(observation_t *seen, uint64_t time_ns, unsigned identifier, const uint8_t data[8]) {
    observation_limit_t *limit = &seen->limit;
    seen->time_ns = time_ns;
    if (seen->world->client == WORLD_CLIENT_CANOPEN) {
        return;
    }
    if (identifier == DRIVE_PARAMETER_RESPONSE_FRAME_ID) {
        see_set(seen, data);
    }
    if (identifier == DRIVE_THERMAL_FRAME_ID && facts_frames_are_current(seen)) {
        const bool renew = time_ns >= limit->window_ns + LIMIT_WINDOW_NS;
        limit->window_ns = renew ? time_ns : limit->window_ns;
        limit->last_ns = time_ns;
        observation_widen(&limit->limit_Nm, facts_limit_Nm(seen, data), renew);
    }
}

/* --- Faults, recovery, end --- */

void observation_on_fault(observation_t *seen, unsigned kind, bool begins) {
    seen->time_ns = seen->fault_ns = seen->plant->time_ns;
    if (kind >= FAULT_COUNT) {
        return;
    }
    seen->active[kind] = begins;
    if (!begins) {
        seen->ended_ns[kind] = seen->time_ns;
    } else {
        seen->injected[kind] = true;
        seen->ever_disturbed |= fault_effect(kind).disturbs;
        seen->disturbed |= fault_effect(kind).disturbs;
        seen->present[kind] = true;
    }
}

double observation_recovery_speed_rpm(observation_t *seen) {
    observation_recovery_t *recovery = &seen->recovery;
    const world_machine_t *machine = seen->world->machine;
    const double now_rpm = seen->plant->speed_rad_s * RPM_PER_RAD_S;
    /* A drive of one quadrant cannot slow down. */
    recovery->speed_rpm = fmax(fabs(now_rpm) * 1.1, 0.2 * machine->speed_base_rpm);
    if (facts_four_quadrants(seen) && now_rpm < 0.0) {
        recovery->speed_rpm = -recovery->speed_rpm;
    }
    recovery->judged = fabs(recovery->speed_rpm) <= 0.9 * machine->speed_base_rpm &&
                       fabs(recovery->speed_rpm) <= 0.95 * machine->speed_command_max_rpm &&
                       (now_rpm >= 0.0 || facts_four_quadrants(seen));
    return fmin(fabs(recovery->speed_rpm), machine->speed_command_max_rpm) * (recovery->speed_rpm < 0.0 ? -1.0 : 1.0);
}

void observation_at_end(observation_t *seen, observation_heat_t heat) {
    seen->time_ns = seen->plant->time_ns;
    seen->true_heat = heat;
    /* A drive takes an encoder for frozen until it counts, which at rest only a hand on the shaft or a reset ends. */
    seen->recovery.held = facts_ever_disturbed(seen, DISTURBS_ENCODER | DISTURBS_SHAFT) && !seen->recovery.restarted &&
                          fabs(seen->plant->speed_rad_s) < AT_REST_RAD_S;
}
