#include "control/load_observer.h"

#include "fixed/divide.h"
#include "fixed/fixed.h"

/* Keeps a wild load estimate (a rotor that was turned by hand, an encoder that jumped) from taking seconds to return.
 */
#define LOAD_TORQUE_LIMIT_Q24 (60 * (1 << 24))

/* A 32nd of a turn. With less, an observer that starts at rest on a turning rotor slips from turn to turn for ever;
 * with more, a jump of the encoder throws the speed so far that it reads as overspeed. */
#define INNOVATION_LIMIT (1 << 27)

#define TORQUE_GAIN_LIMIT_Q20 (((int64_t)1 << 40) - 1)

/* 2 pi in Q3.28. */
#define TWO_PI_Q28 1686629713
#define TWO_PI_Q9 3217

/* 1 - e^-y in Q1.31 for y in Q1.31, 0..0.5: y (1 - y/2 (1 - y/3 (1 - y/4 (1 - y/5)))). A small bandwidth needs the
 * difference itself: 1 minus the table's e^-y is off by half a percent there. Products below 2^62. */
static int64_t decay_complement_q31(int64_t y_q31) {
    const int64_t one_q31 = (int64_t)1 << 31;
    int64_t series_q31 = one_q31;
    for (int n = 5; n >= 2; n--) {
        series_q31 = one_q31 - fixed_divide(fixed_shift(y_q31 * series_q31, 31), n);
    }
    return fixed_shift(y_q31 * series_q31, 31);
}

load_observer_gains_t load_observer_gains(uint32_t bandwidth_rad_s, uint32_t control_rate_hz, int32_t inertia_q30) {
    /* Widths in the comments are for the ends of the ranges: p = 1 - q <= 0.4, p rate <= 10000. */
    const int64_t rate = control_rate_hz; /* 20 bits */
    const int64_t one_q31 = (int64_t)1 << 31;
    const int64_t p_q31 = decay_complement_q31(fixed_divide((int64_t)bandwidth_rad_s << 31, rate));
    const int64_t q_q31 = one_q31 - p_q31;
    const int64_t p2_q46 = fixed_shift(p_q31 * p_q31, 16);
    const int64_t p3_q46 = fixed_shift(fixed_shift(p2_q46, 12) * p_q31, 19); /* Q34, 31 bits, * Q31 */
    const int64_t q3_q31 = (((q_q31 * q_q31) >> 31) * q_q31) >> 31;
    const int64_t inertia_rate_q30 = (int64_t)inertia_q30 * rate; /* 51 bits */

    load_observer_gains_t gains = {.angle_gain_q30 = (int32_t)((one_q31 - q3_q31) >> 1)};

    /* l2 * 2 pi * 2^14, which is 2 pi 2^-32 rad to 2^-22 rad/s in Q24. */
    const int64_t l2_q46 = ((p2_q46 * ((one_q31 + q_q31) >> 16)) >> 15) * 3 / 2 * rate; /* 46 + 16 bits */
    gains.speed_gain_q24 = fixed_saturate(fixed_shift((l2_q46 >> 24) * (TWO_PI_Q28 >> 4), 32));

    /* J l3 * 2 pi * 2^12, which is 2 pi 2^-32 rad to 2^-24 N m in Q20; J l3 = (J rate) (p^3 rate), below 2^25 for the
     * rates at which p is large: saturated above. */
    const int64_t p3_rate_q24 = fixed_shift(p3_q46 * rate, 22);         /* 35 bits */
    const int64_t inertia_rate_q14 = fixed_shift(inertia_rate_q30, 16); /* 35 bits */
    const int64_t limit = fixed_divide(INT64_MAX - (1 << 12), p3_rate_q24 > 0 ? p3_rate_q24 : 1);
    const int64_t inertia_l3_q38 = (inertia_rate_q14 < limit ? inertia_rate_q14 : limit) * p3_rate_q24;
    const int64_t torque_gain_q20 = fixed_shift(fixed_shift(inertia_l3_q38, 12) * TWO_PI_Q9, 23); /* 51 + 12 bits */
    gains.torque_gain_q20 = torque_gain_q20 < TORQUE_GAIN_LIMIT_Q20 ? torque_gain_q20 : TORQUE_GAIN_LIMIT_Q20;
    return gains;
}

load_observer_model_t load_observer_model(uint32_t control_rate_hz, int32_t inertia_q30, int32_t friction_q30) {
    const int64_t rate = control_rate_hz;
    return (load_observer_model_t){
        /* Ts / J * 2^-2 * 2^32 = 2^30 / (J rate). */
        .acceleration_q32 = fixed_saturate(fixed_divide((int64_t)1 << 60, inertia_q30 * rate)),
        .friction_q30 = friction_q30,
        /* Ts / (2 pi) * 2^10 * 2^32 = 2^42 / (2 pi rate). */
        .angle_step_q32 = (int32_t)fixed_divide(((int64_t)1 << 62) / TWO_PI_Q28 * 256, rate),
    };
}

void load_observer_reset(load_observer_t *observer, uint32_t angle) {
    *observer = (load_observer_t){.angle_q64 = (uint64_t)angle << 32};
}

int32_t load_observer_innovation(const load_observer_t *observer, uint32_t angle) {
    const uint32_t expected = (uint32_t)((observer->angle_q64 + ((uint64_t)1 << 31)) >> 32);
    return (int32_t)(angle - expected);
}

void load_observer_step(const load_observer_model_t *model, const load_observer_gains_t *gains,
                        load_observer_t *observer, int32_t innovation, int32_t torque_q24) {
    const int64_t error = fixed_clamp(innovation, -INNOVATION_LIMIT, INNOVATION_LIMIT);

    /* Correct. */
    observer->angle_q64 += (uint64_t)(error * gains->angle_gain_q30) << 2; /* Q30 to Q32 */
    observer->correction_q22 = fixed_saturate(fixed_shift(error * gains->speed_gain_q24, 24));
    const int32_t speed_q22 = fixed_add(observer->speed_q22, observer->correction_q22);
    /* 27 and 40 bits: the low 5 bits of the error are multiplied apart. */
    const int64_t load_change_q39 =
        (error >> 5) * gains->torque_gain_q20 + (((error & 31) * gains->torque_gain_q20) >> 5);
    const int64_t load_q24 = observer->load_torque_q24 - fixed_shift(load_change_q39, 15);
    observer->load_torque_q24 = (int32_t)(load_q24 > LOAD_TORQUE_LIMIT_Q24    ? LOAD_TORQUE_LIMIT_Q24
                                          : load_q24 < -LOAD_TORQUE_LIMIT_Q24 ? -LOAD_TORQUE_LIMIT_Q24
                                                                              : load_q24);

    /* Predict: constant acceleration over the period, so the angle moves at the mean of old and new speed. */
    const int32_t friction_q24 = fixed_multiply(speed_q22, model->friction_q30, 28);
    const int32_t net_q24 = fixed_subtract(fixed_subtract(torque_q24, friction_q24), observer->load_torque_q24);
    const int32_t next_q22 = fixed_add(speed_q22, fixed_multiply(net_q24, model->acceleration_q32, 32));
    const int64_t mean_q22 = ((int64_t)speed_q22 + next_q22) >> 1;
    observer->angle_q64 += (uint64_t)(mean_q22 * model->angle_step_q32);
    observer->speed_q22 = next_q22;
}
