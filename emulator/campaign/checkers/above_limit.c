/* The mean torque keeps to the limit that the client has set and to the one that telemetry announces before or after;
 * and telemetry announces none above the one that the client has set. [SR-09] */
#include "campaign/checkers/checker.h"

#include <math.h>

#include "campaign/checkers/mean_torque.h"

enum { ANNOUNCED = 3 }; /* besides the numbers of controllers */

#define PART 1.1 /* flux linkages of a machine scatter by 5 %, its torque by twice that */
#define RATED 0.05
#define RATED_HYSTERESIS 0.1
#define MIN_NS (20 * MS_NS)
#define SPEED_MAX 0.9 /* of the base speed, up to which the pulses are held to the limit, */
#define SPEED_MAX_HYSTERESIS 0.5
#define AGE_MAX_NS (120 * MS_NS)
#define SETTLED_NS (100 * MS_NS)
#define ROUNDED 1.03 /* of the limit in a frame */

typedef struct {
    mean_torque_t torque;
    double largest_Nm; /* mean since the last limit in telemetry */
} state_t;

static void judge(const observation_t *seen, checker_report_t *report, double mean_Nm, double limit_Nm) {
    const double rated = facts_four_quadrants(seen) ? RATED : RATED_HYSTERESIS;
    if (mean_Nm > PART * limit_Nm + rated * seen->world->machine->torque_rated_Nm) {
        checker_violated(report, seen->world->controller, mean_Nm / limit_Nm);
    }
}

/* Measured by healthy sensors, with a healthy memory. */
static bool torque_is_known(const observation_t *seen) {
    return !facts_disturbed(seen, DISTURBS_PHASE | DISTURBS_CURRENT_SENSOR | DISTURBS_DC_LINK_SENSOR |
                                      DISTURBS_ENCODER | DISTURBS_PROCESSOR | DISTURBS_MEMORY | DISTURBS_CLOCK) &&
           !facts_bus_disturbed(seen);
}

static void on_interrupt(const observation_t *seen, void *memory, checker_report_t *report) {
    state_t *state = memory;
    const double speed_max = facts_four_quadrants(seen) ? SPEED_MAX : SPEED_MAX_HYSTERESIS;
    double mean_Nm;
    if (seen->drive.state != STATE_RUN || !torque_is_known(seen) || seen->limit.last_ns <= seen->reset_ns ||
        seen->time_ns > seen->limit.last_ns + AGE_MAX_NS ||
        facts_speed_rpm(seen) > speed_max * seen->world->machine->speed_base_rpm) {
        state->torque.samples = 0;
        return;
    }
    if (!mean_torque_step(&state->torque, seen, MIN_NS, &mean_Nm)) {
        return;
    }
    mean_Nm = fabs(mean_Nm);
    state->largest_Nm = fmax(state->largest_Nm, mean_Nm);
    if (facts_sets_in_effect(seen)) {
        judge(seen, report, mean_Nm, facts_torque_max_Nm(seen));
    }
}

static void on_frame(const observation_t *seen, void *memory, checker_report_t *report, const checker_frame_t *frame) {
    state_t *state = memory;
    if (frame->identifier != DRIVE_THERMAL_FRAME_ID || !facts_frames_are_current(seen)) {
        return;
    }
    const double largest_Nm = state->largest_Nm, limit_Nm = facts_limit_Nm(seen, frame->data);
    state->largest_Nm = 0.0;
    if (facts_disturbed(seen, DISTURBS_MEMORY | DISTURBS_CLOCK)) {
        return; /* by a constant that has changed the limit may be any, also a negative one */
    }
    const observation_range_t *announced_Nm = &seen->limit.limit_Nm;
    judge(seen, report, largest_Nm, fmax(announced_Nm->high[0], announced_Nm->high[1]));
    if (facts_sets_in_effect(seen) && seen->time_ns > seen->limit.applied_ns + SETTLED_NS &&
        limit_Nm > ROUNDED * facts_torque_max_Nm(seen)) {
        checker_violated(report, ANNOUNCED, limit_Nm / facts_torque_max_Nm(seen));
    }
}

const checker_t above_limit_checker = {
    .name = "above_limit", .state_size = sizeof(state_t), .on_interrupt = on_interrupt, .on_frame = on_frame};
