#include "control/load_observer.h"

#include "control/machine_tables.h"
#include "fixed/divide.h"
#include "fixed/fixed.h"

/* 64 N m: without a limit, an estimate disturbed by a rotor turned by hand or by a jump of the encoder would take
 * seconds to recover. */
#define LOAD_TORQUE_LIMIT_Q24 (1 << 30)

/* 1/32 rev. A smaller limit lets an observer that starts at speed 0 on a spinning rotor slip whole revolutions
 * indefinitely; a larger one lets a jump of the encoder move the speed estimate into overspeed. */
#define INNOVATION_LIMIT (1 << 27)

/* 2 pi in Q3.28. It joins angle and speed: its products are divided by the unit of speed, 2^speed_exponent rad/s, or
 * multiplied by it. */
#define TWO_PI_Q28 1686629713

/* 1 - e^-y in Q1.31 for y in Q1.31, 0..0.5, by its series y (1 - y/2 (1 - y/3 (1 - y/4 (1 - y/5)))). At small
 * bandwidths the difference 1 - exp2_negative_q31() would be wrong by half a percent. Products below 2^62. */
static int64_t decay_complement_q31(int64_t y_q31) {
    const int64_t one_q31 = (int64_t)1 << 31;
    int64_t series_q31 = one_q31;
    for (int n = 5; n >= 2; n--) {
        series_q31 = one_q31 - fixed_divide(fixed_shift(y_q31 * series_q31, 31), n);
    }
    return fixed_shift(y_q31 * series_q31, 31);
}

/* Number value / 2^fraction_bits, normalised: value in 2^30..2^31 - 1, or 0. */
typedef struct {
    int32_t value;
    int fraction_bits;
} normal_t;

static normal_t normal(int64_t value, int fraction_bits) {
    while (value > INT32_MAX) {
        value >>= 1;
        fraction_bits--;
    }
    while (value > 0 && value <= INT32_MAX / 2) {
        value <<= 1;
        fraction_bits++;
    }
    return (normal_t){(int32_t)value, fraction_bits};
}

static normal_t normal_product(normal_t a, normal_t b) {
    return normal((int64_t)a.value * b.value, a.fraction_bits + b.fraction_bits);
}

/* Gains by 1 - q^3, (1 - q)^2 (1 + q) and (1 - q)^3. */
static load_observer_gains_t gains_of_poles(int64_t l1_q31, int64_t p2_1q_q46, int64_t p3_q46, int64_t rate,
                                            int32_t inertia_q30) {
    load_observer_gains_t gains = {.angle_gain_q28 = (int32_t)(l1_q31 >> 3)};

    /* l2 2 pi 2^14: from 2 pi 2^-32 rad to 2^-22 rad/s, in Q24. */
    const int64_t l2_q46 = p2_1q_q46 * 3 / 2 * rate; /* 46 + 16 bits */
    gains.speed_gain_q24 =
        fixed_saturate(fixed_shift((l2_q46 >> 24) * (TWO_PI_Q28 >> 4), 32u + machine_tables.speed_exponent));

    /* J l3 2 pi 2^-8: from 2 pi 2^-32 rad to 2^-24 N m; J l3 = (J rate) (p^3 rate). Factors and products are normalised
     * to 31 bits. */
    normal_t load = normal_product(normal(inertia_q30 * rate, 30), normal(p3_q46 * rate, 46));
    load = normal_product(load, normal(TWO_PI_Q28, 28 + 8 + machine_tables.speed_exponent));
    /* More than 28 fraction bits are cut off, fewer become the factor: at most 2^20 per unit, for which it is 2^17. */
    const int exponent = 28 - load.fraction_bits;
    gains.load_gain_q28 = -(exponent >= 0 ? load.value : exponent > -31 ? load.value >> -exponent : 0);
    gains.load_factor_q4 = 16 << fixed_clamp(exponent, 0, 26);
    return gains;
}

load_observer_gains_t load_observer_gains(uint32_t bandwidth_rad_s, uint32_t control_rate_hz, int32_t inertia_q30) {
    /* Widths are those at the ends of the ranges: p = 1 - q <= 0.4, p rate <= 10000. */
    const int64_t rate = control_rate_hz; /* 20 bits */
    const int64_t one_q31 = (int64_t)1 << 31;
    const int64_t p_q31 = decay_complement_q31(fixed_divide((int64_t)bandwidth_rad_s << 31, rate));
    const int64_t q_q31 = one_q31 - p_q31;
    const int64_t p2_q46 = fixed_shift(p_q31 * p_q31, 16);
    const int64_t p3_q46 = fixed_shift(fixed_shift(p2_q46, 12) * p_q31, 19); /* Q34, 31 bits, * Q31 */
    const int64_t q3_q31 = (((q_q31 * q_q31) >> 31) * q_q31) >> 31;
    return gains_of_poles(one_q31 - q3_q31, (p2_q46 * ((one_q31 + q_q31) >> 16)) >> 15, p3_q46, rate, inertia_q30);
}

load_observer_gains_t load_observer_deadbeat_gains(uint32_t sample_rate_hz, int32_t inertia_q30) {
    return gains_of_poles((int64_t)1 << 31, (int64_t)1 << 46, (int64_t)1 << 46, sample_rate_hz, inertia_q30);
}

load_observer_model_t load_observer_model(uint32_t control_rate_hz, int32_t inertia_q30, int32_t friction_q30) {
    const int64_t rate = control_rate_hz;
    return (load_observer_model_t){
        /* Ts / J * 2^-2 * 2^32 = 2^30 / (J rate). */
        .acceleration_q32 = fixed_saturate(fixed_divide((int64_t)1 << 60, inertia_q30 * rate)),
        .friction_q30 = friction_q30,
        /* Ts / (2 pi) * 2^10 * 2^32 = 2^42 / (2 pi rate). */
        .angle_step_q32 =
            (int32_t)fixed_divide(((int64_t)1 << 62) / TWO_PI_Q28 * (256 << machine_tables.speed_exponent), rate),
    };
}

load_observer_inertia_t load_observer_inertia(const load_observer_model_t *model, int32_t k) {
    const int32_t nominal_q32 = model->acceleration_q32, max_q32 = INT32_MAX >> fixed_max(k, 0);
    const int32_t limited_q32 = fixed_min(nominal_q32, max_q32);
    return (load_observer_inertia_t){
        .acceleration_q32 = k > 0 ? limited_q32 << k : limited_q32 >> -k,
        .load_shift = k + 2,
    };
}

int64_t load_observer_acceleration(int32_t torque_q24, int32_t inertia_q30) {
    return fixed_divide((int64_t)torque_q24 * (1 << 6), inertia_q30);
}

void load_observer_reset(load_observer_t *observer, uint32_t angle) {
    *observer = (load_observer_t){.angle_q64 = (uint64_t)angle << 32};
}

int32_t load_observer_innovation(const load_observer_t *observer, uint32_t angle) {
    const uint32_t predicted = (uint32_t)(observer->angle_q64 >> 32);
    return fixed_clamp((int32_t)(angle - predicted), -INNOVATION_LIMIT, INNOVATION_LIMIT - 1);
}

void load_observer_step(const load_observer_model_t *model, const load_observer_gains_t *gains,
                        const load_observer_inertia_t *inertia, load_observer_t *observer, int32_t innovation,
                        int32_t torque_q24) {
    const int32_t innovation_q4 = innovation * 16;

    /* Correct. */
    int64_t angle_q64 = fixed_accumulate((int64_t)observer->angle_q64, innovation_q4, gains->angle_gain_q28);
    observer->speed_correction_q22 = fixed_product_shift_saturate(innovation_q4, gains->speed_gain_q24, 28);
    const int32_t speed_q22 = fixed_add(observer->speed_q22, observer->speed_correction_q22);
    const int32_t unscaled_q24 = fixed_multiply_high(innovation_q4, gains->load_gain_q28);
    const int32_t load_factor_q4 = (gains->load_factor_q4 << 2) >> inertia->load_shift; /* at most 2^23 */
    const int32_t load_correction_q24 = fixed_product_shift_saturate(unscaled_q24, load_factor_q4, 4);
    const int32_t load_q24 = fixed_add(observer->load_torque_q24, load_correction_q24);
    observer->load_torque_q24 = fixed_clamp(load_q24, -LOAD_TORQUE_LIMIT_Q24, LOAD_TORQUE_LIMIT_Q24 - 1);

    /* Predict: acceleration is constant over the period, so the angle advances at the mean of old and new speed. */
    const int32_t friction_q24 = fixed_product_shift_saturate(speed_q22, model->friction_q30, 28);
    const int32_t net_q24 = fixed_subtract(fixed_subtract(torque_q24, friction_q24), observer->load_torque_q24);
    const int32_t speed_change_q22 = fixed_multiply_high(net_q24, inertia->acceleration_q32);
    const int32_t mean_speed_q22 = fixed_add(speed_q22, speed_change_q22 >> 1);
    angle_q64 = fixed_accumulate(angle_q64, mean_speed_q22, model->angle_step_q32);
    observer->angle_q64 = (uint64_t)angle_q64;
    observer->speed_q22 = fixed_add(speed_q22, speed_change_q22);
}
