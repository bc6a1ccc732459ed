#include "control/position/position_configure.h"

#include "fixed/compiler.h"
#include "fixed/divide.h"
#include "fixed/fixed.h"

/* 2^48 rev / 60 s in ms, ms^2, ms^3: r/min, r/min/s, r/min/s^2 to a profile's units. */
#define PER_RPM_Q8 INT64_C(1200959900633)
#define PER_RPM_S INT64_C(4691250)
#define PER_RPM_S2 INT64_C(4691)

/* Identified inertia by the parameter's, Q14: 9/8 and 8. */
#define RATIO_LARGE_Q14 (9 << 11)
#define RATIO_MAX_Q14 (8 << 14)
#define RATIO_MIN_Q14 (1 << 11)

/* Part of the largest torque that an acceleration uses, Q14. */
#define USED_Q14 (3 << 12)

#define REV (INT64_C(1) << PROFILE_FRACTION_BITS)

COLD NOINLINE static int64_t saturated(int64_t value, int64_t factor) {
    int64_t product;
    return __builtin_mul_overflow(value, factor, &product) ? INT64_MAX : product; /* before it is shifted and limited */
}

/* r/min in the unit of the machine; 0 for a negative one. */
COLD NOINLINE static int64_t in_unit(int32_t value, unsigned speed_exponent, int64_t factor) {
    return saturated((int64_t)fixed_max(value, 0) << speed_exponent, factor);
}

static int64_t either(int64_t value, int64_t otherwise) {
    return value > 0 ? value : otherwise;
}

static int64_t smaller(int64_t a, int64_t b) {
    return a < b ? a : b;
}

/* LSB of Q9.22 in 2^-48 rev per tick, Q16: angle_step_q32 is 2^-64 rev per period. */
static int64_t per_speed_q16(const position_settings_t *settings) {
    return (int64_t)settings->angle_step_q32 * (settings->control_rate_hz / PROFILE_TICK_HZ);
}

/* Acceleration by the largest torque. */
COLD NOINLINE static int64_t acceleration_by_torque(const position_settings_t *settings) {
    /* Change of the speed in a period, Q22. */
    const int64_t change_q22 = fixed_product(settings->torque_max_q24, settings->acceleration_q32) >> 32;
    const int64_t rate_per_tick = settings->control_rate_hz / PROFILE_TICK_HZ;
    return saturated(change_q22 * rate_per_tick, per_speed_q16(settings) >> 8) >> 8;
}

COLD static profile_limits_t limits_from(const position_settings_t *settings) {
    const unsigned exponent = settings->speed_exponent;
    const int64_t speed_max = saturated(settings->speed_max_q22 >> 4, per_speed_q16(settings)) >> 12;
    const int64_t by_torque = acceleration_by_torque(settings);
    const int64_t speed = in_unit(settings->speed_rpm, exponent, PER_RPM_Q8) >> 8;
    const int64_t up = either(in_unit(settings->acceleration_rpm_s, exponent, PER_RPM_S), by_torque / 4 * 3);
    const int64_t down = either(in_unit(settings->deceleration_rpm_s, exponent, PER_RPM_S), up);
    const int64_t jerk = either(in_unit(settings->jerk_rpm_s2, exponent, PER_RPM_S2), fixed_divide(up, 5));
    return profile_limits(smaller(either(speed, speed_max), speed_max), up, down, jerk);
}

COLD static void set_scales(const position_settings_t *settings, position_law_t *law) {
    const int64_t per_q16 = per_speed_q16(settings);
    const int64_t rate_per_tick = settings->control_rate_hz / PROFILE_TICK_HZ;
    /* To speed: 2^16 / per_q16. To torque: the speed that an acceleration adds in a period, by an LSB's. */
    law->speed_of = profile_scale_of(INT64_C(1) << 16, per_q16);
    law->gain = profile_scale_of((int64_t)fixed_max(settings->gain_1_s, 1) << 16, per_q16 * PROFILE_TICK_HZ);
    law->torque_of =
        profile_scale_of(INT64_C(1) << 32, (per_q16 >> 8) * ((int64_t)settings->acceleration_q32 * rate_per_tick >> 8));
}

COLD static position_cycle_t cycle_of(int64_t cycle_ms) {
    const int64_t ticks = fixed_clamp_64(cycle_ms, 1, POSITION_CYCLE_TICKS_MAX);
    return (position_cycle_t){
        .ticks = (uint32_t)ticks,
        .half_per_ticks = profile_scale_of(1, 2 * ticks),
        .half_per_ticks2 = profile_scale_of(1, 2 * ticks * ticks),
        .half_per_ticks3 = profile_scale_of(1, 2 * ticks * ticks * ticks),
    };
}

COLD position_parameters_t position_configure(const position_settings_t *settings) {
    const int64_t edge = POSITION_MAX << (PROFILE_FRACTION_BITS - 32);
    const uint32_t periods = settings->control_rate_hz / PROFILE_TICK_HZ;
    position_parameters_t position = {
        .law =
            {
                .periods_per_tick = periods,
                .part_per_period_q32 = UINT32_MAX / periods,
                .per_speed_q16 = per_speed_q16(settings),
                .window = fixed_divide(settings->window_q15 * (REV >> 15), 360),
                .following_error = fixed_divide(settings->following_error_q7 * (REV >> 7), 360),
                .homing_speed = in_unit(settings->homing_speed_rpm, settings->speed_exponent, PER_RPM_Q8) >> 8,
                .homing_torque_q24 =
                    settings->homing_torque_q24 > 0 ? settings->homing_torque_q24 : settings->torque_max_q24 / 4,
            },
        .plan =
            {
                .speed_exponent = settings->speed_exponent,
                .lowest = fixed_clamp_64(settings->lowest_rev * REV, -edge, edge),
                .highest = fixed_clamp_64(settings->highest_rev * REV, -edge, edge),
                .acceleration_max = acceleration_by_torque(settings) / 4 * 3,
                .cycle = cycle_of(settings->cycle_ms),
                .limits = limits_from(settings),
            },
    };
    position_plan_t *plan = &position.plan;
    plan->highest = plan->highest > plan->lowest ? plan->highest : plan->lowest;
    set_scales(settings, &position.law);
    return position;
}

/* 2^-48 rev from 2^-32 rev, within the end stops of the parameters. */
COLD static int64_t within(const position_parameters_t *parameters, int64_t position) {
    const int64_t limited = fixed_clamp_64(position, -POSITION_MAX, POSITION_MAX);
    return fixed_clamp_64(limited * (1 << (PROFILE_FRACTION_BITS - 32)), parameters->plan.lowest,
                          parameters->plan.highest);
}

/* Acceleration by 3/4 of the largest torque, of an inertia that exceeds the parameter by more than an eighth; by what
 * is left of the torque, when that is less. */
COLD static int64_t acceleration_left(const position_parameters_t *parameters, int32_t ratio_q14,
                                      int32_t torque_left_q14) {
    const int32_t left_q14 = fixed_clamp(torque_left_q14, USED_Q14 / 8, USED_Q14);
    if (ratio_q14 <= RATIO_LARGE_Q14 && left_q14 == USED_Q14) {
        return INT64_MAX;
    }
    const int64_t unit = fixed_divide(parameters->plan.acceleration_max, USED_Q14);
    const int64_t most = parameters->plan.acceleration_max - unit * (USED_Q14 - left_q14);
    return fixed_divide(most, fixed_max(ratio_q14, RATIO_MIN_Q14)) << 14;
}

COLD position_command_t position_command(const position_parameters_t *parameters, const position_set_point_t *set_point,
                                         int32_t inertia_ratio_q14, int32_t torque_left_q14) {
    position_command_t command = {
        .set_point = *set_point,
        .limits = parameters->plan.limits,
        .cycle = set_point->cycle_ms > 0 ? cycle_of(set_point->cycle_ms) : parameters->plan.cycle,
        .lowest = parameters->plan.lowest,
        .highest = parameters->plan.highest,
        .inertia_ratio_q14 = fixed_clamp(inertia_ratio_q14, 0, RATIO_MAX_Q14),
    };
    if (set_point->bounded) {
        command.lowest = within(parameters, set_point->lowest);
        command.highest = within(parameters, set_point->highest);
    }
    const int64_t most_acceleration = acceleration_left(parameters, command.inertia_ratio_q14, torque_left_q14);
    if (most_acceleration < INT64_MAX || set_point->speed_q22 > 0 || set_point->acceleration_rpm_s > 0 ||
        set_point->deceleration_rpm_s > 0 || set_point->jerk_rpm_s2 > 0) {
        const profile_limits_t *most = &parameters->plan.limits;
        const unsigned exponent = parameters->plan.speed_exponent;
        const int64_t speed = saturated(fixed_max(set_point->speed_q22, 0) >> 4, parameters->law.per_speed_q16) >> 12;
        const int64_t up = in_unit(set_point->acceleration_rpm_s, exponent, PER_RPM_S);
        const int64_t down = in_unit(set_point->deceleration_rpm_s, exponent, PER_RPM_S);
        const int64_t jerk = in_unit(set_point->jerk_rpm_s2, exponent, PER_RPM_S2);
        const int64_t most_up = smaller(most->acceleration, most_acceleration);
        const int64_t most_down = smaller(most->deceleration, most_acceleration);
        command.limits = profile_limits(
            smaller(either(speed, most->speed), most->speed), smaller(either(up, most->acceleration), most_up),
            smaller(either(down, most->deceleration), most_down), smaller(either(jerk, 6 * most->q), 6 * most->q));
    }
    return command;
}
