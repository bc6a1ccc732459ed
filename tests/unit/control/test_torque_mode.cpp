// Torque mode against a double-precision twin: slew rate, limits, reduction of the driving torque near over-speed.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/torque_mode.h"
}

#include "support/fixed_point.h"
#include "support/wide_integer.h"

namespace {

using namespace fixed_point;
constexpr uint32_t RATE_HZ = 40000;
constexpr double TORQUE_MAX_NM = 19.1;
const double OVER_SPEED_RAD_S = rad_s(3600.0);

torque_mode_parameters_t configured(double slew_rate_Nm_s, double torque_min_Nm = -TORQUE_MAX_NM,
                                    double torque_max_Nm = TORQUE_MAX_NM, double over_speed_rad_s = OVER_SPEED_RAD_S) {
    return torque_mode_configure(to_fixed(slew_rate_Nm_s, 1024.0), RATE_HZ, to_fixed(torque_min_Nm, Q24),
                                 to_fixed(torque_max_Nm, Q24), to_fixed(over_speed_rad_s, Q22));
}

// The law in double precision.
struct twin_t {
    double slew_Nm, min_Nm, max_Nm, over_speed_rad_s, torque_Nm = 0.0;

    double step(double commanded_Nm, double speed_rad_s) {
        torque_Nm += std::clamp(std::clamp(commanded_Nm, min_Nm, max_Nm) - torque_Nm, -slew_Nm, slew_Nm);
        const double room = (15.0 / 16.0 * over_speed_rad_s - std::fabs(speed_rad_s)) / (over_speed_rad_s / 16.0);
        const double driving_Nm = max_Nm * std::clamp(room, 0.0, 1.0);
        return speed_rad_s < 0.0 ? std::max(torque_Nm, -driving_Nm) : std::min(torque_Nm, driving_Nm);
    }
};

TEST(TorqueMode, follows_its_twin_over_random_commands_and_speeds) {
    std::mt19937 random(1);
    const auto draw = [&](double low, double high) {
        return std::uniform_real_distribution<double>(low, high)(random);
    };
    for (int drive = 0; drive < 200; drive++) {
        const double max_Nm = draw(0.01, 40.0), min_Nm = drive % 2 ? -max_Nm : 0.0;
        const double over_speed = rad_s(draw(10.0, 4800.0)), rate = drive % 4 ? std::exp(draw(0.0, 13.0)) : 0.0;
        const torque_mode_parameters_t parameters = configured(rate, min_Nm, max_Nm, over_speed);
        torque_mode_t mode{};
        twin_t twin{rate == 0.0 ? 1e9 : parameters.slew_q24 / Q24, min_Nm, max_Nm, over_speed};
        double commanded_Nm = 0.0;
        for (int k = 0; k < 500; k++) {
            commanded_Nm = k % 20 ? commanded_Nm : draw(-1.5 * max_Nm, 1.5 * max_Nm);
            const double speed = draw(-1.1, 1.1) * over_speed;
            const double torque_Nm =
                torque_mode_step(&parameters, &mode, to_fixed(commanded_Nm, Q24), to_fixed(speed, Q22)) / Q24;
            ASSERT_NEAR(torque_Nm, twin.step(commanded_Nm, speed),
                        std::ldexp(over_speed / 16.0, -18) + max_Nm / (over_speed / 16.0) / Q22 + 1e-6)
                << drive << " " << k;
        }
    }
}

TEST(TorqueMode, slew_rate_in_newton_metres_per_second_and_zero_for_steps) {
    torque_mode_t mode{};
    const torque_mode_parameters_t slow = configured(100.0), step = configured(0.0);
    for (uint32_t k = 0; k < RATE_HZ / 10; k++) {
        torque_mode_step(&slow, &mode, to_fixed(15.0, Q24), 0);
    }
    EXPECT_NEAR(mode.torque_q24 / Q24, 10.0, 1e-3);
    EXPECT_EQ(torque_mode_step(&step, &mode, to_fixed(-15.0, Q24), 0), to_fixed(-15.0, Q24));
}

TEST(TorqueMode, the_smallest_slew_rate_still_moves) {
    torque_mode_t mode{};
    const torque_mode_parameters_t parameters =
        torque_mode_configure(1, 1000000, to_fixed(-1.0, Q24), to_fixed(1.0, Q24), to_fixed(OVER_SPEED_RAD_S, Q22));
    torque_mode_step(&parameters, &mode, INT32_MAX, 0);
    EXPECT_EQ(mode.torque_q24, 1);
}

// [SR-08]
TEST(TorqueMode, full_torque_below_seven_eighths_of_the_over_speed_limit_and_none_above_fifteen_sixteenths) {
    const torque_mode_parameters_t parameters = configured(0.0);
    const int32_t limit_q24 = to_fixed(TORQUE_MAX_NM, Q24);
    for (const int direction : {1, -1}) {
        const auto driving_q24 = [&](double fraction) {
            torque_mode_t mode{};
            return direction * torque_mode_step(&parameters, &mode, direction * limit_q24,
                                                direction * to_fixed(fraction * OVER_SPEED_RAD_S, Q22));
        };
        EXPECT_EQ(driving_q24(0.874), limit_q24);
        EXPECT_NEAR(driving_q24(29.0 / 32.0) / Q24, TORQUE_MAX_NM / 2.0, 1e-4);
        EXPECT_GT(driving_q24(0.936), 0);
        EXPECT_EQ(driving_q24(0.938), 0);
        EXPECT_EQ(driving_q24(1.2), 0);
    }
}

TEST(TorqueMode, braking_torque_is_not_reduced_at_any_speed) {
    const torque_mode_parameters_t parameters = configured(0.0);
    const int32_t limit_q24 = to_fixed(TORQUE_MAX_NM, Q24);
    for (const double fraction : {0.5, 0.9, 1.0, 1.2}) {
        torque_mode_t mode{};
        const int32_t speed_q22 = to_fixed(fraction * OVER_SPEED_RAD_S, Q22);
        EXPECT_EQ(torque_mode_step(&parameters, &mode, -limit_q24, speed_q22), -limit_q24);
        EXPECT_EQ(torque_mode_step(&parameters, &mode, limit_q24, -speed_q22), limit_q24);
    }
}

TEST(TorqueMode, the_torque_returns_with_the_speed_without_a_new_slew) {
    const torque_mode_parameters_t parameters = configured(1.0);
    torque_mode_t mode{to_fixed(10.0, Q24)};
    const int32_t commanded_q24 = to_fixed(10.0, Q24);
    EXPECT_EQ(torque_mode_step(&parameters, &mode, commanded_q24, to_fixed(OVER_SPEED_RAD_S, Q22)), 0);
    EXPECT_EQ(torque_mode_step(&parameters, &mode, commanded_q24, 0), commanded_q24);
}

TEST(TorqueMode, nothing_overflows_at_the_ends_of_all_ranges) {
    const int32_t ends[] = {INT32_MIN, INT32_MIN + 1, -1, 0, 1, INT32_MAX};
    for (const int32_t slew_q10 : {0, 1, 1000000 << 10}) {
        for (const int32_t max_q24 : {0, 40 << 24}) {
            for (const double over_speed : {rad_s(10.0), rad_s(4800.0)}) {
                const torque_mode_parameters_t parameters =
                    torque_mode_configure(slew_q10, 20000, -max_q24, max_q24, to_fixed(over_speed, Q22));
                for (const int32_t before : ends) {
                    for (const int32_t commanded : ends) {
                        for (const int32_t speed : ends) {
                            torque_mode_t mode{before};
                            torque_mode_step(&parameters, &mode, commanded, speed);
                            const int32_t target = std::clamp(commanded, -max_q24, max_q24);
                            ASSERT_LE(mode.torque_q24, std::max(before, target));
                            ASSERT_GE(mode.torque_q24, std::min(before, target));
                        }
                    }
                }
            }
        }
    }
}

TEST(TorqueMode, the_reduction_is_rounded_up_once_and_down_in_each_step_for_any_arguments) {
    using namespace wide_integer;
    std::mt19937 random(2);
    int reduced = 0;
    for (int i = 0; i < 200000; i++) {
        const int32_t max_q24 = any_up_to(random, 120 << 24), over_speed_q22 = (1 << 22) + any_up_to(random, 500 << 22);
        const torque_mode_parameters_t p = torque_mode_configure(0, RATE_HZ, -max_q24, max_q24, over_speed_q22);
        const wide_t range_q22 = over_speed_q22 / 16;
        ASSERT_EQ(p.fold_back_range_q22, int32_t(range_q22));
        ASSERT_GT(p.fold_back_q18 * range_q22, wide_t(max_q24) << 16) << "rounded up";
        ASSERT_LE((p.fold_back_q18 - 1) * range_q22, wide_t(max_q24) << 16) << "by at most 1 LSB";
        const int32_t before_q24 = any(random), commanded_q24 = any(random);
        const int32_t speed_q22 = i % 2 ? any(random) : p.speed_end_q22 - any_up_to(random, int32_t(range_q22));
        torque_mode_t mode{before_q24};
        const int32_t found_q24 = torque_mode_step(&p, &mode, commanded_q24, speed_q22);
        const wide_t target_q24 = std::clamp(commanded_q24, -max_q24, max_q24);
        const wide_t change_q24 = std::max(saturated(target_q24 - before_q24), -INT32_MAX);
        const wide_t torque_q24 = saturated(before_q24 + change_q24);
        const wide_t below_end_q22 = wide_t(p.speed_end_q22) - std::abs(int64_t(speed_q22));
        const wide_t room_q22 = std::clamp(below_end_q22, wide_t(0), range_q22);
        const wide_t driving_q24 = rounded_down(room_q22 * p.fold_back_q18, power_of_2(16));
        const wide_t expected_q24 =
            speed_q22 < 0 ? std::max(torque_q24, -driving_q24) : std::min(torque_q24, driving_q24);
        ASSERT_EQ(mode.torque_q24, int32_t(torque_q24)) << before_q24 << " " << commanded_q24;
        ASSERT_EQ(found_q24, int32_t(expected_q24)) << commanded_q24 << " " << speed_q22;
        reduced += expected_q24 != torque_q24 && expected_q24 != 0;
    }
    EXPECT_GT(reduced, 5000);
}

} // namespace
