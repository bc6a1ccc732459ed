/* After a quick stop, a disabled operation, an end of state operational and a lost master the rotor becomes no faster,
 * and all gates are off when the ramp and a second have passed, or at once where the option code says so. */
#include "campaign/checkers/checker.h"

#include <math.h>

enum { FASTER = 1, NOT_OPEN, NOT_AT_REST };

#define LATE_NS (8 * MS_NS)    /* cycles of telemetry and interrupts */
#define REST_NS (1000 * MS_NS) /* from the end of the ramp on the drive waits so long for its rotor */
#define FASTER_BASE 0.05       /* of the base speed */
#define SLOW 0.1               /* of it: at rest */

typedef struct {
    uint64_t since_ns; /* 0: no reason to stop */
    double speed_rad_s;
    bool known; /* the speed when the stop began */
} state_t;

/* Silence of the master that the drive has to notice. */
static uint64_t lost_ns(const observation_t *seen) {
    const world_master_t *setting = &seen->world->master;
    uint64_t watch_ms = setting->watch_ms;
    if (setting->watch == WORLD_WATCH_GUARDING) {
        watch_ms = watch_ms / 4 * 4;
    }
    const uint64_t end_ns = seen->master->wish.sign_ns + watch_ms * MS_NS;
    bool lost = false;
    for (unsigned i = 0; i < seen->world->events; i++) {
        lost =
            lost || (seen->world->event[i].kind == WORLD_LOST && world_active(seen->world, i, seen->time_ns / 1000) &&
                     world_active(seen->world, i, seen->master->wish.sign_ns / 1000 + 12000));
    }
    return lost && seen->time_ns > end_ns + LATE_NS ? end_ns : 0;
}

/* The master asks for the stop, or is lost. */
typedef struct {
    master_stop_t how; /* MASTER_GOES_ON: not */
    uint64_t since_ns;
    bool lost;
} reason_t;

static reason_t reason_of(const observation_t *seen) {
    const master_wish_t *wish = &seen->master->wish;
    const uint64_t lost = lost_ns(seen);
    if (!wish->enabled || !facts_untouched(seen) || seen->drive.state == STATE_FAULT || !facts_four_quadrants(seen)) {
        return (reason_t){.how = MASTER_GOES_ON};
    }
    if (lost != 0) {
        return (reason_t){seen->world->master.abort_option == 2 ? MASTER_OPENS : MASTER_STOPS, lost, true};
    }
    return (reason_t){wish->stop, wish->stop_ns, false};
}

static void judge(const observation_t *seen, const state_t *state, checker_report_t *report, master_stop_t how) {
    const double base_rad_s = facts_base_rad_s(seen), speed_rad_s = fabs(seen->plant->speed_rad_s);
    const double ramp_s = state->speed_rad_s * RPM_PER_RAD_S / seen->world->master.acceleration_rpm_s;
    const uint64_t until_ns = state->since_ns + LATE_NS + (uint64_t)(1.2e9 * ramp_s) + REST_NS + LATE_NS;
    const bool loaded = facts_load_ns(seen) != 0;
    if (how == MASTER_OPENS) {
        if (seen->gates && seen->time_ns > state->since_ns + 2 * LATE_NS) {
            checker_violated(report, NOT_OPEN, (double)(seen->time_ns - state->since_ns) * 1e-6);
        }
        return;
    }
    if (!loaded && speed_rad_s > state->speed_rad_s + FASTER_BASE * base_rad_s) {
        checker_violated(report, FASTER, speed_rad_s - state->speed_rad_s);
    }
    if (how == MASTER_STOPS && seen->gates && seen->time_ns > until_ns) {
        checker_violated(report, NOT_OPEN, (double)(seen->time_ns - state->since_ns) * 1e-6);
    }
    if (how == MASTER_HOLDS && seen->time_ns > until_ns && speed_rad_s > SLOW * base_rad_s && !loaded) {
        checker_violated(report, NOT_AT_REST, speed_rad_s);
    }
}

static void on_look(const observation_t *seen, void *memory, checker_report_t *report) {
    state_t *state = memory;
    const reason_t reason = reason_of(seen);
    if (reason.how == MASTER_GOES_ON) {
        state->since_ns = 0;
        return;
    }
    if (state->since_ns == 0 || (reason.lost && state->since_ns < reason.since_ns)) {
        *state = (state_t){.since_ns = reason.since_ns};
    }
    if (!state->known && seen->time_ns > state->since_ns + LATE_NS) {
        state->known = true;
        state->speed_rad_s = fmax(fabs(seen->plant->speed_rad_s), seen->recent.speed_rad_s);
    }
    if (state->known) {
        judge(seen, state, report, reason.how);
    }
}

const checker_t quick_stop_checker = {.name = "quick_stop", .state_size = sizeof(state_t), .on_look = on_look};
