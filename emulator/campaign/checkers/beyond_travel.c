/* In the modes of position a rotor that has come to rest between the end stops that the master has set does not leave
 * them by more than a hundredth of a revolution and two counts, nor by more than a load moves it. */
#include "campaign/checkers/checker.h"

#include <math.h>

#define BEYOND_REV 0.01
#define COUNTS 2.0
#define AT_REST_RAD_S 1.0
#define LOADED_NS (100 * MS_NS)

typedef struct {
    bool within; /* the rotor has rested between the stops, in a mode of position, */
} state_t;

static bool asked(const observation_t *seen) {
    const master_wish_t *wish = &seen->master->wish;
    return seen->drive.state == STATE_RUN && wish->enabled && wish->stop == MASTER_GOES_ON &&
           (wish->mode == MODE_PP || wish->mode == MODE_CSP);
}

static bool judged(const observation_t *seen) {
    return seen->world->master.limited && asked(seen) && facts_untouched(seen) && !facts_chooses_mode(seen, MODE_HM) &&
           !facts_has_event(seen, WORLD_LOST) && !facts_has_event(seen, WORLD_NMT);
}

static void on_millisecond(const observation_t *seen, void *memory, checker_report_t *report) {
    state_t *state = memory;
    const world_master_t *setting = &seen->world->master;
    const double position_rev = facts_position_rev(seen);
    if (!judged(seen)) {
        state->within = false;
        return;
    }
    const double beyond_rev = fmax(setting->lowest_rev - position_rev, position_rev - setting->highest_rev);
    state->within = state->within || (beyond_rev < 0.0 && fabs(seen->plant->speed_rad_s) < AT_REST_RAD_S);
    const uint64_t load_ns = facts_load_ns(seen);
    const bool loaded = load_ns != 0 && seen->time_ns < load_ns + LOADED_NS;
    if (state->within && !loaded && beyond_rev > BEYOND_REV + COUNTS * facts_count_rev(seen)) {
        checker_violated(report, 0, beyond_rev);
    }
}

const checker_t beyond_travel_checker = {
    .name = "beyond_travel", .state_size = sizeof(state_t), .on_millisecond = on_millisecond};
