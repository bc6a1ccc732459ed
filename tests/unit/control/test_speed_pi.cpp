// The speed PI against its reference model.
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/speed_pi.h"
}

#include "support/reference_builders.h"

namespace {

using namespace fixed_point;
constexpr double RATE_HZ = 40000.0;
constexpr double LSB_NM = 1.0 / Q24;

speed_pi_parameters_t parameters_of(double kp, double ki, double torque_min_Nm, double torque_max_Nm) {
    return {.kp_q16 = to_fixed(kp, Q16),
            .ki_step_q32 = to_fixed(ki / RATE_HZ, Q32),
            .torque_min_q24 = to_fixed(torque_min_Nm, Q24),
            .torque_max_q24 = to_fixed(torque_max_Nm, Q24)};
}

TEST(SpeedPi, follows_its_reference_model_in_closed_loops_with_random_references_and_loads) {
    std::mt19937 random(1);
    std::uniform_real_distribution<double> unit(0.0, 1.0);
    double worst = 0.0;
    for (int run = 0; run < 40; run++) {
        const double low = run % 2 == 0 ? 0.0 : -19.1;
        const speed_pi_parameters_t parameters =
            parameters_of(20.0 * unit(random), 1000.0 * unit(random), low, 5.0 + 30.0 * unit(random));
        reference_model::pi_t model = reference_model::model_of(parameters);
        speed_pi_t pi;
        speed_pi_reset(&pi);
        double speed = 0.0, reference = 0.0, load = 0.0;
        for (int k = 0; k < 8000; k++) {
            if (k % 1000 == 0) {
                reference = 300.0 * unit(random);
                load = 10.0 * unit(random);
            }
            const int32_t error_q22 = to_fixed(reference - speed, Q22);
            const double torque = speed_pi_step(&parameters, &pi, error_q22) / Q24;
            worst = std::max(worst, std::fabs(torque - model.step(error_q22 / Q22)));
            ASSERT_GE(torque, parameters.torque_min_q24 / Q24);
            ASSERT_LE(torque, parameters.torque_max_q24 / Q24);
            speed += (torque - 0.02 * speed - load) / 0.02 / RATE_HZ;
        }
    }
    // Proportional part and integral are rounded down to an LSB each.
    EXPECT_LE(worst, 2.01 * LSB_NM);
    EXPECT_GT(worst, LSB_NM);
}

TEST(SpeedPi, integral_is_exact_over_a_million_samples) {
    const speed_pi_parameters_t parameters = parameters_of(0.0, 400.0, -100.0, 100.0);
    speed_pi_t pi;
    speed_pi_reset(&pi);
    __extension__ typedef __int128 wide_t;
    wide_t sum = 0;
    std::mt19937 random(2);
    for (int k = 0; k < 1000000; k++) {
        const auto error_q22 = int32_t(uint32_t(random())) / 4096 + (k % 2000 < 1000 ? 1 : -1);
        sum += wide_t(error_q22) * parameters.ki_step_q32;
        speed_pi_step(&parameters, &pi, error_q22);
        ASSERT_TRUE(pi.integral_q54 == sum) << k;
    }
}

TEST(SpeedPi, does_not_wind_up_while_the_torque_is_at_a_limit) {
    const speed_pi_parameters_t parameters = parameters_of(8.0, 400.0, -19.1, 19.1);
    for (const int sign : {1, -1}) {
        speed_pi_t pi;
        speed_pi_reset(&pi);
        const int32_t limit_q24 = sign > 0 ? parameters.torque_max_q24 : parameters.torque_min_q24;
        for (int k = 0; k < 40000; k++) {
            ASSERT_EQ(speed_pi_step(&parameters, &pi, sign * (60 << 22)), limit_q24);
        }
        EXPECT_EQ(pi.integral_q54, 0) << "a second at the limit left an integral";
        // Hence the torque leaves the limit as soon as the error does.
        EXPECT_EQ(speed_pi_step(&parameters, &pi, sign * (1 << 22)), sign * to_fixed(8.0, Q24));
    }
}

TEST(SpeedPi, the_integral_is_clamped_to_the_limits) {
    const speed_pi_parameters_t parameters = parameters_of(0.0, 10000.0, -3.0, 7.0);
    speed_pi_t pi;
    speed_pi_reset(&pi);
    int32_t torque_q24 = 0;
    for (int k = 0; k < 1000; k++) {
        torque_q24 = speed_pi_step(&parameters, &pi, 10 << 22);
        ASSERT_LE(pi.integral_q54, int64_t(7) << 54);
    }
    EXPECT_EQ(torque_q24, 7 << 24);
    for (int k = 0; k < 1000; k++) {
        torque_q24 = speed_pi_step(&parameters, &pi, -(10 << 22));
        ASSERT_GE(pi.integral_q54, -(int64_t(3) << 54));
    }
    EXPECT_EQ(torque_q24, -(3 << 24));
}

TEST(SpeedPi, a_limit_that_comes_nearer_clamps_the_integral_also_without_an_error) {
    for (const int sign : {1, -1}) {
        const speed_pi_parameters_t parameters = parameters_of(1.0, 400.0, -5.0, 5.0);
        speed_pi_t pi{sign * (int64_t(20) << 54)};
        EXPECT_EQ(speed_pi_step(&parameters, &pi, 0), sign * (5 << 24));
        EXPECT_EQ(pi.integral_q54, sign * (int64_t(5) << 54));
    }
}

TEST(SpeedPi, lowering_a_limit_clamps_the_integral) {
    speed_pi_parameters_t parameters = parameters_of(1.0, 400.0, 0.0, 20.0);
    speed_pi_t pi{int64_t(20) << 54};
    parameters.torque_max_q24 = 5 << 24;
    EXPECT_EQ(speed_pi_step(&parameters, &pi, 1), 5 << 24);
    EXPECT_EQ(speed_pi_step(&parameters, &pi, -1), 5 << 24);
    EXPECT_LE(pi.integral_q54, int64_t(5) << 54);
}

TEST(SpeedPi, nothing_overflows_at_the_ends_of_all_ranges) {
    std::mt19937 random(3);
    const int32_t errors[] = {INT32_MIN, INT32_MAX, 0, 1, -1};
    for (const int32_t kp_q16 : {0, 1, 1000 << 16}) {
        for (const int32_t ki_step_q32 : {0, 1, INT32_MAX}) {
            for (const int32_t limit_q24 : {1, 1 << 24, 127 << 24}) {
                const speed_pi_parameters_t parameters = {.kp_q16 = kp_q16,
                                                          .ki_step_q32 = ki_step_q32,
                                                          .torque_min_q24 = -limit_q24,
                                                          .torque_max_q24 = limit_q24};
                speed_pi_t pi;
                speed_pi_reset(&pi);
                for (int k = 0; k < 500; k++) {
                    const int32_t torque_q24 = speed_pi_step(&parameters, &pi, errors[random() % 5]);
                    ASSERT_LE(std::abs(int64_t(torque_q24)), limit_q24);
                    ASSERT_LE(std::abs(pi.integral_q54), int64_t(limit_q24) << 30);
                }
            }
        }
    }
}

TEST(SpeedPi, follows_the_torque_of_another_law_exactly) {
    const speed_pi_parameters_t parameters = parameters_of(8.0, 400.0, -120.0, 120.0);
    std::mt19937 random(4);
    for (int i = 0; i < 100000; i++) {
        const int32_t torque_q24 = int32_t(int64_t(random() % (240u << 24)) - (120 << 24));
        speed_pi_t pi{int64_t(random())};
        speed_pi_follow(&pi, torque_q24);
        ASSERT_EQ(speed_pi_step(&parameters, &pi, 0), torque_q24);
    }
}

} // namespace
