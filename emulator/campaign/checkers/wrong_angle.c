/* In state run, at a steady speed, the measured angle is off the encoder's by no more than three quarters of a count
 * and the motion in a tick of the timer, on average over 16 counts. */
#include "campaign/checkers/checker.h"

#include <math.h>

#define ERROR_MAX_COUNTS 0.75 /* half of one when sampling is in step with the counts, and noise */
#define TIMER_TICK_S 5e-9     /* error of the time of an edge */
#define COUNTS 16.0
#define MIN_NS (2 * MS_NS)
#define MAX_NS (32 * MS_NS)
#define STEADY 0.1              /* change of the speed, at most */
#define SETTLED_NS (10 * MS_NS) /* after a larger one the drive still has to observe the speed */

/* Motion at a steady speed, over which the error is averaged. */
typedef struct {
    uint64_t settled_ns; /* not before, after the speed has changed */
    unsigned samples;    /* 0: begins with the next one */
    uint64_t begin_ns;
    double begin_counts; /* of the encoder, continued over revolutions */
    double speed_rad_s;  /* at the start */
    double error_counts; /* sum, positive: ahead in the direction of counting */
} state_t;

/* False while the speed has to settle. */
static bool follow(const observation_t *seen, state_t *state, double counts) {
    const double speed_rad_s = seen->plant->speed_rad_s;
    const bool steady = fabs(speed_rad_s - state->speed_rad_s) <= STEADY * fabs(state->speed_rad_s);
    const bool ended = state->samples == 0 || seen->time_ns > state->begin_ns + MAX_NS;
    if (!steady || (ended && seen->time_ns >= state->settled_ns)) {
        *state = (state_t){.settled_ns = steady ? state->settled_ns : seen->time_ns + SETTLED_NS,
                           .begin_ns = seen->time_ns,
                           .begin_counts = counts,
                           .speed_rad_s = speed_rad_s};
    }
    return seen->time_ns >= state->settled_ns;
}

static void on_interrupt(const observation_t *seen, void *memory, checker_report_t *report) {
    state_t *state = memory;
    if (seen->drive.state != STATE_RUN) {
        state->samples = 0;
        return;
    }
    const double counts_per_rev = ldexp(1.0, (int)seen->world->encoder_bits);
    const double true_rev = seen->plant->rotor_angle_rad / TWO_PI + seen->encoder_offset_rev;
    const double counts = true_rev * counts_per_rev;
    if (!follow(seen, state, counts)) {
        return;
    }
    const double error_rev = ldexp((double)seen->drive.angle, -32) - true_rev;
    state->error_counts += (error_rev - floor(error_rev + 0.5)) * counts_per_rev;
    state->samples++;
    if (fabs(counts - state->begin_counts) < COUNTS || seen->time_ns < state->begin_ns + MIN_NS) {
        return;
    }
    const double mean_counts = state->error_counts / state->samples;
    const double tick_counts = fabs(seen->plant->speed_rad_s) / TWO_PI * TIMER_TICK_S * counts_per_rev;
    if (fabs(mean_counts) > ERROR_MAX_COUNTS + tick_counts && !facts_disturbed(seen, DISTURBS_ENCODER) &&
        !facts_drive_disturbed(seen)) {
        checker_violated(report, 0, mean_counts);
    }
    state->samples = 0;
}

const checker_t wrong_angle_checker = {
    .name = "wrong_angle", .state_size = sizeof(state_t), .on_interrupt = on_interrupt};
