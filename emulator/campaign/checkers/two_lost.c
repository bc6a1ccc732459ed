/* With two phases lost a drive does not run on for 300 ms at less than half of the commanded speed. [SR-31] */
#include "campaign/checkers/checker.h"

#include <math.h>

#define LOST_US 100000 /* for certain */
#define TIME_NS (300 * MS_NS)
#define SPEED_MIN 0.2 /* of the base speed, commanded */

typedef struct {
    uint64_t since_ns;
} state_t;

static unsigned lost_phases(const observation_t *seen) {
    const uint64_t now_us = seen->time_ns / 1000;
    unsigned phases = 0, count = 0;
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = &seen->world->event[i];
        const bool lost = event->kind == WORLD_FAULT && (fault_effect(event->what).disturbs & DISTURBS_PHASE_LOST) != 0;
        if (lost && world_active(seen->world, i, now_us) && now_us > event->begin_us + LOST_US &&
            !(phases >> event->phase & 1u)) {
            phases |= 1u << event->phase;
            count++;
        }
    }
    return count;
}

static void on_millisecond(const observation_t *seen, void *memory, checker_report_t *report) {
    state_t *state = memory;
    const double reference_rad_s = fabs(seen->client.meant.reference) / RPM_PER_RAD_S;
    const bool drives = facts_heard(seen) && !facts_bus_disturbed(seen) && facts_runs_by_speed(seen) &&
                        reference_rad_s * RPM_PER_RAD_S > SPEED_MIN * seen->world->machine->speed_base_rpm &&
                        fabs(seen->plant->speed_rad_s) < 0.5 * reference_rad_s;
    observation_since(&state->since_ns, drives && lost_phases(seen) > 1, seen->time_ns);
    if (state->since_ns && seen->time_ns > state->since_ns + TIME_NS &&
        seen->time_ns > seen->client.constant_ns + TIME_NS && !facts_checks_late(seen)) {
        checker_violated(report, 0, seen->plant->speed_rad_s);
    }
}

const checker_t two_lost_checker = {
    .name = "two_lost", .state_size = sizeof(state_t), .on_millisecond = on_millisecond};
