// Profile of a position reference: its limits from any state, its exact end, its time beside the least possible.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/position/profile.h"
}

namespace {

constexpr double REV = 281474976710656.0; // 2^48
constexpr double COUNT_17_BITS = REV / 131072.0;
constexpr int PERIODS = 20;
constexpr int64_t NOTHING = 1 << 14; // 2^-34 rev: an end is made exact

// Limits in rev, s.
struct motion_t {
    double speed, acceleration, deceleration, jerk;
};

profile_limits_t limits_of(const motion_t &motion) {
    return profile_limits(int64_t(motion.speed * REV * 1e-3), int64_t(motion.acceleration * REV * 1e-6),
                          int64_t(motion.deceleration * REV * 1e-6), int64_t(motion.jerk * REV * 1e-9));
}

int64_t smaller_acceleration(const profile_limits_t &limits) {
    return std::min(limits.acceleration, limits.deceleration);
}

void tick(const profile_limits_t &limits, profile_t *profile, int64_t target, int periods = PERIODS) {
    for (int i = 0; i < periods; i++) {
        profile_search(&limits, profile, target);
    }
    profile_tick(profile);
}

// Ticks of an S-curve from rest to rest, time-optimal (Biagiotti, Melchiorri, "Trajectory Planning for Automatic
// Machines and Robots", 2008, 3.4), by bisection over its largest speed.
double least_ticks(double way, const profile_limits_t &limits) {
    const double jerk = 6.0 * double(limits.q);
    const auto ramp = [&](double speed, double most) {
        return speed >= most * most / jerk ? speed / most + most / jerk : 2.0 * std::sqrt(speed / jerk);
    };
    const auto both = [&](double speed) {
        return ramp(speed, double(limits.acceleration)) + ramp(speed, double(limits.deceleration));
    };
    double low = 0.0, high = double(limits.speed);
    if (high / 2.0 * both(high) <= way) {
        return both(high) + (way - high / 2.0 * both(high)) / high;
    }
    for (int i = 0; i < 100; i++) {
        const double middle = (low + high) / 2.0;
        (middle / 2.0 * both(middle) > way ? high : low) = middle;
    }
    return both(low);
}

// Where a stop ends, integrated: jerk that takes the acceleration to -D, then to 0 with the speed, in steps of 1/1000.
double integrated_stop(const profile_limits_t &limits, const profile_state_t &from) {
    const double deceleration = double(limits.deceleration) * PROFILE_DECELERATION_PARTS / 32.0;
    const double jerk = 6.0 * double(limits.q) * PROFILE_JERK_PARTS / 32.0, step = 1e-3;
    double x = double(from.x), v = double(from.v), a = double(from.a);
    const double sign = v + a * std::fabs(a) / (2.0 * jerk) >= 0.0 ? 1.0 : -1.0;
    v *= sign;
    a *= sign;
    double moved = 0.0;
    while (v > 0.0 || a > 0.0) {
        const bool releases = a < 0.0 && v <= a * a / (2.0 * jerk);
        const double next = releases ? std::min(0.0, a + jerk * step) : std::max(-deceleration, a - jerk * step);
        moved += v * step + (2.0 * a + next) / 6.0 * step * step;
        v += (a + next) / 2.0 * step;
        a = next;
        if (releases && a == 0.0) {
            break;
        }
    }
    return x + sign * moved;
}

const motion_t MOTIONS[] = {
    {16.0, 160.0, 160.0, 16e3}, {16.0, 160.0, 80.0, 8e3}, {50.0, 150.0, 300.0, 30e3},
    {8.0, 800.0, 800.0, 160e3}, {16.0, 5.0, 10.0, 16.0},  {0.5, 40.0, 40.0, 4e3},
};

TEST(PositionProfile, moves_end_exactly_within_five_ticks_and_five_hundredths_of_the_least_time_and_pass_no_target) {
    for (const motion_t &motion : MOTIONS) {
        const profile_limits_t limits = limits_of(motion);
        for (const double way_rev : {1.0 / 3600.0, 1.0 / 360.0, 1.0 / 36.0, 0.25, 1.0, 10.0}) {
            for (const double sign : {1.0, -1.0}) {
                const int64_t target = int64_t(sign * way_rev * REV);
                const double least = least_ticks(way_rev * REV, limits);
                profile_t profile;
                profile_begin(&profile, 0);
                int64_t beyond = 0;
                int ticks = 0;
                while (!profile_arrived(&profile, target) && ticks < 2.0 * least + 100.0) {
                    tick(limits, &profile, target);
                    for (uint32_t part = 0; part < 16; part++) {
                        const profile_state_t state = profile_at(&profile, part << 12);
                        beyond = std::max(beyond, int64_t(sign) * (state.x - target));
                    }
                    ticks++;
                }
                ASSERT_TRUE(profile_arrived(&profile, target)) << way_rev << " " << motion.jerk;
                EXPECT_LE(ticks, 1.05 * least + 5.0) << way_rev << " " << motion.jerk;
                // A part of the jerk's way in a tick: its switch within one is missed.
                EXPECT_LE(double(beyond), COUNT_17_BITS / 10.0 + double(limits.q) / 2.0)
                    << way_rev << " " << motion.jerk;
                tick(limits, &profile, target);
                EXPECT_TRUE(profile_arrived(&profile, target));
            }
        }
    }
}

TEST(PositionProfile, targets_and_limits_that_change_at_random_cause_no_step_of_acceleration_and_exceed_no_limit) {
    std::mt19937 random(1);
    const auto draw = [&](double low, double high) {
        return std::uniform_real_distribution<double>(low, high)(random);
    };
    for (int run = 0; run < 150; run++) {
        const double acceleration = std::pow(10.0, draw(1.0, 3.5));
        const double deceleration = acceleration * std::pow(2.0, draw(-1.0, 1.0));
        const motion_t motion{std::pow(10.0, draw(0.0, 1.7)), acceleration, deceleration,
                              std::min(acceleration, deceleration) * 1e3 / std::pow(10.0, draw(0.7, 2.3))};
        const profile_limits_t limits = limits_of(motion);
        const int64_t most = std::max(limits.acceleration, limits.deceleration);
        profile_t profile;
        profile_begin(&profile, 0);
        int64_t target = 0;
        for (int k = 0; k < 1500; k++) {
            target = random() % 60 ? target : int64_t(draw(-1.0, 1.0) * std::pow(10.0, draw(-4.0, 2.0)) * REV);
            const profile_state_t before = profile.end;
            tick(limits, &profile, target);
            ASSERT_LE(std::abs(profile.start.x - before.x), NOTHING);
            ASSERT_LE(std::abs(profile.start.v - before.v), NOTHING);
            ASSERT_LE(std::abs(profile.start.a - before.a), NOTHING);
            ASSERT_LE(std::abs(profile.end.a - before.a), 6 * limits.q);
            ASSERT_LE(std::abs(profile.end.a), most + most / 10000);
            ASSERT_LE(std::abs(profile.end.v), limits.speed + limits.speed / 1000);
        }
    }
}

TEST(PositionProfile, lower_limits_in_a_move_are_reached_by_the_jerk_and_the_end_stays_exact) {
    const profile_limits_t fast = limits_of({30.0, 300.0, 300.0, 20e3}), slow = limits_of({5.0, 50.0, 50.0, 20e3});
    const int64_t target = int64_t(20.0 * REV);
    profile_t profile;
    profile_begin(&profile, 0);
    for (int k = 0; k < 60; k++) {
        tick(fast, &profile, target);
    }
    ASSERT_GT(profile.end.v, slow.speed);
    int ticks = 0;
    for (; !profile_arrived(&profile, target) && ticks < 10000; ticks++) {
        const int64_t before = profile.end.a;
        tick(slow, &profile, target);
        ASSERT_LE(std::abs(profile.end.a - before), 6 * slow.q);
        if (ticks > 1000) {
            ASSERT_LE(profile.end.v, slow.speed);
        }
    }
    EXPECT_TRUE(profile_arrived(&profile, target));
}

// The last three ticks have jerks of their own; a state that is too fast for them passes the target first.
TEST(PositionProfile, from_any_speed_and_acceleration_at_the_target_it_ends_there_exactly_within_its_limits) {
    const int64_t most = INT64_C(1) << 49, near = INT64_C(1) << 46;
    const profile_limits_t limits = profile_limits(most, most, most, most);
    const int64_t target = INT64_C(1) << 50;
    for (const int64_t v : {INT64_C(0), 2 * near, -2 * near}) {
        for (const int64_t a : {INT64_C(0), 2 * near, -2 * near}) {
            profile_t profile;
            profile_begin_moving(&profile, target - v, v);
            profile.end.a = a;
            int ticks = 0;
            for (; (ticks == 0 || !profile_arrived(&profile, target)) && ticks < 300; ticks++) {
                const int64_t before = profile.end.a;
                tick(limits, &profile, target);
                ASSERT_LE(std::abs(profile.end.a - before), 6 * limits.q) << v << ' ' << a;
                ASSERT_LE(std::abs(profile.end.v), limits.speed) << v << ' ' << a;
            }
            EXPECT_TRUE(profile_arrived(&profile, target)) << v << ' ' << a;
            EXPECT_EQ(ticks > 3, v != 0 || a != 0) << v << ' ' << a;
        }
    }
}

TEST(PositionProfile, so_near_that_each_of_the_three_is_nothing_it_is_at_the_target_and_with_one_beyond_it_is_not) {
    const profile_limits_t limits = limits_of({16.0, 160.0, 160.0, 16e3});
    const int64_t target = INT64_C(1) << 40;
    for (const int64_t sign : {1, -1}) {
        for (int more = 0; more < 4; more++) { // which of the three is larger by one; the last: none
            profile_t profile;
            profile_begin(&profile, target);
            profile.end = {target + sign * (NOTHING + (more == 0)), sign * (NOTHING + (more == 1)),
                           sign * (NOTHING + (more == 2))};
            const profile_state_t before = profile.end;
            tick(limits, &profile, target);
            EXPECT_EQ(profile.start.x, more == 3 ? target : before.x) << more;
            EXPECT_EQ(profile.start.v, more == 3 ? 0 : before.v) << more;
            EXPECT_EQ(profile.start.a, more == 3 ? 0 : before.a) << more;
            for (int k = 0; k < 8; k++) {
                tick(limits, &profile, target);
            }
            EXPECT_TRUE(profile_arrived(&profile, target)) << more;
        }
    }
}

TEST(PositionProfile, stop_is_where_an_integration_ends) {
    std::mt19937 random(2);
    const auto draw = [&](double low, double high) {
        return std::uniform_real_distribution<double>(low, high)(random);
    };
    for (const motion_t &motion : MOTIONS) {
        const profile_limits_t limits = limits_of(motion);
        for (int k = 0; k < 20; k++) {
            const profile_state_t state = {.x = int64_t(draw(-1.0, 1.0) * REV),
                                           .v = int64_t(draw(-1.0, 1.0) * double(limits.speed)),
                                           .a = int64_t(draw(-0.9, 0.9) * double(smaller_acceleration(limits)))};
            const double expected = integrated_stop(limits, state);
            const double way = std::fabs(expected - double(state.x));
            EXPECT_NEAR(double(profile_stop(&limits, &state)), expected,
                        way * 1e-3 + double(smaller_acceleration(limits)) * 0.05 + 2.0 * double(limits.q))
                << motion.jerk << " " << state.v << " " << state.a;
        }
    }
}

TEST(PositionProfile, within_a_tick_it_leads_from_its_begin_to_its_end) {
    const profile_limits_t limits = limits_of({16.0, 160.0, 160.0, 16e3});
    profile_t profile;
    profile_begin(&profile, 0);
    for (int k = 0; k < 200; k++) {
        tick(limits, &profile, int64_t(2.0 * REV));
        const profile_state_t begin = profile_at(&profile, 0), end = profile_at(&profile, 65535);
        ASSERT_EQ(begin.x, profile.start.x);
        ASSERT_EQ(begin.v, profile.start.v);
        const double part = 65535.0 / 65536.0;
        ASSERT_NEAR(double(end.a), double(profile.start.a) + 6.0 * double(profile.q) * part, 2.0);
        ASSERT_NEAR(double(end.v),
                    double(profile.start.v) + double(profile.start.a) * part + 3.0 * double(profile.q) * part * part,
                    16.0);
        ASSERT_NEAR(double(end.x),
                    double(profile.start.x) + double(profile.start.v) * part +
                        double(profile.start.a) / 2.0 * part * part + double(profile.q) * part * part * part,
                    32.0);
    }
}

TEST(PositionProfile, ticks_without_their_periods_keep_the_acceleration_and_it_ends_nonetheless) {
    const profile_limits_t limits = limits_of({16.0, 160.0, 160.0, 16e3});
    const int64_t target = int64_t(3.0 * REV);
    std::mt19937 random(3);
    profile_t profile;
    profile_begin(&profile, 0);
    int ticks = 0;
    for (; !profile_arrived(&profile, target) && ticks < 5000; ticks++) {
        const int64_t before = profile.end.a;
        tick(limits, &profile, target, random() % 20 ? PERIODS : int(random() % 10));
        ASSERT_LE(std::abs(profile.end.a - before), 6 * limits.q);
    }
    EXPECT_TRUE(profile_arrived(&profile, target));
}

TEST(PositionProfile, any_limits_and_targets_stay_within_the_formats) {
    const int64_t extremes[] = {INT64_MIN, -1, 0, 1, 1000, INT64_C(1) << 30, INT64_C(1) << 49, INT64_MAX};
    for (const int64_t speed : extremes) {
        for (const int64_t acceleration : extremes) {
            for (const int64_t jerk : extremes) {
                const profile_limits_t limits = profile_limits(speed, acceleration, acceleration, jerk);
                EXPECT_GT(limits.speed, 0);
                EXPECT_LE(limits.speed, PROFILE_SPEED_MAX);
                EXPECT_GE(limits.q, PROFILE_Q_MIN);
                profile_t profile;
                profile_begin(&profile, -(INT64_C(1) << 61));
                for (int k = 0; k < 20; k++) {
                    tick(limits, &profile, k < 10 ? INT64_C(1) << 61 : -(INT64_C(1) << 61));
                    EXPECT_LE(std::abs(profile.end.v), PROFILE_SPEED_MAX + PROFILE_SPEED_MAX / 8);
                }
            }
        }
    }
}

TEST(PositionProfile, scales_are_their_quotients) {
    std::mt19937_64 random(4);
    for (int k = 0; k < 2000; k++) {
        const int64_t denominator = int64_t(random() >> (1 + random() % 40)) + 4;
        const int64_t numerator =
            std::max<int64_t>(1, int64_t(double(denominator) * std::ldexp(1.0, -2 - int(random() % 28))));
        const int64_t value = int64_t(random() >> 2) - (INT64_C(1) << 61);
        const double expected = double(value) * (double(numerator) / double(denominator));
        EXPECT_NEAR(double(profile_scale(value, profile_scale_of(numerator, denominator))), expected,
                    std::fabs(expected) * 2e-9 + 1.0);
    }
}

} // namespace
