/* Without a target a drive in a mode of position holds the place of its rest: no frame enables and moves at once. */
#include "campaign/checkers/checker.h"

#include <math.h>

#define MOVED_REV 0.03 /* a load, until it is held */
#define COUNTS 3.0
#define AT_REST_RAD_S 1.0

typedef struct {
    bool held;
    double position_rev;
} state_t;

/* A cyclic master whose drive is enabled while it turns leads it back to where it was then. */
static bool holds_by_canopen(const observation_t *seen) {
    const master_wish_t *wish = &seen->master->wish;
    const bool led = wish->mode == MODE_CSP && facts_has_event(seen, WORLD_CONTROL);
    return wish->enabled && wish->stop == MASTER_GOES_ON && !facts_has_event(seen, WORLD_MODE) && !led &&
           (wish->mode == MODE_PP || wish->mode == MODE_CSP || wish->mode == MODE_HM);
}

static bool holds(const observation_t *seen) {
    const bool position = seen->world->client == WORLD_CLIENT_POSITION
                              ? seen->client.meant.position && seen->client.meant.request == SENDER_RUN
                              : holds_by_canopen(seen);
    return position && seen->drive.state == STATE_RUN && facts_four_quadrants(seen) && facts_untouched(seen) &&
           !facts_had_event(seen, WORLD_TARGET) && !facts_had_event(seen, WORLD_SILENT) &&
           !facts_had_event(seen, WORLD_LOST) && !facts_had_event(seen, WORLD_NMT);
}

static void on_millisecond(const observation_t *seen, void *memory, checker_report_t *report) {
    state_t *state = memory;
    const double position_rev = facts_position_rev(seen);
    if (!holds(seen)) {
        state->held = false;
        return;
    }
    if (!state->held) { /* a rotor that turned when the drive was enabled comes to rest first */
        *state = (state_t){.held = fabs(seen->plant->speed_rad_s) < AT_REST_RAD_S, .position_rev = position_rev};
    }
    const double moved_rev = position_rev - state->position_rev;
    if (fabs(moved_rev) > MOVED_REV + COUNTS * facts_count_rev(seen)) {
        checker_violated(report, 0, moved_rev);
    }
}

const checker_t moved_unasked_checker = {
    .name = "moved_unasked", .state_size = sizeof(state_t), .on_millisecond = on_millisecond};
