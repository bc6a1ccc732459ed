#include "control/inertia.h"

#include "control/machine_tables.h"
#include "fixed/compiler.h"
#include "fixed/divide.h"
#include "fixed/fixed.h"

#define SHIFT_MIN (-2)
#define SHIFT_MAX 2

/* A window is at least 0.8 ms, and not longer than needed for one count to be 1/24 of the largest torque. */
#define WINDOW_RATE_MAX_HZ 1250u
#define WINDOW_SHIFT_MAX 12
#define COUNT_SHARE 24

/* Means over 4 windows. */
#define MEAN_SHIFT 2

/* Windows from the start of a run until its torque acts on a turning rotor. */
#define START_WINDOWS 4u

/* Windows of a regression that has begun anew: with fewer any change of torque and acceleration is on one line. */
#define REGRESSION_WINDOWS 3u

/* Windows after a torque at its limit that still belong to the transient. */
#define TRANSIENT_WINDOWS 8

/* The rest and its reciprocal, 1/2..2. */
#define REST_BITS 14
#define REST_ONE (1 << REST_BITS)
#define REST_LITTLE (REST_ONE / 4)

/* Beyond them the shift is another one. */
#define REST_SMALL (REST_ONE / 8 * 5)
#define REST_LARGE (REST_ONE / 4 * 7)

/* Parts of the least variance with which a rest is followed, and with which the first one of a run is found. */
#define FOLLOWED_VARIANCE_SHIFT 2
#define FIRST_VARIANCE_SHIFT 6

/* Part of the variance of A that the counts may be for the first one: two windows are always on a line. */
#define COUNTS_SHIFT 4

/* Longer windows, of coarse encoders, are means over more than a ramp of an acceleration. */
#define FINE_RATE_MIN_HZ 300u

/* Least standard deviation of the torque, as a part of the largest torque. */
#define DEVIATION_SHARE 8

/* 2 pi in Q3.28. */
#define TWO_PI_Q28 1686629713

/* 2 pi J0 rate^2 / (poles 2^speed_exponent), torque for an electrical revolution per window^2, is in N m, Q8.23, per
 * 2^-32 revolution that divided by 2^9. */
static int64_t gain_q8(const inertia_settings_t *settings, int64_t window_rate_hz) {
    const int64_t inertia_q28 = fixed_shift((int64_t)settings->inertia_q30 * (TWO_PI_Q28 >> 8), 22);
    const int64_t gain_q18 =
        fixed_divide(((inertia_q28 * window_rate_hz) >> 10) * window_rate_hz, settings->rotor_poles);
    return gain_q18 >> (19 + machine_tables.speed_exponent);
}

inertia_parameters_t inertia_configure(const inertia_settings_t *settings) {
    const uint32_t update_rate_hz = settings->control_rate_hz / settings->periods_per_update;
    const int64_t count = (int64_t)settings->rotor_poles << (32 - settings->encoder_bits);
    const int64_t gain_max_q8 = fixed_divide((int64_t)settings->torque_max_q24 << 7, COUNT_SHARE * count);
    unsigned shift = 1;
    while (update_rate_hz >> shift > WINDOW_RATE_MAX_HZ ||
           (shift < WINDOW_SHIFT_MAX && gain_q8(settings, update_rate_hz >> shift) > gain_max_q8)) {
        shift++;
    }
    const int32_t deviation_q23 = settings->torque_max_q24 / 2 / DEVIATION_SHARE;
    const int32_t gain = fixed_saturate(gain_q8(settings, update_rate_hz >> shift));
    const int32_t count_q23 = fixed_saturate((int64_t)gain * count >> 8);
    /* A second difference of angles that are each off by up to half a count: 6/12 of its square. */
    const int32_t count_variance_q14 = fixed_max(fixed_multiply_high(count_q23, count_q23) / 2, 1);
    return (inertia_parameters_t){
        .gain_q8 = gain,
        .variance_min_q14 = fixed_multiply_high(deviation_q23, deviation_q23),
        .window_shift = shift,
        .torque_shift = 2 * shift + 2,
        .count_variance_q14 = update_rate_hz >> shift >= FINE_RATE_MIN_HZ ? count_variance_q14 : 0,
        .reaching_gain_q24 = settings->reaching_gain_q24,
        .rate_q8 = settings->rate_q8,
    };
}

/* value 2^-k for value >= 0, saturates. */
ALWAYS_INLINE int32_t scaled(int32_t value, int32_t k) {
    if (k >= 0) {
        return value >> k;
    }
    const int32_t max = INT32_MAX >> -k;
    return fixed_min(value, max) << -k;
}

/* A shift beyond its limits has not been identified: it has changed in memory. */
static void limit_shift(inertia_t *inertia) {
    if ((uint32_t)(inertia->shift - SHIFT_MIN) > SHIFT_MAX - SHIFT_MIN) {
        inertia->shift = 0;
    }
}

static void set_laws(inertia_t *inertia) {
    inertia->laws = (inertia_laws_t){
        .observer = load_observer_inertia(&inertia->base.observer, inertia->shift),
        .reaching_gain_q24 = scaled(inertia->base.reaching_gain_q24, inertia->shift),
        .rate_q8 = scaled(inertia->base.rate_q8, inertia->shift),
    };
}

static int32_t limited_rest(int32_t rest_q14) {
    return fixed_clamp(rest_q14, REST_ONE / 2, REST_ONE * 2);
}

static int32_t by_rest(int32_t value, int32_t rest_q14) {
    return fixed_multiply(value, rest_q14, REST_BITS);
}

/* Laws of J0 / g; its bits for a rest of 1. */
COLD NOINLINE static void set_base(const inertia_parameters_t *parameters, const load_observer_model_t *model,
                                   inertia_t *inertia) {
    const int32_t inverse_q14 = limited_rest(inertia->inverse_rest_q14);
    inertia->base.observer.acceleration_q32 = by_rest(model->acceleration_q32, limited_rest(inertia->rest_q14));
    inertia->base.reaching_gain_q24 = by_rest(parameters->reaching_gain_q24, inverse_q14);
    inertia->base.rate_q8 = by_rest(parameters->rate_q8, inverse_q14);
    inertia->ratio_q14 = scaled(inverse_q14, inertia->shift);
}

void inertia_restart(const inertia_parameters_t *parameters, const load_observer_model_t *model, inertia_t *inertia,
                     uint32_t angle) {
    if (inertia->gain_q8 != parameters->gain_q8) {
        inertia->gain_q8 = parameters->gain_q8;
        inertia->shift = 0;
    }
    inertia->updates = 0;
    inertia->sum_of_sums_q23 = 0;
    inertia->angle = angle;
    inertia->torque_mean_q23 = inertia->acceleration_mean_q23 = 0;
    inertia->torque_variance_q14 = inertia->acceleration_variance_q14 = inertia->covariance_q14 = 0;
    limit_shift(inertia);
    inertia->base = (inertia_base_t){*model, parameters->reaching_gain_q24, parameters->rate_q8};
    inertia->rest_q14 = inertia->inverse_rest_q14 = REST_ONE;
    inertia->ratio_q14 = scaled(REST_ONE, inertia->shift);
    inertia->refined_shift = inertia->shift;
    inertia->refined_windows = 0;
    set_laws(inertia);
}

COLD void inertia_tune(const inertia_parameters_t *parameters, const load_observer_model_t *model, inertia_t *inertia) {
    limit_shift(inertia);
    set_base(parameters, model, inertia);
}

COLD void inertia_tune_laws(inertia_t *inertia) {
    set_laws(inertia);
}

/* Ends a window. */
static void measure_course(const inertia_parameters_t *parameters, inertia_t *inertia, uint32_t angle) {
    const uint32_t rotation = angle - inertia->angle;
    const int32_t change = (int32_t)(rotation - inertia->rotation);
    inertia->torque_q23 = (int32_t)(inertia->sum_of_sums_q23 - inertia->last_sum_of_sums_q23);
    inertia->acceleration_q23 = fixed_multiply(change, parameters->gain_q8, 8);
    inertia->angle = angle;
    inertia->rotation = rotation;
    inertia->last_sum_of_sums_q23 = inertia->sum_of_sums_q23;
    inertia->sum_of_sums_q23 = 0;
}

static int32_t mean_step(int32_t mean, int32_t value) {
    return mean + (fixed_subtract(value, mean) >> MEAN_SHIFT);
}

static void correlate(inertia_t *inertia, uint32_t windows) {
    if (windows < 2) {
        return;
    }
    if (windows == START_WINDOWS) {
        inertia->torque_mean_q23 = inertia->torque_q23;
        inertia->acceleration_mean_q23 = inertia->acceleration_q23;
        inertia->torque_variance_q14 = inertia->acceleration_variance_q14 = inertia->covariance_q14 = 0;
        return;
    }
    const int32_t torque_q23 = fixed_subtract(inertia->torque_q23, inertia->torque_mean_q23);
    const int32_t acceleration_q23 = fixed_subtract(inertia->acceleration_q23, inertia->acceleration_mean_q23);
    inertia->torque_mean_q23 += torque_q23 >> MEAN_SHIFT;
    inertia->acceleration_mean_q23 += acceleration_q23 >> MEAN_SHIFT;
    inertia->torque_variance_q14 = mean_step(inertia->torque_variance_q14, fixed_multiply_high(torque_q23, torque_q23));
    inertia->acceleration_variance_q14 =
        mean_step(inertia->acceleration_variance_q14, fixed_multiply_high(acceleration_q23, acceleration_q23));
    inertia->covariance_q14 = mean_step(inertia->covariance_q14, fixed_multiply_high(torque_q23, acceleration_q23));
}

/* Changes the shift by one when the regression is off by more than 1.75 or 1 / 1.6. An inertia of more than 8 J0 is
 * none: T then follows a load that moves. */
static void judge(const inertia_parameters_t *parameters, inertia_t *inertia, uint32_t windows) {
    if (inertia->transient_windows == 0) {
        return;
    }
    inertia->transient_windows--;
    if (windows - START_WINDOWS < REGRESSION_WINDOWS) { /* unsigned: not before it begins anew */
        return;
    }
    const int32_t variance = inertia->torque_variance_q14;
    const int32_t covariance = inertia->covariance_q14;
    const int64_t product = fixed_product(variance, inertia->acceleration_variance_q14);
    if (variance < parameters->variance_min_q14 || covariance < variance / 8 ||
        fixed_product(covariance, covariance) < product - (product >> 3)) {
        return;
    }
    const int32_t present = scaled(variance, -inertia->shift) / 8;
    if (covariance > present * 14 && inertia->shift < SHIFT_MAX) {
        inertia->shift++;
    } else if (covariance < present * 5 && inertia->shift > SHIFT_MIN && windows > START_WINDOWS) {
        inertia->shift--;
    }
}

void inertia_step(const inertia_parameters_t *parameters, inertia_t *inertia, uint32_t angle, int32_t torque_q24,
                  bool limited, bool approaching) {
    /* The sum of sums takes the sum of the middle of the update, to which the mean torque belongs. */
    const uint32_t half_q23 = (uint32_t)(torque_q24 >> parameters->torque_shift);
    inertia->sum_q23 += half_q23;
    inertia->sum_of_sums_q23 += inertia->sum_q23;
    inertia->sum_q23 += half_q23;
    inertia->updates++;
    if (!approaching) {
        inertia->transient_windows = 0;
    } else if (limited) {
        inertia->transient_windows = TRANSIENT_WINDOWS;
    }
    const uint32_t windows = inertia->updates >> parameters->window_shift;
    const uint32_t update = inertia->updates - (windows << parameters->window_shift);
    if (update == 0) {
        measure_course(parameters, inertia, angle);
        correlate(inertia, windows);
    } else if (update == 1 && windows > 1) { /* the rotation before the first window is unknown */
        limit_shift(inertia);
        judge(parameters, inertia, windows);
        set_laws(inertia);
    }
}

static void follow_rest(inertia_t *inertia) {
    const int32_t present = fixed_max(scaled(inertia->torque_variance_q14, -inertia->shift), 1);
    const int64_t wanted_q14 = (int64_t)inertia->covariance_q14 * REST_ONE;
    const int64_t missing_q14 = wanted_q14 - fixed_product(present, inertia->rest_q14);
    const unsigned bits = 32u - (unsigned)__builtin_clz((uint32_t)present);
    const int32_t step_q14 = fixed_saturate(missing_q14 >> bits);
    const bool little = fixed_abs(step_q14) < REST_LITTLE;
    const int32_t followed_q14 = fixed_add(inertia->rest_q14, little ? step_q14 / 4 : step_q14);
    int32_t rest_q14 = fixed_clamp(followed_q14, REST_ONE / 8, REST_ONE * 8);
    UNROLL(3)
    for (unsigned i = 0; i < 3; i++) {
        if (rest_q14 < REST_SMALL && inertia->shift > SHIFT_MIN) {
            inertia->shift--;
            rest_q14 *= 2;
        } else if (rest_q14 > REST_LARGE && inertia->shift < SHIFT_MAX) {
            inertia->shift++;
            rest_q14 /= 2;
        }
    }
    inertia->rest_q14 = limited_rest(rest_q14);
    inertia->refined_shift = inertia->shift;
}

/* The rest of the present shift, which has changed. */
static void move_rest(inertia_t *inertia, int32_t change) {
    const int32_t rest_q14 = limited_rest(inertia->rest_q14), inverse_q14 = limited_rest(inertia->inverse_rest_q14);
    inertia->rest_q14 = limited_rest(scaled(rest_q14, change));
    inertia->inverse_rest_q14 = limited_rest(scaled(inverse_q14, -change));
}

static bool is_straight(const inertia_parameters_t *parameters, const inertia_t *inertia) {
    const int32_t variance = inertia->torque_variance_q14, covariance = inertia->covariance_q14;
    const int64_t product = fixed_product(variance, inertia->acceleration_variance_q14);
    const bool beyond_counts = inertia->acceleration_variance_q14 >> COUNTS_SHIFT >= parameters->count_variance_q14;
    const bool first = inertia->rest_q14 == REST_ONE && beyond_counts;
    return variance >= parameters->variance_min_q14 >> (first ? FIRST_VARIANCE_SHIFT : FOLLOWED_VARIANCE_SHIFT) &&
           covariance >= variance / 8 && fixed_product(covariance, covariance) >= product - (product >> 5);
}

COLD NOINLINE void inertia_refine(const inertia_parameters_t *parameters, const load_observer_model_t *model,
                                  inertia_t *inertia) {
    const uint32_t windows = inertia->updates >> parameters->window_shift;
    if (windows == inertia->refined_windows && inertia->shift == inertia->refined_shift) {
        return;
    }
    limit_shift(inertia);
    const int32_t change = fixed_clamp(inertia->shift - inertia->refined_shift, -1, 1);
    inertia->refined_windows = windows;
    inertia->refined_shift = inertia->shift;
    if (parameters->count_variance_q14 == 0) {
        inertia->ratio_q14 = scaled(REST_ONE, inertia->shift);
        return;
    }
    move_rest(inertia, change);
    if (inertia->transient_windows > 0 && windows > START_WINDOWS + REGRESSION_WINDOWS &&
        is_straight(parameters, inertia)) {
        follow_rest(inertia);
    }
    UNROLL(3)
    for (unsigned i = 0; i < 3; i++) {
        const int32_t inverse_q14 = inertia->inverse_rest_q14;
        const int32_t missing_q14 = REST_ONE - by_rest(inertia->rest_q14, inverse_q14);
        inertia->inverse_rest_q14 = limited_rest(inverse_q14 + by_rest(inverse_q14, missing_q14));
    }
    set_base(parameters, model, inertia);
    set_laws(inertia);
}
