#include "monitors/encoder_monitor.h"

#include "fixed/compiler.h"
#include "fixed/fixed.h"
#include "fixed/formats.h"

/* Window for the speed: 1/2048 s, and until the next check. */
#define WINDOW_SHIFT 11

/* Travel in a window at the limit of the speed up to which a larger one is seen: 7/16 of a turn. A sixteenth more, and
 * a count, are below the half turn beyond which travel appears smaller than it is: never as a false over-speed.
 * The highest limit, 38400 r/min, has windows of up to 0.68 ms. */
#define TRAVEL_SEEN (HALF_REV / 8u * 7u)

/* Windows within which the encoder turns round faster than the rotor, from and to a speed of 1/64 of the limit and of
 * half the largest change of the rotor's in this time. */
#define REVERSAL_WINDOWS 3u
#define REVERSAL_SHIFT 6

/* Time for which a turn round is remembered: 1/4 s. */
#define REVERSED_SHIFT 2

/* Notes when the encoder has turned round. clear: faster than its counts and the rotor's swings. The first direction
 * since a reset of the drive, whose rotor may turn backwards, is no turn round. [SR-23] */
static void note_reversal(encoder_monitor_t *monitor, int32_t turned, bool clear, uint32_t rate_hz) {
    const bool backwards = turned < 0;
    monitor->turned =
        monitor->turned && monitor->window_period - monitor->turned_at <= REVERSAL_WINDOWS * (rate_hz >> WINDOW_SHIFT);
    if (!clear) {
        return;
    }
    if (monitor->turned && backwards != monitor->backwards) {
        monitor->turned_round = true;
        monitor->reversed_at = monitor->window_period;
    }
    monitor->turned = true;
    monitor->backwards = backwards;
    monitor->turned_at = monitor->window_period;
}

/* [SR-07] */
static void check_speed(const encoder_monitor_parameters_t *parameters, encoder_monitor_t *monitor,
                        const flux_residual_t *residual) {
    const flux_sample_t *sample = &residual->sample;
    const uint32_t periods = sample->periods - monitor->window_period;
    if (residual->lost) { /* the window was longer than its periods */
        monitor->window_period = sample->periods;
        monitor->window_angle = sample->encoder_angle;
        monitor->turned = false;
        return;
    }
    if (periods < parameters->rate_hz >> WINDOW_SHIFT) {
        return;
    }
    const int32_t turned = (int32_t)(sample->encoder_angle - monitor->window_angle);
    const uint32_t travel = (uint32_t)fixed_abs(turned);
    const uint64_t limit = (uint64_t)parameters->travel * periods;
    const uint64_t count = 2 * (uint64_t)parameters->middle;
    const bool above = fixed_abs(sample->speed_q22) > parameters->over_speed_q22;
    monitor->over_speed =
        limit < TRAVEL_SEEN && (travel > limit + limit / 16 + count || (above && travel + count > limit - limit / 32));
    monitor->window_period = sample->periods;
    monitor->window_angle = sample->encoder_angle;
    const uint64_t change = (uint64_t)parameters->travel_change * periods * periods * REVERSAL_WINDOWS / 2u;
    const uint64_t least = limit >> REVERSAL_SHIFT;
    note_reversal(monitor, turned, travel > (least > change ? least : change) + count, parameters->rate_hz);
}

/* [SR-07] [SR-23] */
COLD void encoder_monitor_step(const encoder_monitor_parameters_t *parameters, encoder_monitor_t *monitor,
                               const flux_residual_t *residual) {
    const flux_sample_t *sample = &residual->sample;
    if (!monitor->started) {
        monitor->started = true;
        monitor->window_period = sample->periods;
        monitor->window_angle = sample->encoder_angle;
    }
    check_speed(parameters, monitor, residual);
    monitor->turned_round =
        monitor->turned_round && sample->periods - monitor->reversed_at <= parameters->rate_hz >> REVERSED_SHIFT;
}
