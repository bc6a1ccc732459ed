#include "control/moving_load.h"

#include "fixed/divide.h"
#include "fixed/fixed.h"

#define TIME_CONSTANT_US 1600
/* After which 5 % of a trend are left. */
#define SETTLING_TIME_CONSTANTS 3

#define HOLD_MS 25
#define HOLDS_MAX 32
#define RELEASE_MS 5

/* Ratios p / q up to this q: the trend of the next ones is below 1/14 count. */
#define ROUNDING_RATIOS 6u

/* 2^-32 rev, Q28.4: 0.3 urad, what an ideal encoder leaves (observer_bandwidth.c), and 0.7 urad. */
#define THRESHOLD_IDEAL_Q4 3281
#define THRESHOLD_EDGE_Q4 7656

/* By which a trend widens the bandwidth: to (16 / 13)^4 = 2.3 times. */
#define WIDENING_STAGES 4u

moving_load_parameters_t moving_load_configure(const moving_load_settings_t *settings) {
    const unsigned encoder_shift = 32u - settings->encoder_bits;
    const uint32_t ticks_per_ms = settings->control_rate_hz / 1000u;
    const uint32_t time_constant = ticks_per_ms * TIME_CONSTANT_US / 1000u;
    return (moving_load_parameters_t){
        .gain_q32 = (int32_t)fixed_divide((int64_t)1 << 32, time_constant),
        .time_constant = time_constant,
        .encoder_shift = encoder_shift,
        .threshold_count_q4 = (2u << encoder_shift) + THRESHOLD_IDEAL_Q4,
        .hold_ticks_min = ticks_per_ms * HOLD_MS,
        .hold_ticks_max = ticks_per_ms * HOLD_MS * HOLDS_MAX,
        .release_ticks = ticks_per_ms * RELEASE_MS,
        .settling_ticks = settings->trigger_ticks + SETTLING_TIME_CONSTANTS * time_constant,
        .stages = settings->stages,
    };
}

/* Stages that a trend withholds, at the present stage. */
static uint32_t stages_of_trend(const moving_load_parameters_t *parameters, unsigned stage) {
    const uint32_t wider = stage == OBSERVER_BANDWIDTH_BEAT_STAGE ? 1u : WIDENING_STAGES;
    return fixed_min_u32(parameters->stages, OBSERVER_BANDWIDTH_BEAT_STAGE - stage + wider);
}

/* A trend soon after the release of the first of these stages doubles the hold. */
static void withhold(const moving_load_parameters_t *parameters, moving_load_t *moving, uint32_t stages) {
    uint32_t hold_ticks = moving->hold_ticks;
    if (moving->withheld < stages) {
        moving->settling = parameters->time_constant;
        if (moving->withheld == 0 || moving->releasing) {
            moving->first = hold_ticks == 0;
            hold_ticks *= 2;
        }
    }
    moving->releasing = false;
    moving->hold_ticks = (uint32_t)fixed_clamp((int32_t)hold_ticks, (int32_t)parameters->hold_ticks_min,
                                               (int32_t)parameters->hold_ticks_max);
    moving->withheld = fixed_max_u32(moving->withheld, stages);
    moving->ticks = moving->hold_ticks;
}

/* A load step has a trend before its first trigger: what that has withheld is released. Only the first time, until
 * hold_ticks has decayed: a load that moves goes on. */
static void begin_settling(const moving_load_parameters_t *parameters, moving_load_t *moving) {
    moving->settling = parameters->settling_ticks;
    if (moving->first) {
        moving->withheld = 0;
        moving->ticks = moving->hold_ticks;
    }
    moving->first = false;
}

uint32_t moving_load_rounding_q4(const moving_load_parameters_t *parameters, moving_load_rounding_t *rounding,
                                 uint32_t angle_step) {
    const uint32_t step_q32 = angle_step << (31u - parameters->encoder_shift) << 1; /* counts modulo 1 */
    const uint32_t q = rounding->q + 1;
    const uint32_t distance_q15 = fixed_magnitude((int32_t)(q * step_q32)) >> 17; /* at most 2^14 */
    const uint32_t quarters = (distance_q15 * parameters->time_constant) >> 13;   /* of the beats; below 2^12 */
    const uint32_t divisor = q * (quarters + 1);
    /* None is 0, which counts as the largest one. */
    const uint32_t least = divisor - 1u < rounding->least - 1u ? divisor : rounding->least;
    rounding->least = least;
    rounding->q = q;
    if (q == ROUNDING_RATIOS) {
        rounding->q = 0;
        rounding->least = 0;
        rounding->rounding_q4 = (8u << parameters->encoder_shift) / least;
    }
    return rounding->rounding_q4;
}

uint32_t moving_load_step(const moving_load_parameters_t *parameters, moving_load_t *moving,
                          const observer_bandwidth_sample_t *sample, uint32_t rounding_q4, bool hold) {
    const int32_t trend_q4 = (int32_t)(moving->trend_q36 >> 32);
    moving->trend_q36 =
        fixed_accumulate(moving->trend_q36, fixed_subtract(sample->innovation * 16, trend_q4), parameters->gain_q32);
    const uint32_t threshold_q4 = sample->from_edge ? THRESHOLD_EDGE_Q4 : parameters->threshold_count_q4 + rounding_q4;
    if (sample->trigger != OBSERVER_TRIGGER_NONE) {
        begin_settling(parameters, moving);
    }
    moving->settling -= moving->settling > 0;
    if (moving->settling == 0 && fixed_magnitude(trend_q4) > threshold_q4) {
        withhold(parameters, moving, stages_of_trend(parameters, sample->stage));
    } else if (moving->ticks > 0) {
        moving->ticks -= !hold;
    } else if (moving->withheld > 0) {
        moving->withheld--;
        moving->releasing = true;
        moving->ticks = moving->withheld > 0 ? parameters->release_ticks : moving->hold_ticks;
    } else {
        moving->hold_ticks /= 2;
        moving->ticks = moving->hold_ticks;
    }
    return moving->withheld;
}
