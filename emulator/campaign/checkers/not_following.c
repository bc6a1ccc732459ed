/* Undisturbed and with all phases, at a constant speed reference and under a constant load, the mean speed over 50 ms
 * and a revolution is the commanded one: within 0.3 %, 0.1 % of the base speed and a count; of one quadrant not below
 * it by 2 %. */
#include "campaign/checkers/checker.h"

#include <math.h>

#define ERROR_MAX_QUADRANTS 0.003
#define ERROR_MAX_BASE_QUADRANTS 0.001
#define ERROR_MAX 0.02
#define ERROR_MAX_BASE 0.002 /* of the base speed */
#define SETTLED_S 0.15       /* after the time that half of the torque limit needs */
#define MIN_S 0.05
#define SPEED_MAX 0.9 /* of the base speed */
#define LOAD_SETTLED_US 250000

typedef struct {
    uint64_t begin_ns; /* 0: begins with the next sample */
    double begin_angle_rad;
} state_t;

/* No sine, and no step or ramp a short time ago. */
static bool load_is_constant(const observation_t *seen) {
    const uint64_t now_us = seen->time_ns / 1000;
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = world_begun(seen->world, i, now_us);
        if (event == NULL) {
            continue;
        }
        const uint64_t last_us = event->end_us != 0 && event->end_us <= now_us ? event->end_us : event->begin_us;
        if (facts_is_load_sine(event) || (facts_is_load(event) && now_us < last_us + LOAD_SETTLED_US)) {
            return false;
        }
    }
    return true;
}

/* A constant speed that nothing keeps the drive from. */
static bool follows(const observation_t *seen) {
    const observation_client_t *client = &seen->client;
    const double reference_rpm = fabs(client->meant.reference), base_rpm = seen->world->machine->speed_base_rpm;
    const double change_rad_s = reference_rpm / RPM_PER_RAD_S + fabs(client->begin_speed_rad_s);
    const uint64_t since_ns = client->constant_ns > seen->state_ns ? client->constant_ns : seen->state_ns;
    return facts_runs_by_speed(seen) && facts_undisturbed(seen) && !facts_derated(seen) && facts_heard(seen) &&
           seen->time_ns > since_ns + (uint64_t)((SETTLED_S + facts_needed_s(seen, change_rad_s)) * 1e9) &&
           reference_rpm <= SPEED_MAX * base_rpm && !facts_may_be_degraded(seen) &&
           !facts_overhauled(seen, seen->plant->speed_rad_s) && load_is_constant(seen);
}

static void judge(const observation_t *seen, checker_report_t *report, double mean_rad_s, double time_s) {
    const bool quadrants = facts_four_quadrants(seen);
    const double reference_rad_s = seen->client.meant.reference / RPM_PER_RAD_S;
    const double part = quadrants ? ERROR_MAX_QUADRANTS : ERROR_MAX;
    const double part_base = quadrants ? ERROR_MAX_BASE_QUADRANTS : ERROR_MAX_BASE;
    const double count_rad_s = ldexp(TWO_PI, -(int)seen->world->encoder_bits) / time_s;
    const double most_rad_s = part * fabs(reference_rad_s) + part_base * facts_base_rad_s(seen) + count_rad_s;
    const double error_rad_s = mean_rad_s - reference_rad_s;
    if (quadrants ? fabs(error_rad_s) > most_rad_s : error_rad_s < -most_rad_s) {
        checker_violated(report, seen->world->controller, mean_rad_s / reference_rad_s);
    }
}

static void on_interrupt(const observation_t *seen, void *memory, checker_report_t *report) {
    state_t *state = memory;
    if (!follows(seen)) {
        state->begin_ns = 0;
        return;
    }
    if (state->begin_ns == 0) {
        *state = (state_t){seen->time_ns, seen->plant->rotor_angle_rad};
    }
    const double time_s = (double)(seen->time_ns - state->begin_ns) * 1e-9;
    if (time_s < MIN_S || time_s * fabs(seen->client.meant.reference / RPM_PER_RAD_S) < TWO_PI) {
        return;
    }
    judge(seen, report, (seen->plant->rotor_angle_rad - state->begin_angle_rad) / time_s, time_s);
    state->begin_ns = 0;
}

const checker_t not_following_checker = {
    .name = "not_following", .state_size = sizeof(state_t), .on_interrupt = on_interrupt};
