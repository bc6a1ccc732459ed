#include "control/slow_counts.h"

#include "control/machine_tables.h"
#include "fixed/compiler.h"
#include "fixed/divide.h"
#include "fixed/fixed.h"
#include "fixed/formats.h"

#define SLOW_HZ 2000u
#define FAST_HZ 2666u
#define SLOW_BITS_MAX 12u
#define DEADBEAT_HZ 250u
#define LATE_COUNTS 4
#define PERIODS_MAX (UINT32_C(1) << 20)
#define ONE_Q28 (1 << 28)

/* 2 pi, Q3.28. */
#define TWO_PI_Q28 INT64_C(1686629713)

/* Slopes are in N m per 0.02 rad. */
#define SLOPES_PER_RAD INT64_C(50)

/* Range of u in which the fit of slow_counts.h is one, and of t / 4 ms, Q8: 0.5 s. */
#define U_MIN_Q8 (-576)
#define U_MAX_Q8 (36 << 8)
#define Z_MAX_Q8 (1u << 15)

/* Two counts, of a quarter each 4 ms, Q8. */
#define UNCERTAIN_MAX_Q8 (8u << 8)

slow_counts_parameters_t slow_counts_configure(uint32_t control_rate_hz, unsigned encoder_bits, int32_t inertia_q30) {
    const int64_t slope_gain_q46 = (SLOPES_PER_RAD << 46) / (DEADBEAT_HZ * DEADBEAT_HZ);
    const uint32_t deadbeat_periods = control_rate_hz / DEADBEAT_HZ; /* below 2^13 */
    return (slow_counts_parameters_t){
        .slow_periods = encoder_bits <= SLOW_BITS_MAX ? control_rate_hz / SLOW_HZ : UINT32_MAX,
        .fast_periods = control_rate_hz / FAST_HZ,
        .deadbeat_periods = deadbeat_periods,
        .count = UINT32_C(1) << (32u - encoder_bits),
        .step_q31 = (uint32_t)INT32_MAX / deadbeat_periods,
        .late_speed_q22 =
            (int32_t)(LATE_COUNTS * DEADBEAT_HZ * TWO_PI_Q28 >> (6u + encoder_bits + machine_tables.speed_exponent)),
        .slope_gain_q16 = fixed_saturate(fixed_divide(slope_gain_q46, inertia_q30) << machine_tables.speed_exponent),
        .deadbeat = load_observer_deadbeat_gains(DEADBEAT_HZ, inertia_q30),
    };
}

static int32_t product_q31(int32_t a_q31, int32_t b_q31) {
    return 2 * fixed_multiply_high(a_q31, b_q31);
}

/* With x = 1 - q: l1 = 1 - (1 - x)^3, and l2 = x (2 - x), l3 = x relative to the gains of x = 1 at 4 ms. */
static void set_narrow(const slow_counts_parameters_t *parameters, uint32_t periods, load_observer_gains_t *gains) {
    const int32_t x_q31 = (int32_t)(periods * parameters->step_q31);
    const int32_t q_q31 = INT32_MAX - x_q31;
    const int32_t q2_q31 = product_q31(q_q31, q_q31);
    gains->angle_gain_q28 = ONE_Q28 - (product_q31(q2_q31, q_q31) >> 3);
    gains->speed_gain_q24 = product_q31(parameters->deadbeat.speed_gain_q24, INT32_MAX - q2_q31);
    gains->load_gain_q28 = product_q31(parameters->deadbeat.load_gain_q28, x_q31 / 2);
}

/* The factor of l2 for a slope of the torque, by u = slope t^2 / J, Q12. */
static int32_t slope_factor_q12(const slow_counts_parameters_t *parameters, uint32_t periods, int32_t slope_q24) {
    const uint32_t ratio_q8 = (periods << 8) / parameters->deadbeat_periods;
    const int32_t z_q8 = (int32_t)fixed_min_u32(ratio_q8, Z_MAX_Q8);
    const int32_t of_4_ms_q24 = fixed_product_shift_saturate(slope_q24, parameters->slope_gain_q16, 16);
    const int32_t u_q8 = fixed_clamp(fixed_multiply_high(of_4_ms_q24, z_q8 * z_q8), U_MIN_Q8, U_MAX_Q8);
    return ((ONE_Q16 + 48 * u_q8) << 12) / (ONE_Q16 + (15 * u_q8 >> 1));
}

/* 4 ms / periods, Q31, for more periods than 4 ms have. */
static int32_t ratio_q31(const slow_counts_parameters_t *parameters, uint32_t periods) {
    return (int32_t)(((parameters->deadbeat_periods << 16) / periods) << 15);
}

/* q = 0: l2 and l3 by the time between the edges. */
static void set_deadbeat(const slow_counts_parameters_t *parameters, uint32_t periods, int32_t slope_q24,
                         load_observer_gains_t *gains) {
    const int32_t y_q31 = ratio_q31(parameters, periods);
    gains->angle_gain_q28 = ONE_Q28;
    gains->speed_gain_q24 = fixed_product_shift_saturate(product_q31(parameters->deadbeat.speed_gain_q24, y_q31),
                                                         slope_factor_q12(parameters, periods, slope_q24), 12);
    gains->load_gain_q28 = product_q31(product_q31(parameters->deadbeat.load_gain_q28, y_q31), y_q31 / 2);
}

NOINLINE bool slow_counts_step(const slow_counts_parameters_t *parameters, slow_counts_t *counts,
                               uint32_t encoder_angle, uint32_t rotation, uint32_t periods) {
    const uint32_t passed = counts->periods + periods;
    counts->periods = fixed_min_u32(passed, PERIODS_MAX);
    if ((uint64_t)counts->periods * rotation < parameters->count) {
        counts->interval = counts->periods;
    }
    const bool long_since = passed >= parameters->slow_periods;
    if (encoder_angle != counts->encoder_angle || passed <= parameters->deadbeat_periods) {
        counts->speed_max_q22 = INT32_MAX; /* at once: an update follows some periods later */
    }
    if (encoder_angle != counts->encoder_angle) {
        counts->encoder_angle = encoder_angle;
        counts->apart = fixed_min_u32(passed, PERIODS_MAX);
        counts->periods = counts->interval = 0;
        counts->slow = long_since || (counts->slow && passed >= parameters->fast_periods);
    } else if (long_since) {
        counts->slow = true;
    }
    return counts->slow;
}

NOINLINE void slow_counts_update(const slow_counts_parameters_t *parameters, slow_counts_t *counts, int32_t slope_q24) {
    const uint32_t coming = counts->interval + 1u;
    if (counts->periods > parameters->deadbeat_periods) {
        counts->speed_max_q22 = product_q31(parameters->late_speed_q22, ratio_q31(parameters, counts->periods));
    }
    counts->late = coming > parameters->deadbeat_periods;
    counts->edge.load_factor_q4 = parameters->deadbeat.load_factor_q4;
    if (!counts->late) {
        set_narrow(parameters, coming, &counts->edge);
    } else {
        set_deadbeat(parameters, coming, slope_q24, &counts->edge);
    }
}

uint32_t slow_counts_uncertain_angle(const slow_counts_parameters_t *parameters, const slow_counts_t *counts) {
    const uint32_t apart = fixed_max_u32(counts->apart, counts->interval);
    const uint32_t ratio_q8 = (apart << 8) / parameters->deadbeat_periods;
    return (parameters->count >> 10) * fixed_min_u32(ratio_q8, UNCERTAIN_MAX_Q8);
}

uint32_t slow_counts_angle(const slow_counts_results_t *results, const load_observer_t *observer,
                           uint32_t encoder_angle, unsigned encoder_shift) {
    const int32_t change = (int32_t)(encoder_angle - results->encoder_angle);
    const int32_t last = (int32_t)((1u << encoder_shift) - 1u);
    if (change != 0) {
        return encoder_angle + (change > 0 ? 0 : (uint32_t)last);
    }
    const int32_t predicted = (int32_t)((uint32_t)(observer->angle_q64 >> 32) - encoder_angle);
    return encoder_angle + (uint32_t)fixed_clamp(predicted, 0, last);
}

const load_observer_gains_t *slow_counts_gains(const slow_counts_parameters_t *parameters,
                                               const slow_counts_results_t *results, uint32_t encoder_angle) {
    return encoder_angle != results->encoder_angle || results->late ? &results->edge : &parameters->deadbeat;
}
