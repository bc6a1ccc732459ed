/* Profile: a reference that moves to a target within limits of speed, acceleration, deceleration and jerk.
 *
 * The reference is a triple integrator with a constant jerk in each tick of 1 ms. From each state there is one place
 * where it would come to rest if it stopped now, as fast as deceleration D and jerk J allow: with s the sign of
 * v + a |a| / 2J, the speed that is left once the acceleration has been taken away,
 *
 *   stop = x + s a v / J + a^3 / 3J^2 + s d(w),   w = |v + s a^2 / 2J|,
 *   d(w) = w / 2 (w / D + D / J) from w = D^2 / J on, below w sqrt(w / J)
 *
 * (derived here: the stop is a part of the S-curve from the speed w to rest, which began or will begin without
 * acceleration). It grows with the jerk of the coming tick, and so does the place where a reference that brakes too
 * much for its speed turns. So the largest jerk, with which neither is beyond the target, and the speed not beyond its
 * limit, is found by bisection, one step in each control period; it accelerates, holds the speed and brakes at the
 * right times, from any state, and a target or limit that changes needs nothing else: the acceleration has no step. It
 * is time-optimal but for the ticks, and for PROFILE_MARGIN of deceleration and jerk that the plan leaves to make up
 * for a switch within a tick.
 *
 * The last three ticks follow a deadbeat law, the three jerks that bring a triple integrator to rest at the
 * target exactly, as soon as they are within the limits.
 *
 * Units: positions 2^-48 rev, of the target; speeds 2^-48 rev per tick; accelerations 2^-48 rev per tick^2; q, a sixth
 * of the jerk, 2^-48 rev per tick^3, with which a tick is exact in integers:
 *
 *   x += v + a / 2 + q,   v += a + 3 q,   a += 6 q
 *
 * Ranges: |x| <= 2^62 (16384 rev), |v| <= PROFILE_SPEED_MAX, |a| <= PROFILE_SPEED_MAX; sums fit 64 bits.
 */
#ifndef CONTROL_POSITION_PROFILE_H
#define CONTROL_POSITION_PROFILE_H

#include <stdbool.h>
#include <stdint.h>

#define PROFILE_TICK_HZ 1000
#define PROFILE_FRACTION_BITS 48

/* 2 rev per tick, 120,000 r/min. */
#define PROFILE_SPEED_MAX (INT64_C(1) << 49)
#define PROFILE_POSITION_MAX (INT64_C(1) << 62)

/* Least jerk, 5.6 rev/s^3; least and most ticks in which the acceleration rises, but for the least jerk. */
#define PROFILE_Q_MIN (INT64_C(1) << 18)
#define PROFILE_RAMP_TICKS_MIN 4
#define PROFILE_RAMP_TICKS_MAX 4096

/* Part of deceleration and jerk that the plan uses: 31/32 and 29/32. */
#define PROFILE_MARGIN_SHIFT 5
#define PROFILE_DECELERATION_PARTS 31
#define PROFILE_JERK_PARTS 29

/* Periods in which the jerk of the next tick is found. After fewer, as of a drive that skips periods, the acceleration
 * is kept for a tick. */
#define PROFILE_SEARCH_STEPS 17

/* value * factor / 2^(32 + shift), shift 0..31. */
typedef struct {
    uint32_t factor;
    uint32_t shift;
} profile_scale_t;

/* Derived by profile_limits(). */
typedef struct {
    int64_t speed;                    /* > 0 */
    int64_t acceleration;             /* > 0 */
    int64_t deceleration;             /* > 0 */
    int64_t q;                        /* >= PROFILE_Q_MIN */
    int64_t ramp_speed;               /* D^2 / J of the plan */
    uint32_t ramp_time_q16;           /* D / J of the plan, ticks */
    profile_scale_t per_jerk;         /* 2^16 / J of the plan: acceleration to ticks, Q16 */
    profile_scale_t per_deceleration; /* 2^16 / D of the plan: speed to ticks, Q16 */
} profile_limits_t;

typedef struct {
    int64_t x, v, a;
} profile_state_t;

/* All zero: at rest at 0. */
typedef struct {
    profile_state_t start; /* of the present tick */
    profile_state_t end;   /* of the present tick */
    int64_t q;             /* in the present tick */
    int64_t low, high;     /* bounds of the next one, from step 1 of the search on */
    uint32_t steps;        /* of the search */
    bool settled;          /* low is the result */
} profile_t;

/* Limits from speed, acceleration, deceleration and jerk per tick, any values: limited to their ranges. 64-bit
 * divisions by fixed_divide. [background] */
profile_limits_t profile_limits(int64_t speed, int64_t acceleration, int64_t deceleration, int64_t jerk);

/* value * factor / 2^(32 + shift), |value| < 2^63, rounded towards zero; magnitude below 2^63. */
int64_t profile_scale(int64_t value, profile_scale_t scale);

/* Scale by numerator / denominator, both > 0 and a quotient of 2^-63 to 2^-1; within 2^-31 of it. [background] */
profile_scale_t profile_scale_of(int64_t numerator, int64_t denominator);

/* value * time / 2^16, rounded towards zero, saturated to +-2^60. */
int64_t profile_by_q16(int64_t value, uint32_t time_q16);

/* State after a tick with q. */
profile_state_t profile_advance(const profile_state_t *state, int64_t q);

/* Where a stop would end, within 2^-14 of the way to it. */
int64_t profile_stop(const profile_limits_t *limits, const profile_state_t *state);

/* Begins at rest at a position. */
void profile_begin(profile_t *profile, int64_t x);

/* Begins with a speed and without an acceleration. */
void profile_begin_moving(profile_t *profile, int64_t x, int64_t v);

/* One step of the search for the jerk of the next tick, one evaluation of the stop. */
void profile_search(const profile_limits_t *limits, profile_t *profile, int64_t target);

/* The next tick begins. */
void profile_tick(profile_t *profile);

/* State at a part of the present tick, Q16, 0..65535: x rounded to 2^-46 rev. */
profile_state_t profile_at(const profile_t *profile, uint32_t part_q16);

/* At rest at the target, now and at the end of the tick. */
static inline bool profile_arrived(const profile_t *profile, int64_t target) {
    return profile->start.x == target && profile->start.v == 0 && profile->start.a == 0 && profile->q == 0;
}

#endif
