#include "control/position/profile.h"

#include "fixed/compiler.h"
#include "fixed/divide.h"
#include "fixed/fixed.h"

#define SATURATED (INT64_C(1) << 60)
#define TIME_MAX_Q16 (1u << 30) /* 16384 ticks */
#define THIRD_Q16 21845u
#define SIXTH_Q16 10922u

/* 1 / 36 by 2^36. */
#define PER_36_Q36 1908874354u

/* Distance from the target, speed and acceleration below which the reference is there: 2^-34 rev. */
#define NOTHING (INT64_C(1) << 14)

/* Furthest from the target, for which the deadbeat law is tried: 1/4 rev, so that its sums fit. */
#define NEAR (INT64_C(1) << 46)

static uint64_t magnitude(int64_t value) {
    return value < 0 ? 0 - (uint64_t)value : (uint64_t)value;
}

static int64_t with_sign(uint64_t value, int64_t sign) {
    return sign < 0 ? -(int64_t)value : (int64_t)value;
}

/* Not inlined, as the next ones, which have many callers: 64-bit products are long. */
NOINLINE int64_t profile_scale(int64_t value, profile_scale_t scale) {
    const uint64_t of = magnitude(value);
    const uint64_t product = (of >> 32) * scale.factor + ((uint32_t)of * (uint64_t)scale.factor >> 32);
    return with_sign(product >> (scale.shift & 31u), value);
}

/* Shift that gives a positive value 32 bits; negative: to the right. */
static int normalising_shift(int64_t value) {
    return __builtin_clzll((uint64_t)value) - 32;
}

static uint64_t shifted(int64_t value, int shift) {
    return shift >= 0 ? (uint64_t)value << shift : (uint64_t)value >> -shift;
}

COLD NOINLINE profile_scale_t profile_scale_of(int64_t numerator, int64_t denominator) {
    const int up = normalising_shift(numerator), down = normalising_shift(denominator);
    const uint64_t above = shifted(numerator, up), below = shifted(denominator, down);
    const int64_t factor = fixed_divide((int64_t)(above << 31), (int64_t)below); /* 2^30 to 2^32 - 1 */
    const int32_t shift = fixed_clamp(up - down - 1, 0, 31);
    return (profile_scale_t){.factor = (uint32_t)factor, .shift = (uint32_t)shift};
}

NOINLINE int64_t profile_by_q16(int64_t value, uint32_t time_q16) {
    const uint64_t of = magnitude(value);
    const uint64_t high = (of >> 32) * time_q16;
    if (high >> 43 != 0) {
        return with_sign(SATURATED, value);
    }
    return with_sign((high << 16) + ((uint32_t)of * (uint64_t)time_q16 >> 16), value);
}

COLD NOINLINE profile_limits_t profile_limits(int64_t speed, int64_t acceleration, int64_t deceleration, int64_t jerk) {
    const int64_t least = PROFILE_Q_MIN * 6 * PROFILE_RAMP_TICKS_MIN;
    const int64_t up = fixed_clamp_64(acceleration, least, PROFILE_SPEED_MAX);
    const int64_t down = fixed_clamp_64(deceleration, least, PROFILE_SPEED_MAX);
    const int64_t smaller = up < down ? up : down;
    const int64_t q_max = fixed_divide(smaller, 6 * PROFILE_RAMP_TICKS_MIN);
    const int64_t q_min = fixed_divide(up < down ? down : up, 6 * PROFILE_RAMP_TICKS_MAX);
    const int64_t q =
        fixed_clamp_64(fixed_divide(jerk < 0 ? 0 : jerk, 6), q_min > PROFILE_Q_MIN ? q_min : PROFILE_Q_MIN, q_max);
    const int64_t plan_down = (down >> PROFILE_MARGIN_SHIFT) * PROFILE_DECELERATION_PARTS;
    const int64_t plan_jerk = (6 * q >> PROFILE_MARGIN_SHIFT) * PROFILE_JERK_PARTS;
    const profile_scale_t per_jerk = profile_scale_of(INT64_C(1) << 16, plan_jerk);
    const int64_t ramp_time_q16 = fixed_clamp_64(profile_scale(plan_down, per_jerk), 0, TIME_MAX_Q16);
    return (profile_limits_t){
        .speed = fixed_clamp_64(speed, 1, PROFILE_SPEED_MAX),
        .acceleration = up,
        .deceleration = down,
        .q = q,
        .ramp_speed = profile_by_q16(plan_down, (uint32_t)ramp_time_q16),
        .ramp_time_q16 = (uint32_t)ramp_time_q16,
        .per_jerk = per_jerk,
        .per_deceleration = profile_scale_of(INT64_C(1) << 16, plan_down),
    };
}

NOINLINE static uint32_t time_q16(int64_t value, profile_scale_t per) {
    const uint64_t time = magnitude(profile_scale(value, per));
    return time < TIME_MAX_Q16 ? (uint32_t)time : TIME_MAX_Q16;
}

/* Rounded down. */
static uint32_t square_root(uint32_t value) {
    uint32_t root = 0, bit = UINT32_C(1) << 30;
    for (unsigned i = 0; i < 16; i++) {
        const uint32_t trial = root + bit;
        root >>= 1;
        if (value >= trial) {
            value -= trial;
            root += bit;
        }
        bit >>= 2;
    }
    return root;
}

/* sqrt(value), Q16 of Q16, within 2^-14: with at least 30 bits under the root. */
static uint32_t root_q16(uint64_t value_q16) {
    if (value_q16 == 0) {
        return 0;
    }
    const int up = (__builtin_clzll(value_q16) & ~1) - 32;                        /* even */
    const uint32_t root = square_root((uint32_t)shifted((int64_t)value_q16, up)); /* Q(8 + up / 2) */
    const int shift = 8 - up / 2;
    return shift >= 0 ? root << shift : root >> -shift;
}

/* d(w); w >= 0. */
static int64_t stopping_distance(const profile_limits_t *limits, int64_t speed) {
    if (speed >= limits->ramp_speed) {
        const uint32_t braking_q16 = time_q16(speed, limits->per_deceleration);
        return profile_by_q16(speed, braking_q16 + limits->ramp_time_q16) >> 1;
    }
    return profile_by_q16(speed, root_q16(magnitude(profile_scale(speed, limits->per_jerk))));
}

/* a^2 / 2J. */
static int64_t speed_of_ramp(int64_t a, uint32_t time_q16) {
    return profile_by_q16(a < 0 ? -a : a, time_q16) >> 1;
}

NOINLINE int64_t profile_stop(const profile_limits_t *limits, const profile_state_t *state) {
    const uint32_t time = time_q16(state->a, limits->per_jerk);
    const int64_t ramp = speed_of_ramp(state->a, time);
    const bool forward = state->v + (state->a < 0 ? -ramp : ramp) >= 0;
    const int64_t left = forward ? state->v + ramp : ramp - state->v; /* >= 0 on either side */
    const int64_t distance = stopping_distance(limits, left);
    const int64_t coming = profile_by_q16(state->v, time);
    const int64_t cubic = profile_by_q16(profile_by_q16(profile_by_q16(state->a, time), time), THIRD_Q16);
    const int64_t ramped = (state->a < 0) == forward ? -coming : coming;
    return state->x + ramped + cubic + (forward ? distance : -distance);
}

NOINLINE profile_state_t profile_advance(const profile_state_t *state, int64_t q) {
    return (profile_state_t){
        .x = state->x + state->v + (state->a >> 1) + q,
        .v = state->v + state->a + 3 * q,
        .a = state->a + 6 * q,
    };
}

NOINLINE void profile_begin_moving(profile_t *profile, int64_t x, int64_t v) {
    *profile = (profile_t){.start = {.x = x, .v = v}, .end = {.x = x, .v = v}};
    profile->end.x += v;
}

void profile_begin(profile_t *profile, int64_t x) {
    profile_begin_moving(profile, x, 0);
}

/* Jerk of the deadbeat law, rounded to nearest or away from 0 by an LSB. */
NOINLINE static int64_t deadbeat_q(const profile_state_t *state, int64_t target) {
    const int64_t sum = 6 * (state->x - target) + 12 * state->v + 11 * state->a;
    return -profile_scale(sum, (profile_scale_t){.factor = PER_36_Q36, .shift = 4});
}

static bool within(int64_t value, int64_t limit) {
    return value >= -limit && value <= limit;
}

/* True when the deadbeat law keeps the limits from here on; then it is the result. */
static bool ends_here(const profile_limits_t *limits, profile_t *profile, int64_t target) {
    profile_state_t state = profile->end;
    const int64_t far = state.x - target;
    if (!within(far, NEAR) || !within(state.v, NEAR) || !within(state.a, NEAR)) {
        return false;
    }
    if (within(far, NOTHING) && within(state.v, NOTHING) && within(state.a, NOTHING)) {
        profile->end = (profile_state_t){.x = target};
        profile->low = 0;
        return true;
    }
    const int64_t acceleration_max =
        limits->acceleration < limits->deceleration ? limits->acceleration : limits->deceleration;
    profile->low = deadbeat_q(&state, target);
    for (unsigned tick = 0; tick < 3; tick++) {
        const int64_t q = deadbeat_q(&state, target);
        state = profile_advance(&state, q);
        if (!within(q, limits->q) || !within(state.a, acceleration_max) || !within(state.v, limits->speed)) {
            return false;
        }
    }
    return true;
}

/* Beyond the bounds of the acceleration, as after they have been reduced, the jerk leads back. */
static void begin_search(const profile_limits_t *limits, profile_t *profile, int64_t target) {
    profile->settled = ends_here(limits, profile, target);
    if (profile->settled) {
        return;
    }
    const profile_state_t *state = &profile->end;
    const int64_t most = state->v >= 0 ? limits->acceleration : limits->deceleration;
    const int64_t least = state->v >= 0 ? -limits->deceleration : -limits->acceleration;
    profile->high = fixed_clamp_64(profile_by_q16(most - state->a, SIXTH_Q16), -limits->q, limits->q);
    profile->low = fixed_clamp_64(profile_by_q16(least - state->a, SIXTH_Q16), -limits->q, profile->high);
}

/* Where the reference stands first, when it moves towards the target and brakes so much that it would turn before it
 * ends: x + s (v t - |a| t^2 / 2 + J t^3 / 6), t = T - sqrt(T^2 - 2 |v| / J), T = |a| / J. Else where it ends. */
NOINLINE static int64_t first_stop(const profile_limits_t *limits, const profile_state_t *state, int64_t target) {
    const bool forward = state->v > 0;
    const bool approaches = forward ? state->x < target && state->a < 0 : state->x > target && state->a > 0;
    const int64_t v = (int64_t)magnitude(state->v), a = (int64_t)magnitude(state->a);
    const uint32_t ramp_q16 = time_q16(a, limits->per_jerk);
    if (!approaches || state->v == 0 || speed_of_ramp(a, ramp_q16) <= v) {
        return profile_stop(limits, state);
    }
    const uint64_t all_q16 = (uint64_t)ramp_q16 * ramp_q16 >> 16,
                   spent_q16 = 2 * (uint64_t)time_q16(v, limits->per_jerk);
    const uint32_t left_q16 = root_q16(all_q16 > spent_q16 ? all_q16 - spent_q16 : 0);
    const uint32_t t_q16 = ramp_q16 > left_q16 ? ramp_q16 - left_q16 : 0;
    const int64_t jerk = (6 * limits->q >> PROFILE_MARGIN_SHIFT) * PROFILE_JERK_PARTS;
    const int64_t sixth = profile_by_q16(profile_by_q16(jerk, t_q16), SIXTH_Q16);
    const int64_t way = profile_by_q16(v - profile_by_q16((a >> 1) - sixth, t_q16), t_q16);
    return state->x + (forward ? way : -way);
}

/* True when the jerk makes the reference too fast forwards, or end beyond the target, or pass it. */
static bool too_high(const profile_limits_t *limits, const profile_t *profile, int64_t q, int64_t target) {
    const profile_state_t next = profile_advance(&profile->end, q);
    const int64_t ramp = speed_of_ramp(next.a, time_q16(next.a, limits->per_jerk));
    if (next.v + (next.a > 0 ? ramp : 0) > limits->speed) {
        return true;
    }
    if (next.v - (next.a < 0 ? ramp : 0) < -limits->speed) {
        return false;
    }
    return first_stop(limits, &next, target) > target;
}

NOINLINE void profile_search(const profile_limits_t *limits, profile_t *profile, int64_t target) {
    const uint32_t step = profile->steps;
    profile->steps++;
    if (step == 0) {
        begin_search(limits, profile, target);
    } else if (profile->settled || step >= PROFILE_SEARCH_STEPS) {
        profile->steps = step; /* nothing is left to do */
    } else if (step == 1) {
        if (!too_high(limits, profile, profile->high, target)) {
            profile->low = profile->high;
            profile->settled = true;
        }
    } else {
        const int64_t middle = profile->low + ((profile->high - profile->low) >> 1);
        if (too_high(limits, profile, middle, target)) {
            profile->high = middle;
        } else {
            profile->low = middle;
        }
    }
}

void profile_tick(profile_t *profile) {
    profile->start = profile->end;
    profile->q = profile->settled || profile->steps >= PROFILE_SEARCH_STEPS
                     ? profile->low
                     : fixed_clamp_64(0, profile->low, profile->high);
    profile->end = profile_advance(&profile->start, profile->q);
    profile->low = profile->high = 0;
    profile->steps = 0;
    profile->settled = false;
}

NOINLINE profile_state_t profile_at(const profile_t *profile, uint32_t part_q16) {
    const profile_state_t *from = &profile->start;
    const int64_t a = from->a + profile_by_q16(6 * profile->q, part_q16);
    const int64_t gained = profile_by_q16((from->a >> 1) + (a >> 1), part_q16);
    const int64_t curved = profile_by_q16((from->a >> 1) + profile_by_q16(profile->q, part_q16), part_q16);
    return (profile_state_t){
        .x = from->x + profile_by_q16(from->v + curved, part_q16),
        .v = from->v + gained,
        .a = a,
    };
}
