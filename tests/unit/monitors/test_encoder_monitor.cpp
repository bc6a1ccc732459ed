// Encoder against its own counts. [SR-07]
#include <algorithm>
#include <cmath>
#include <cstdint>

#include <gtest/gtest.h>

extern "C" {
#include "monitors/encoder_monitor.h"
}

#include "support/fixed_point.h"

namespace {

using namespace fixed_point;
constexpr uint32_t RATE_HZ = 40000;
constexpr double PERIOD_S = 1.0 / RATE_HZ, DEGREE = 0x1p32 / 360.0;

class EncoderMonitor : public testing::Test {
  protected:
    EncoderMonitor() {
        parameters.middle = 1u << 14;
        parameters.rate_hz = RATE_HZ;
        parameters.over_speed_q22 = to_fixed(rad_s(3600.0), Q22);
        parameters.travel = int32_t(3600.0 / 60.0 * PERIOD_S * 0x1p32);
        input.periods = 100;
        encoder_monitor_step(&parameters, &monitor, &residual);
    }

    // One period in which the encoder shows an angle, degrees.
    void step(double encoder_deg) {
        input.periods++;
        input.encoder_angle = uint32_t(int64_t(encoder_deg * DEGREE)) & ~((1u << 15) - 1u);
        encoder_monitor_step(&parameters, &monitor, &residual);
    }

    encoder_monitor_parameters_t parameters{};
    encoder_monitor_t monitor{};
    flux_residual_t residual{};
    flux_sample_t &input = residual.sample;
};

// [SR-23]
TEST_F(EncoderMonitor,
       an_encoder_that_turns_round_within_a_millisecond_is_suspect_and_a_rotor_that_does_so_in_ten_is_not) {
    for (const int turning_ms : {0, 10}) { // between 300 r/min one way and the other
        monitor = {};
        double angle_deg = 0.0, speed_deg_s = 1800.0;
        for (int k = 0; k < 30 * RATE_HZ / 1000; k++) {
            const bool after = k >= 10 * RATE_HZ / 1000;
            speed_deg_s = !after            ? 1800.0
                          : turning_ms == 0 ? -1800.0
                                            : std::max(-1800.0, speed_deg_s - 3600.0 / (turning_ms * RATE_HZ / 1000));
            angle_deg += speed_deg_s / RATE_HZ;
            step(angle_deg);
        }
        EXPECT_EQ(monitor.turned_round, turning_ms == 0);
    }
}

// [SR-23]
TEST_F(EncoderMonitor,
       a_rotor_that_turns_by_more_than_half_a_turn_while_triggers_are_lost_is_no_encoder_that_turns_round) {
    for (const bool lost : {true, false}) {
        monitor = {};
        double angle_deg = 0.0; // 300 r/min
        for (int k = 0; k < 20 * RATE_HZ / 1000; k++) {
            const bool gap = k == 10 * RATE_HZ / 1000;
            angle_deg += 1800.0 / RATE_HZ + (gap ? 270.0 : 0.0);
            residual.lost = gap && lost;
            step(angle_deg);
        }
        EXPECT_EQ(monitor.turned_round, !lost);
    }
}

// [SR-23]
TEST_F(EncoderMonitor, an_encoder_that_turns_the_other_way_after_triggers_were_lost_has_not_turned_round) {
    for (const bool lost : {true, false}) {
        monitor = {};
        double angle_deg = 0.0; // 300 r/min one way, then the other
        for (int k = 0; k < 20 * RATE_HZ / 1000; k++) {
            const int turns = 10 * RATE_HZ / 1000;
            angle_deg += (k < turns ? 1800.0 : -1800.0) / RATE_HZ;
            residual.lost = k == turns && lost;
            step(angle_deg);
        }
        EXPECT_EQ(monitor.turned_round, !lost);
    }
}

// [SR-23]
TEST_F(EncoderMonitor, the_first_direction_of_the_encoder_after_a_reset_is_no_turn_round) {
    monitor = {};
    input.periods = 0;
    for (int k = 0; k < 10 * RATE_HZ / 1000; k++) {
        const double angle_deg = 90.0 - k * 1800.0 / RATE_HZ;
        step(angle_deg);
    }
    EXPECT_FALSE(monitor.turned_round);
}

// [SR-23]
TEST_F(EncoderMonitor, a_rotor_that_is_light_enough_to_turn_round_within_a_millisecond_is_not_suspect) {
    // Between 300 r/min one way and the other, 1800 degrees a second: in 1.4 ms by 2.5e6 degrees/s^2.
    for (const auto &[deg_s2, suspect] : {std::pair{2.8e6, false}, std::pair{2.2e6, true}}) {
        monitor = {};
        parameters.travel_change = int32_t(deg_s2 * PERIOD_S * PERIOD_S * DEGREE);
        double angle_deg = 0.0;
        for (int k = 0; k < 20 * RATE_HZ / 1000; k++) {
            angle_deg += (k < 10 * RATE_HZ / 1000 ? 1800.0 : -1800.0) / RATE_HZ;
            step(angle_deg);
        }
        EXPECT_EQ(monitor.turned_round, suspect) << deg_s2;
    }
}

TEST_F(EncoderMonitor, counts_faster_than_the_limit_are_over_speed_within_a_millisecond_in_either_direction) {
    for (const double sign : {1.0, -1.0}) {
        for (const auto &[rpm, fails] : {std::pair{3600.0, false}, std::pair{3800.0, false}, std::pair{3950.0, true}}) {
            monitor = {};
            int periods = 0;
            for (double deg = 0.0; periods < 400 && !monitor.over_speed; periods++) {
                deg += sign * rpm * 6.0 * PERIOD_S;
                step(deg);
            }
            EXPECT_EQ(monitor.over_speed, fails) << sign * rpm;
            EXPECT_LT(fails ? periods : 0, RATE_HZ / 1000) << sign * rpm;
            EXPECT_GT(periods, 10);
            for (int k = 0; k < 100; k++) {
                step(0.0);
            }
            EXPECT_FALSE(monitor.over_speed) << "at rest again";
        }
    }
}

// A check in each period or in each tenth: windows of 48 and 50 periods. At the first speeds beyond the limit, and at
// those at which a window nearly has a turn less the travel at the limit.
TEST_F(EncoderMonitor, over_speed_of_the_fastest_machine_is_found_at_100_khz_and_its_highest_speed_is_none) {
    constexpr double LIMIT_RPM = 38400.0, FAST_PERIOD_S = 1e-5;
    parameters.rate_hz = 100000;
    parameters.travel = int32_t(LIMIT_RPM / 60.0 * FAST_PERIOD_S * 0x1p32);
    for (const double sign : {1.0, -1.0}) {
        for (const int spacing : {1, 10}) {
            for (const auto &[part, fails] :
                 {std::pair{0.9, false}, std::pair{1.0, false}, std::pair{1.05, false}, std::pair{1.08, true},
                  std::pair{1.3, true}, std::pair{1.5, true}, std::pair{1.9, true}}) {
                monitor = {};
                bool failed = false;
                for (int k = 0; k < 200; k += spacing) {
                    step(sign * part * LIMIT_RPM * 6.0 * FAST_PERIOD_S * k);
                    input.periods += uint32_t(spacing) - 1u;
                    failed = failed || monitor.over_speed;
                }
                EXPECT_EQ(failed, fails) << sign * part << " " << spacing;
            }
        }
    }
}

TEST_F(EncoderMonitor, the_observer_shows_over_speed_when_the_counts_do_to_a_thirty_second) {
    for (const auto &[observed_rpm, counted_rpm, fails] :
         {std::tuple{3601.0, 3550.0, true}, std::tuple{3601.0, 3400.0, false}, std::tuple{-3601.0, 3550.0, true},
          std::tuple{3599.0, 3599.0, false}, std::tuple{7200.0, 0.0, false}}) {
        monitor = {};
        input.speed_q22 = to_fixed(rad_s(observed_rpm), Q22);
        bool failed = false;
        for (int k = 0; k < 100; k++) {
            step(counted_rpm * 6.0 * PERIOD_S * k);
            failed = failed || monitor.over_speed;
        }
        EXPECT_EQ(failed, fails) << observed_rpm << " " << counted_rpm;
    }
}

TEST_F(EncoderMonitor, a_jump_that_the_observer_follows_to_any_speed_is_no_over_speed) {
    input.speed_q22 = to_fixed(rad_s(6000.0), Q22);
    for (int k = 0; k < 100; k++) {
        step(k < 50 ? 0.0 : 0.75 * 3600.0 * 6.0 * PERIOD_S * 20); // three quarters of a window at the limit
        ASSERT_FALSE(monitor.over_speed) << k;
    }
}

// [SR-23]
TEST_F(EncoderMonitor,
       an_encoder_that_has_turned_round_is_suspect_for_a_quarter_of_a_second_each_time_and_never_again) {
    double angle_deg = 0.0, speed_deg_s = 1800.0;
    const auto run = [&](uint32_t periods) {
        uint32_t suspect = 0;
        for (uint32_t k = 0; k < periods; k++) {
            angle_deg = std::fmod(angle_deg + speed_deg_s / RATE_HZ + 360.0, 360.0);
            step(angle_deg);
            suspect += monitor.turned_round;
        }
        return suspect;
    };
    run(RATE_HZ / 100);
    for (int turn = 0; turn < 3; turn++) {
        speed_deg_s = -speed_deg_s;
        EXPECT_NEAR(run(RATE_HZ), RATE_HZ / 4, 1) << turn;
    }
    // The number of the period comes round: the last turn's, with the direction before it, is a new one.
    speed_deg_s = 0.0;
    EXPECT_EQ(run(RATE_HZ / 100), 0u);
    input.periods = monitor.reversed_at - RATE_HZ / 1000;
    residual.lost = true;
    run(1);
    residual.lost = false;
    speed_deg_s = 1800.0;
    EXPECT_EQ(run(RATE_HZ / 10), 0u);
}

// [SR-23]
TEST_F(EncoderMonitor, a_rotor_that_turns_the_other_way_after_a_rest_is_no_encoder_that_turns_round) {
    double angle_deg = 100.0;
    const auto turn = [&](double deg_s, uint32_t periods) {
        for (uint32_t k = 0; k < periods; k++) {
            step(angle_deg += deg_s / RATE_HZ);
        }
    };
    turn(1800.0, RATE_HZ / 100);
    turn(0.0, RATE_HZ / 100);
    input.periods = monitor.turned_at; // a round of the numbers of periods later
    turn(0.0, 1);
    turn(-1800.0, RATE_HZ / 100);
    EXPECT_FALSE(monitor.turned_round);
}

// Windows at their ends, from sample to sample.
class EncoderWindows : public EncoderMonitor {
  protected:
    static constexpr uint32_t WINDOW = RATE_HZ / 2048;

    // One sample a window later; travel in 2^-32 rev.
    void window(int64_t travel) {
        input.periods += WINDOW;
        input.encoder_angle += uint32_t(travel);
        encoder_monitor_step(&parameters, &monitor, &residual);
    }

    bool over_speed(int64_t travel) {
        monitor = {};
        window(0);
        window(travel);
        return monitor.over_speed;
    }

    int64_t limit() const { return int64_t(parameters.travel) * WINDOW; }
    int64_t count() const { return 2 * int64_t(parameters.middle); }
};

TEST_F(EncoderWindows, over_speed_is_a_sixteenth_above_the_limit_and_the_count_that_the_encoder_may_err_by) {
    for (const uint32_t middle : {1u << 14, 1u << 21}) { // 17 and 10 bits
        parameters.middle = middle;
        for (const int64_t sign : {1, -1}) {
            EXPECT_FALSE(over_speed(sign * (limit() / 16 * 17 + count() / 2))) << middle << " " << sign;
            EXPECT_TRUE(over_speed(sign * (limit() / 16 * 17 + 2 * count()))) << middle << " " << sign;
        }
    }
}

TEST_F(EncoderWindows, the_observer_s_speed_counts_above_the_limit_and_not_at_it) {
    for (const int sign : {1, -1}) {
        for (const int32_t above : {0, 1}) {
            input.speed_q22 = sign * (parameters.over_speed_q22 + above);
            EXPECT_EQ(over_speed(limit()), above != 0) << sign;
            EXPECT_EQ(over_speed(limit() / 32 * 31), above != 0) << sign;
            EXPECT_FALSE(over_speed(limit() / 32 * 31 - 2 * count())) << sign;
        }
    }
}

// [SR-23]
TEST_F(EncoderWindows,
       an_encoder_that_rests_for_two_windows_between_its_directions_has_turned_round_and_for_three_not) {
    for (const int sign : {1, -1}) {
        for (unsigned rest = 0; rest <= 5; rest++) {
            monitor = {};
            window(0);
            for (int k = 0; k < 3; k++) {
                window(sign * (limit() / 32 + 2 * count()));
            }
            for (unsigned k = 0; k < rest; k++) {
                window(0);
            }
            EXPECT_FALSE(monitor.turned_round);
            window(-sign * (limit() / 32 + 2 * count()));
            EXPECT_EQ(monitor.turned_round, rest <= 2) << rest;
        }
    }
}

} // namespace
