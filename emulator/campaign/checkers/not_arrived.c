/* A move that nothing disturbs ends at its target: after four times the way at half of the speed and a quarter of the
 * acceleration, and 0.5 s, the rotor is within three counts of the encoder and the window of the position, of the
 * target or of the end stop before it. */
#include "campaign/checkers/checker.h"

#include <math.h>

#define HALT 0x100u /* of the controlword */
#define COUNTS 3.0
#define WINDOW_REV (0.05 / 360.0)
#define AFTER_S 0.5
#define LOADED_S 0.3

typedef struct {
    uint64_t since_ns;
    double target_rev, begin_rev;
} state_t;

static bool moves_by_dbc(const observation_t *seen) {
    return seen->client.meant.position && seen->client.meant.request == SENDER_RUN && facts_heard(seen) &&
           facts_had_event(seen, WORLD_TARGET) && !facts_had_event(seen, WORLD_SILENT);
}

/* By profile position alone. */
static bool moves_by_canopen(const observation_t *seen) {
    const master_wish_t *wish = &seen->master->wish;
    return wish->enabled && wish->stop == MASTER_GOES_ON && seen->world->master.mode == MODE_PP && wish->aimed &&
           (wish->word & HALT) == 0 && !facts_has_event(seen, WORLD_MODE) && !facts_has_event(seen, WORLD_CONTROL) &&
           !facts_has_event(seen, WORLD_LOST) && !facts_has_event(seen, WORLD_NMT);
}

/* Target of the move under way; false: none that is judged. */
static bool wanted(const observation_t *seen, double *target_rev) {
    const world_master_t *setting = &seen->world->master;
    const double aim_rev = seen->master->wish.target_rev;
    if (seen->drive.state != STATE_RUN || !facts_untouched(seen) || !facts_four_quadrants(seen)) {
        return false;
    }
    if (seen->world->client == WORLD_CLIENT_POSITION) {
        *target_rev = seen->client.meant.reference;
        return moves_by_dbc(seen);
    }
    *target_rev = setting->limited ? fmin(fmax(aim_rev, setting->lowest_rev), setting->highest_rev) : aim_rev;
    return moves_by_canopen(seen);
}

/* Time for a way with a part of the speed and of the acceleration. */
static double needed_s(const observation_t *seen, double way_rev) {
    const bool canopen = seen->world->client == WORLD_CLIENT_CANOPEN;
    const double inertia = facts_inertia_kg_m2(seen);
    const double most = 0.25 * seen->world->machine->torque_max_Nm / inertia / TWO_PI;
    const double rate = canopen ? fmin(most, 0.5 * seen->world->master.acceleration_rpm_s / 60.0) : most;
    const double base_rev_s = facts_base_rad_s(seen) / TWO_PI;
    const double speed =
        canopen ? fmin(0.5 * base_rev_s, 0.5 * seen->world->master.speed_rpm / 60.0) : 0.5 * base_rev_s;
    return AFTER_S + fabs(way_rev) / speed + 2.0 * speed / rate;
}

static void on_millisecond(const observation_t *seen, void *memory, checker_report_t *report) {
    state_t *state = memory;
    double target_rev = 0.0;
    const double position_rev = facts_position_rev(seen);
    if (!wanted(seen, &target_rev)) {
        state->since_ns = 0;
        return;
    }
    if (state->since_ns == 0 || state->target_rev != target_rev) {
        const double begin_rev = state->since_ns == 0 ? position_rev : state->begin_rev;
        *state = (state_t){seen->time_ns, target_rev,
                           fabs(begin_rev - target_rev) > fabs(position_rev - target_rev) ? begin_rev : position_rev};
    }
    const double since_s = 1e-9 * (double)(seen->time_ns - state->since_ns);
    const double loaded_s = 1e-9 * (double)(seen->time_ns - facts_load_ns(seen));
    const double error_rev = position_rev - target_rev;
    if (since_s > 2.0 * needed_s(seen, state->begin_rev - target_rev) && loaded_s > LOADED_S &&
        fabs(error_rev) > COUNTS * facts_count_rev(seen) + WINDOW_REV) {
        checker_violated(report, 0, error_rev);
    }
}

const checker_t not_arrived_checker = {
    .name = "not_arrived", .state_size = sizeof(state_t), .on_millisecond = on_millisecond};
