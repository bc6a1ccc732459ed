#include "control/periodic_load.h"

#include "fixed/fixed.h"

#define VALUES PERIODIC_LOAD_VALUES
#define VALUES_LOG2 6
#define VALUE_SHIFT (32 - VALUES_LOG2)

/* Values between that which is learned and that which ends: more than lag and lead together. */
#define AHEAD (VALUES / 4)

/* From the sample to the middle of the time in which its torque acts: three periods to the torque, 1.5 to the observer,
 * and four in which it stays. */
#define LEAD_PERIODS 4

#define LAG_TENTHS 22
#define LAG_MAX (UINT32_C(8) << VALUE_SHIFT)

/* After a step that was left out, at the end of a stroke (interrupts/deferred.c), a value is ended late. */
#define BEHIND_MAX 2u

/* 1/256 of the largest torque in the mean. */
#define THRESHOLD_SHIFT 8

periodic_load_parameters_t periodic_load_configure(uint32_t control_rate_hz, uint32_t bandwidth_rad_s,
                                                   int32_t torque_max_q24, unsigned rotor_poles) {
    const uint32_t lag_periods = bandwidth_rad_s > 0 ? control_rate_hz * LAG_TENTHS / 10u / bandwidth_rad_s : 0;
    return (periodic_load_parameters_t){
        .lag_periods = (int32_t)lag_periods,
        .angle_step_max = (int32_t)(LAG_MAX / (lag_periods + 1)),
        .threshold_q8 = (uint32_t)(torque_max_q24 >> (16 + THRESHOLD_SHIFT)) * VALUES,
        .torque_limit_q8 = torque_max_q24 >> 16,
        .pitch = (VALUES + rotor_poles / 2) / rotor_poles,
    };
}

static void begin_turn(periodic_load_t *load) {
    load->moved = false;
    load->count = 0;
    load->total_q8 = 0;
    load->load_q8 = load->change_q8 = load->residual_q8 = load->slow_q8 = 0;
}

void periodic_load_reset(periodic_load_t *load) {
    load->mode = PERIODIC_LOAD_CLEAR;
    load->engaged = false;
    load->torque_q24 = 0;
    load->updates = 0;
    load->window = 0;
    begin_turn(load);
}

static periodic_load_mode_t next_mode(const periodic_load_parameters_t *parameters, const periodic_load_t *load) {
    if (load->load_q8 < parameters->threshold_q8 || load->load_q8 < load->residual_q8 / 4 ||
        load->slow_q8 < load->load_q8 / 4) {
        return PERIODIC_LOAD_CLEAR;
    }
    if (load->mode == PERIODIC_LOAD_CLEAR) {
        return PERIODIC_LOAD_KEEP; /* the estimate before may be from another run */
    }
    if (load->moved && load->residual_q8 >= parameters->threshold_q8 && load->change_q8 < load->residual_q8 / 2) {
        return PERIODIC_LOAD_LEARN;
    }
    return load->load_q8 < load->residual_q8 ? PERIODIC_LOAD_FORGET : PERIODIC_LOAD_KEEP;
}

/* In the step after the last value's: neither takes the time of both. */
static void end_turn(const periodic_load_parameters_t *parameters, periodic_load_t *load) {
    load->mode = (uint8_t)next_mode(parameters, load);
    load->engaged = load->mode == PERIODIC_LOAD_LEARN || (load->engaged && load->mode != PERIODIC_LOAD_CLEAR);
    load->mean_q8 = load->total_q8 >> VALUES_LOG2;
    load->swing_q8 = (int32_t)(load->load_q8 >> VALUES_LOG2);
    begin_turn(load);
}

/* Q z. */
static int32_t smooth_q8(const periodic_load_t *load, uint32_t index, int32_t smoothing_q8) {
    const int32_t estimate_q8 = load->estimate_q8[index];
    const int32_t curvature_q8 =
        load->estimate_q8[(index - 1) % VALUES] - 2 * estimate_q8 + load->estimate_q8[(index + 1) % VALUES];
    return estimate_q8 + (curvature_q8 * smoothing_q8 >> 8);
}

static int32_t updated_q8(const periodic_load_t *load, uint32_t index, int32_t smoothing_q8) {
    const int32_t profile_q8 = load->profile_q8[index];
    switch (load->mode) {
    case PERIODIC_LOAD_CLEAR:
        return 0;
    case PERIODIC_LOAD_LEARN:
        return profile_q8 + ((smooth_q8(load, index, smoothing_q8) - load->mean_q8 - profile_q8) >> 2);
    case PERIODIC_LOAD_FORGET:
        return profile_q8 >> 1;
    case PERIODIC_LOAD_KEEP:
    default:
        return profile_q8;
    }
}

/* Moves the mean over a pole pitch to a value, before it is stored. Returns that mean. */
static int32_t mean_over_pitch_q8(const periodic_load_parameters_t *parameters, periodic_load_t *load,
                                  int32_t estimate_q8, bool backwards) {
    const uint32_t pitch = parameters->pitch;
    load->window_q8 = load->window == 0 ? estimate_q8 : load->window_q8 + estimate_q8;
    if (load->window < pitch) {
        load->window++;
    } else {
        load->window_q8 -= load->estimate_q8[(backwards ? load->index + pitch : load->index - pitch) % VALUES];
    }
    return load->window_q8 / (int32_t)load->window;
}

static void end_value(const periodic_load_parameters_t *parameters, periodic_load_t *load, int32_t lag) {
    const uint32_t index = load->index % VALUES;
    const int32_t residual_q8 = load->sum_q8 / load->updates;
    const int32_t estimate_q8 = residual_q8 + (load->mode == PERIODIC_LOAD_CLEAR ? 0 : load->profile_q8[index]);
    load->total_q8 += residual_q8;
    load->residual_q8 += fixed_magnitude(residual_q8 - load->mean_q8);
    load->load_q8 += fixed_magnitude(estimate_q8 - load->mean_q8);
    load->change_q8 += fixed_magnitude(estimate_q8 - load->estimate_q8[index]);
    load->slow_q8 += fixed_magnitude(mean_over_pitch_q8(parameters, load, estimate_q8, lag < 0) - load->mean_q8);
    load->estimate_q8[index] = (int16_t)estimate_q8; /* the observer's at most 64 N m, the profile's at most 40 N m */

    const uint32_t ahead = (lag < 0 ? index - AHEAD : index + AHEAD) % VALUES;
    /* L / 64 in Q8. */
    const int32_t smoothing_q8 = (int32_t)(fixed_magnitude(lag) >> (VALUE_SHIFT - 2));
    const int32_t limit_q8 = parameters->torque_limit_q8;
    load->profile_q8[ahead] = (int16_t)fixed_clamp(updated_q8(load, ahead, smoothing_q8), -limit_q8, limit_q8);
    load->count++;
}

static int32_t profile_at_q24(const periodic_load_t *load, uint32_t angle) {
    const uint32_t from_middle = angle - (1u << (VALUE_SHIFT - 1));
    const uint32_t index = from_middle >> VALUE_SHIFT;
    const int32_t fraction_q16 = (int32_t)(from_middle << (32 - VALUE_SHIFT) >> 16);
    const int32_t from_q8 = load->profile_q8[index];
    const int32_t to_q8 = load->profile_q8[(index + 1) % VALUES];
    return from_q8 * 65536 + (to_q8 - from_q8) * fraction_q16;
}

void periodic_load_step(const periodic_load_parameters_t *parameters, periodic_load_t *load,
                        const periodic_load_sample_t *sample) {
    const int32_t angle_step = sample->angle_step;
    if (parameters->lag_periods == 0 || fixed_magnitude(angle_step) > (uint32_t)parameters->angle_step_max) {
        periodic_load_reset(load);
        return;
    }
    const int32_t lag = angle_step * parameters->lag_periods;
    const uint32_t index = (sample->angle - (uint32_t)lag) >> VALUE_SHIFT;
    if (load->count >= VALUES) {
        end_turn(parameters, load);
    } else if (index != load->index) {
        const uint32_t direction = angle_step < 0 ? UINT32_MAX : 1u;
        const uint32_t behind = (index - load->index) * direction % VALUES;
        if (load->updates > 0 && behind <= BEHIND_MAX) {
            end_value(parameters, load, lag);
            load->index = (load->index + direction) % VALUES;
        } else {
            load->mode = load->mode == PERIODIC_LOAD_CLEAR ? PERIODIC_LOAD_CLEAR : PERIODIC_LOAD_KEEP;
            load->window = 0;
            begin_turn(load);
            load->index = index;
        }
        load->updates = 0;
        load->sum_q8 = 0;
    }
    load->moved = load->moved || sample->moving;
    if (load->updates < UINT16_MAX) { /* the sum fits */
        load->updates++;
        load->sum_q8 += sample->load_torque_q24 >> 16;
    }
    load->torque_q24 = load->mode == PERIODIC_LOAD_CLEAR
                           ? 0
                           : profile_at_q24(load, sample->angle + (uint32_t)(angle_step * LEAD_PERIODS));
}

static int32_t extended_q8(periodic_load_range_t *range, int32_t value_q8) {
    range->least_q8 = fixed_min(value_q8, range->least_q8);
    range->most_q8 = fixed_max(value_q8, range->most_q8);
    return range->most_q8 - range->least_q8;
}

void periodic_load_review(periodic_load_t *load) {
    const uint32_t ended = load->reviewed_index % VALUES;
    load->reviewed_index = load->index;
    if (!load->engaged) {
        load->reviewed = false;
        return;
    }
    if (load->reviewed_index == ended) {
        return;
    }
    /* The value that was the present one has ended, and still has the profile of then. */
    const int32_t estimate_q8 = load->estimate_q8[ended];
    const int32_t residual_q8 = estimate_q8 - load->profile_q8[ended];
    if (!load->reviewed) {
        load->estimate = (periodic_load_range_t){estimate_q8, estimate_q8};
        load->residual = (periodic_load_range_t){residual_q8, residual_q8};
    }
    const int32_t swing_q8 = extended_q8(&load->estimate, estimate_q8);
    const int32_t moved_q8 = extended_q8(&load->residual, residual_q8);
    load->reviewed = moved_q8 < load->swing_q8;
    if (!load->reviewed && swing_q8 < moved_q8 >> 2) {
        load->mode = PERIODIC_LOAD_CLEAR;
        load->engaged = false;
        load->mean_q8 = estimate_q8;
        begin_turn(load);
    }
}
