// Position loop with an ideal speed loop: orders, counts over turns, end stops, following error, homing, hostile set
// points.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/position/position_configure.h"
#include "control/position/position_loop.h"
}

namespace {

constexpr uint32_t RATE_HZ = 20000;
constexpr int PERIODS = RATE_HZ / 1000;
constexpr double REV_48 = 281474976710656.0;
constexpr double REV_32 = 4294967296.0;
constexpr double PI = 3.14159265358979323846;

position_settings_t settings() {
    position_settings_t settings = {};
    settings.control_rate_hz = RATE_HZ;
    settings.angle_step_q32 = int32_t(std::ldexp(1.0 / (2.0 * PI) / RATE_HZ, 42));
    settings.acceleration_q32 = int32_t(std::ldexp(1.0 / RATE_HZ / 0.02, 30));
    settings.torque_max_q24 = 19 << 24;
    settings.speed_max_q22 = 300 << 22;
    settings.acceleration_rpm_s = 6000;
    settings.jerk_rpm_s2 = 600000;
    settings.gain_1_s = 150;
    settings.lowest_rev = -100;
    settings.highest_rev = 100;
    settings.following_error_q7 = 45 << 7;
    settings.window_q15 = 1 << 14;
    settings.homing_speed_rpm = 120;
    settings.cycle_ms = 4;
    return settings;
}

// The rotor follows the reference speed, unless it is held.
class PositionLoop : public testing::Test {
  protected:
    position_parameters_t parameters = [] {
        const position_settings_t of = settings();
        return position_configure(&of);
    }();
    position_t position = {};
    position_command_t command = {};
    double rotor_rev = 0.25, speed_rev_s = 0.0;  // rotor since the start
    double lowest_rev = -1e9, highest_rev = 1e9; // mechanical stops
    position_output_t out = {};

    void order(position_order_t kind, double target_rev, position_homing_t homing = POSITION_HOMING_HERE) {
        position_set_point_t set_point = {};
        set_point.order = kind;
        set_point.homing = homing;
        send(set_point, target_rev);
    }

    void cyclic(double target_rev, uint32_t cycle_ms) {
        position_set_point_t set_point = {};
        set_point.order = POSITION_ORDER_CYCLIC;
        set_point.cycle_ms = cycle_ms;
        send(set_point, target_rev);
    }

    void send(position_set_point_t set_point, double target_rev) {
        set_point.sequence = command.set_point.sequence + 1;
        set_point.target = int64_t(std::llround(target_rev * REV_32));
        command = position_command(&parameters, &set_point, 1 << 14, 1 << 14);
    }

    position_sample_t sample() const {
        const auto angle = uint32_t(int64_t(std::llround(rotor_rev * REV_32)));
        const bool at_stop = rotor_rev <= lowest_rev || rotor_rev >= highest_rev;
        return {.encoder_angle = angle & ~0x7FFFu, // 17 bits
                .angle = angle,
                .speed = int64_t(speed_rev_s * REV_48 * 1e-3),
                .at_torque_limit = at_stop,
                .periods = 1};
    }

    void step() {
        const position_sample_t now = sample();
        out = position_step(&parameters.law, &position, &command, &now);
        const double rad_s = out.speed_q22 / 4194304.0;
        const double next = std::clamp(rotor_rev + rad_s / (2.0 * PI) / RATE_HZ, lowest_rev, highest_rev);
        speed_rev_s = (next - rotor_rev) * RATE_HZ;
        rotor_rev = next;
    }

    void ticks(int count) {
        for (int i = 0; i < count * PERIODS; i++) {
            step();
        }
    }

    double position_rev() const { return double(position.status.position) / REV_32; }
};

TEST_F(PositionLoop, units_are_those_of_the_speed_loop_and_the_inertia) {
    const int64_t speed = int64_t(10.0 * REV_48 * 1e-3); // 10 rev/s
    EXPECT_NEAR(double(profile_scale(speed, parameters.law.speed_of)) / 4194304.0, 20.0 * PI, 1e-4);
    EXPECT_NEAR(double(profile_scale(int64_t(REV_48 / 100.0), parameters.law.gain)) / 4194304.0,
                150.0 * 2.0 * PI / 100.0, 1e-4);
    const int64_t acceleration = int64_t(100.0 * REV_48 * 1e-6); // 100 rev/s^2 on 0.02 kg m^2
    EXPECT_NEAR(double(profile_scale(acceleration, parameters.law.torque_of)) / 16777216.0, 200.0 * PI * 0.02, 1e-4);
    EXPECT_NEAR(double(parameters.plan.limits.speed), 300.0 / (2.0 * PI) * REV_48 * 1e-3, REV_48 * 1e-8);
    EXPECT_NEAR(double(parameters.plan.limits.acceleration), 100.0 * REV_48 * 1e-6, REV_48 * 1e-9);
}

TEST_F(PositionLoop, a_speed_beyond_the_format_is_the_fastest) {
    position_settings_t of = settings();
    of.speed_rpm = of.homing_speed_rpm = INT32_MAX;
    for (const unsigned exponent : {0u, 3u}) {
        of.speed_exponent = exponent;
        const position_parameters_t fastest = position_configure(&of);
        EXPECT_EQ(fastest.plan.limits.speed, parameters.plan.limits.speed) << "the largest speed reference";
        EXPECT_GT(fastest.law.homing_speed, PROFILE_SPEED_MAX);
    }
}

TEST_F(PositionLoop, limits_of_zero_are_found_from_torque_inertia_and_speed) {
    position_settings_t of = settings();
    of.acceleration_rpm_s = of.jerk_rpm_s2 = 0;
    const position_parameters_t automatic = position_configure(&of);
    const double expected = 0.75 * 19.0 / 0.02 / (2.0 * PI) * REV_48 * 1e-6;
    EXPECT_NEAR(double(automatic.plan.limits.acceleration), expected, expected * 1e-3);
    EXPECT_NEAR(6.0 * double(automatic.plan.limits.q), expected / 5.0, expected * 1e-3);
}

TEST_F(PositionLoop, no_limit_of_a_set_point_exceeds_those_of_the_parameters) {
    position_set_point_t set_point = {};
    set_point.speed_q22 = INT32_MAX;
    set_point.acceleration_rpm_s = set_point.deceleration_rpm_s = set_point.jerk_rpm_s2 = INT32_MAX;
    const position_command_t most = position_command(&parameters, &set_point, 1 << 14, 1 << 14);
    EXPECT_EQ(most.limits.speed, parameters.plan.limits.speed);
    EXPECT_EQ(most.limits.acceleration, parameters.plan.limits.acceleration);
    EXPECT_LE(most.limits.q, parameters.plan.limits.q);
    set_point.speed_q22 = 10 << 22;
    set_point.acceleration_rpm_s = 600;
    set_point.deceleration_rpm_s = INT32_MIN;
    set_point.jerk_rpm_s2 = -1;
    const position_command_t less = position_command(&parameters, &set_point, 1 << 14, 1 << 14);
    EXPECT_NEAR(double(less.limits.speed), 10.0 / (2.0 * PI) * REV_48 * 1e-3, REV_48 * 1e-8);
    EXPECT_NEAR(double(less.limits.acceleration), 10.0 * REV_48 * 1e-6, REV_48 * 1e-9);
    EXPECT_EQ(less.limits.deceleration, parameters.plan.limits.deceleration);
}

TEST_F(PositionLoop, acceleration_and_deceleration_have_each_their_own_limit) {
    const double per_rpm_s = REV_48 * 1e-6 / 60.0;
    for (const auto &[up, down] : {std::pair{3000, 9000}, {9000, 3000}}) {
        position_settings_t of = settings();
        of.acceleration_rpm_s = up;
        of.deceleration_rpm_s = down;
        parameters = position_configure(&of);
        EXPECT_NEAR(double(parameters.plan.limits.acceleration), up * per_rpm_s, REV_48 * 1e-9);
        EXPECT_NEAR(double(parameters.plan.limits.deceleration), down * per_rpm_s, REV_48 * 1e-9);
        for (const auto &[wanted_up, wanted_down] : {std::pair{0, INT32_MAX}, {INT32_MAX, 0}, {600, 1200}, {1200, 0}}) {
            position_set_point_t set_point = {};
            set_point.acceleration_rpm_s = wanted_up;
            set_point.deceleration_rpm_s = wanted_down;
            const position_command_t made = position_command(&parameters, &set_point, 1 << 14, 1 << 14);
            const int expected_up = wanted_up > 0 ? std::min(wanted_up, up) : up;
            const int expected_down = wanted_down > 0 ? std::min(wanted_down, down) : down;
            EXPECT_NEAR(double(made.limits.acceleration), expected_up * per_rpm_s, REV_48 * 1e-9) << up;
            EXPECT_NEAR(double(made.limits.deceleration), expected_down * per_rpm_s, REV_48 * 1e-9) << up;
        }
    }
}

TEST_F(PositionLoop, an_inertia_that_has_become_known_bounds_the_acceleration) {
    position_settings_t of = settings();
    of.acceleration_rpm_s = of.deceleration_rpm_s = of.jerk_rpm_s2 = 0;
    parameters = position_configure(&of);
    position_set_point_t set_point = {};
    const double own = double(parameters.plan.limits.acceleration);
    for (const auto &[ratio, part] :
         {std::pair{0.2, 1.0}, {1.0, 1.0}, {1.12, 1.0}, {2.0, 0.5}, {5.0, 0.2}, {60.0, 0.125}}) {
        const position_command_t made = position_command(&parameters, &set_point, int32_t(ratio * (1 << 14)), 1 << 14);
        EXPECT_NEAR(double(made.limits.acceleration), own * part, own * 2e-3) << ratio;
        EXPECT_NEAR(double(made.limits.deceleration), own * part, own * 2e-3) << ratio;
        EXPECT_EQ(made.limits.speed, parameters.plan.limits.speed);
    }
    set_point.acceleration_rpm_s = 600; // what is less stays
    const position_command_t slow = position_command(&parameters, &set_point, 2 << 14, 1 << 14);
    EXPECT_NEAR(double(slow.limits.acceleration), 10.0 * REV_48 * 1e-6, REV_48 * 1e-9);
}

TEST_F(PositionLoop, a_load_leaves_less_for_the_acceleration) {
    position_settings_t of = settings();
    of.acceleration_rpm_s = of.jerk_rpm_s2 = 0;
    parameters = position_configure(&of);
    const position_set_point_t set_point = {};
    const double own = double(parameters.plan.limits.acceleration);
    for (const auto &[left, ratio, part] : {std::tuple{1.0, 1.0, 1.0},
                                            {0.75, 1.0, 1.0},
                                            {0.5, 1.0, 2.0 / 3.0},
                                            {0.5, 2.0, 1.0 / 3.0},
                                            {-1.0, 1.0, 0.125},
                                            {0.5, 0.25, 1.0}}) {
        const auto made =
            position_command(&parameters, &set_point, int32_t(ratio * (1 << 14)), int32_t(left * (1 << 14)));
        EXPECT_NEAR(double(made.limits.acceleration), own * part, own * 2e-3) << left << " " << ratio;
        EXPECT_NEAR(double(made.limits.deceleration), own * part, own * 2e-3) << left << " " << ratio;
    }
}

TEST_F(PositionLoop, the_offset_of_cyclic_targets_acts_while_these_come_and_not_in_the_stop_after_them) {
    const double here_rev = rotor_rev;
    for (unsigned cycle = 0; cycle < 25; cycle++) {
        cyclic(here_rev, 4);
        command.set_point.torque_offset_q24 = 3 << 24;
        ticks(4);
    }
    EXPECT_FALSE(position.stops);
    EXPECT_NEAR(out.torque_q24 / 16777216.0, 3.0, 0.01);
    ticks(40);
    EXPECT_TRUE(position.stops);
    EXPECT_NEAR(out.torque_q24 / 16777216.0, 0.0, 0.01);
}

TEST_F(PositionLoop, a_reference_that_has_left_a_heavier_rotor_behind_goes_on_from_there) {
    for (const bool limited : {false, true}) {
        position = {};
        rotor_rev = 0.25;
        order(POSITION_ORDER_PROFILE, 20.0);
        const auto blocked = [&](unsigned periods, bool at_limit) {
            for (unsigned i = 0; i < periods; i++) { // it turns by far less
                position_sample_t now = sample();
                now.at_torque_limit = at_limit;
                out = position_step(&parameters.law, &position, &command, &now);
            }
        };
        blocked(12 * parameters.law.periods_per_tick, true);
        const int32_t behind = position.status.error;
        EXPECT_GT(behind, 1 << 20);
        command.inertia_ratio_q14 = 4 << 14;
        blocked(parameters.law.periods_per_tick, limited);
        EXPECT_EQ(std::abs(position.status.error) < 1 << 20, limited) << "a torque below its limit keeps up";
        blocked(12 * parameters.law.periods_per_tick, limited);
        EXPECT_GT(position.status.error, 1 << 20) << "once";
    }
}

TEST_F(PositionLoop, end_stops_of_a_set_point_are_within_those_of_the_parameters) {
    const auto rev = [](double turns) { return int64_t(turns * REV_32); };
    const auto bounds = [&](double low, double high) {
        position_set_point_t set_point = {};
        set_point.bounded = true;
        set_point.lowest = rev(low);
        set_point.highest = rev(high);
        const position_command_t made = position_command(&parameters, &set_point, 1 << 14, 1 << 14);
        return std::pair(double(made.lowest) / REV_48, double(made.highest) / REV_48);
    };
    EXPECT_EQ(bounds(-1.5, 0.25), std::pair(-1.5, 0.25));
    EXPECT_EQ(bounds(-1e6, 1e6), std::pair(-100.0, 100.0));
    EXPECT_EQ(bounds(5000, 1e6), std::pair(100.0, 100.0)) << "out of reach";
    EXPECT_EQ(bounds(0, 0), std::pair(0.0, 0.0)) << "a place";
    order(POSITION_ORDER_PROFILE, 3.0);
    EXPECT_EQ(double(command.highest) / REV_48, 100.0) << "unbounded";
    command.highest = int64_t(REV_48);
    ticks(2000);
    EXPECT_NEAR(rotor_rev, 1.0, 1e-6);
    EXPECT_TRUE(position.status.limited);
}

TEST_F(PositionLoop, other_end_stops_move_no_rotor_that_rests_and_shorten_a_move) {
    order(POSITION_ORDER_PROFILE, 3.0);
    ticks(2000);
    command.highest = int64_t(REV_48); // behind the rotor
    ticks(500);
    EXPECT_NEAR(rotor_rev, 3.0, 1e-6);
    command.highest = int64_t(8.0 * REV_48);
    order(POSITION_ORDER_PROFILE, 10.0);
    ticks(200);
    EXPECT_FALSE(position.status.limited);
    command.highest = int64_t(8.0 * REV_48);
    ticks(3000);
    EXPECT_NEAR(rotor_rev, 8.0, 1e-6);
    EXPECT_TRUE(position.status.limited);
    order(POSITION_ORDER_PROFILE, 20.0);
    ticks(250); // on the way, at speed
    command.highest = int64_t(9.0 * REV_48);
    const double from = rotor_rev;
    EXPECT_GT(from, 9.5);
    ticks(3000);
    EXPECT_GT(rotor_rev, from - 0.1) << "passed: it stops, and does not return to the stop";
    EXPECT_LT(rotor_rev, 19.0);
    order(POSITION_ORDER_PROFILE, 20.0);
    command.highest = int64_t(9.0 * REV_48);
    ticks(3000);
    EXPECT_NEAR(rotor_rev, 9.0, 1e-6) << "a new set point";
}

TEST_F(PositionLoop, an_end_stop_that_comes_nearer_shortens_a_move_in_either_direction) {
    for (const double sign : {1.0, -1.0}) {
        position = {};
        rotor_rev = 0.0;
        order(POSITION_ORDER_PROFILE, sign * 10.0);
        ticks(100);
        EXPECT_FALSE(position.status.limited);
        (sign > 0.0 ? command.highest : command.lowest) = int64_t(sign * 8.0 * REV_48);
        ticks(1);
        EXPECT_TRUE(position.status.limited) << sign;
        ticks(3000);
        EXPECT_NEAR(rotor_rev, sign * 8.0, 1e-6);
    }
}

TEST_F(PositionLoop, skipped_periods_of_more_than_a_tick_let_the_reference_wait_and_leave_no_rest) {
    order(POSITION_ORDER_PROFILE, 5.0);
    ticks(200);
    const auto skips = [this](uint32_t periods) {
        const int64_t before = position.profile.start.x;
        position_sample_t now = sample();
        now.periods = periods;
        out = position_step(&parameters.law, &position, &command, &now);
        return double(position.profile.start.x - before) / REV_48;
    };
    ASSERT_EQ(position.phase, 0u);
    const double tick_rev = speed_rev_s * 1e-3;
    EXPECT_NEAR(skips(2 * PERIODS - 1), tick_rev, 0.1 * tick_rev);
    EXPECT_EQ(position.phase, unsigned(PERIODS - 1));
    EXPECT_NEAR(skips(1 + PERIODS), tick_rev, 0.1 * tick_rev) << "one tick, though two have passed";
    EXPECT_EQ(position.phase, 0u);
    EXPECT_NEAR(skips(10 * PERIODS + 3), tick_rev, 0.1 * tick_rev);
    EXPECT_EQ(position.phase, 0u);
    ticks(2000);
    EXPECT_NEAR(rotor_rev, 5.0, 1e-6);
}

TEST_F(PositionLoop, the_period_of_a_set_point_replaces_the_parameters) {
    position_set_point_t set_point = {};
    EXPECT_EQ(position_command(&parameters, &set_point, 1 << 14, 1 << 14).cycle.ticks, 4u);
    set_point.cycle_ms = 50;
    EXPECT_EQ(position_command(&parameters, &set_point, 1 << 14, 1 << 14).cycle.ticks, 50u);
    set_point.cycle_ms = UINT32_MAX;
    EXPECT_EQ(position_command(&parameters, &set_point, 1 << 14, 1 << 14).cycle.ticks,
              unsigned(POSITION_CYCLE_TICKS_MAX));
    rotor_rev = 0.0;
    for (int k = 0; k <= 60; k++) { // a line in steps of 100 ms, by its cubic
        set_point.order = POSITION_ORDER_CYCLIC;
        set_point.sequence++;
        set_point.target = int64_t(0.1 * k * REV_32);
        command = position_command(&parameters, &set_point, 1 << 14, 1 << 14);
        ticks(100);
        ASSERT_NEAR(rotor_rev, 0.1 * (k - 0.02), 0.05) << k;
        ASSERT_TRUE(k < 5 || std::abs(speed_rev_s - 1.0) < 0.02) << speed_rev_s;
    }
}

TEST_F(PositionLoop, in_position_is_of_the_set_point_that_arrived_names) {
    order(POSITION_ORDER_PROFILE, 0.5);
    ticks(1000);
    const uint32_t before = command.set_point.sequence;
    EXPECT_EQ(position.status.arrived, before);
    order(POSITION_ORDER_PROFILE, 0.75);
    for (int k = 0; k < 3 * PERIODS; k++) { // at no instant is the old flag the new set point's
        step();
        ASSERT_FALSE(position.status.in_position && position.status.arrived == command.set_point.sequence) << k;
    }
    ticks(1000);
    EXPECT_TRUE(position.status.in_position && position.status.arrived == command.set_point.sequence);
}

TEST_F(PositionLoop, a_rotor_within_the_count_of_its_target_is_in_position) {
    order(POSITION_ORDER_PROFILE, 0.5);
    ticks(1000);
    const auto in_position = [&](double rev, uint32_t count) {
        rotor_rev = rev;
        position_sample_t now = sample();
        now.encoder_angle = now.angle & ~((1u << 26) - 1u); // 6 bits
        now.count = count;
        for (int i = 0; i < PERIODS; i++) {
            position_step(&parameters.law, &position, &command, &now);
        }
        return position.status.in_position;
    };
    EXPECT_TRUE(in_position(0.505, 1u << 26)); // 1.8 degrees; the window is half of one
    EXPECT_FALSE(in_position(0.505, 0));
    EXPECT_FALSE(in_position(0.52, 1u << 26)); // in the next count
    EXPECT_TRUE(in_position(0.49, 1u << 26));  // whose end is the target
}

TEST_F(PositionLoop, begins_where_the_rotor_is_and_moves_to_the_target_over_turns) {
    order(POSITION_ORDER_PROFILE, -12.375);
    step();
    EXPECT_NEAR(position_rev(), 0.25, 1e-5);
    EXPECT_NEAR(double(position.status.reference) / REV_32, 0.25, 1e-5);
    ticks(3000);
    EXPECT_NEAR(rotor_rev, -12.375, 1e-6);
    EXPECT_TRUE(position.status.in_position && position.status.reference_ended && position.status.active);
    EXPECT_EQ(position.status.reference, int64_t(-12.375 * REV_32));
    rotor_rev += 0.01; // beyond the window of half a degree
    ticks(2);
    EXPECT_FALSE(position.status.in_position);
    EXPECT_TRUE(position.status.reference_ended);
}

TEST_F(PositionLoop, is_followed_outside_of_position_mode_and_by_hand) {
    for (int k = 0; k < 2000; k++) {
        rotor_rev += 0.01;
        const position_sample_t now = sample();
        position_follow(&position, now.encoder_angle, now.angle);
        ASSERT_NEAR(position_rev(), rotor_rev, 1e-6);
        ASSERT_FALSE(position.status.active);
        ASSERT_EQ(position.status.reference, position.status.position);
    }
}

TEST_F(PositionLoop, a_turning_rotor_is_taken_over_at_its_speed) {
    speed_rev_s = 20.0;
    order(POSITION_ORDER_PROFILE, 30.0);
    step();
    EXPECT_NEAR(out.speed_q22 / 4194304.0 / (2.0 * PI), 20.0, 0.2); // the gain, of a period's way
    ticks(3000);
    EXPECT_NEAR(rotor_rev, 30.0, 1e-6);
}

TEST_F(PositionLoop, end_stops_bound_every_order) {
    order(POSITION_ORDER_PROFILE, 5000.0);
    double highest = 0.0;
    for (int k = 0; k < 7000; k++) {
        ticks(1);
        highest = std::max(highest, rotor_rev);
    }
    EXPECT_NEAR(rotor_rev, 100.0, 1e-6);
    EXPECT_LT(highest, 100.0001);
    EXPECT_TRUE(position.status.limited);
    for (int k = 0; k < 1200; k++) { // beyond the stop and back, 25 rev/s
        order(POSITION_ORDER_CYCLIC, 95.0 + 0.1 * std::min(k, 200));
        ticks(4);
        highest = std::max(highest, rotor_rev);
    }
    EXPECT_LT(highest, 100.0001);
    order(POSITION_ORDER_PROFILE, 0.0);
    ticks(3000);
    EXPECT_NEAR(rotor_rev, 0.0, 1e-6);
    EXPECT_FALSE(position.status.limited);
}

TEST_F(PositionLoop, halt_stops_by_the_profile_and_holds) {
    order(POSITION_ORDER_PROFILE, 50.0);
    ticks(150);
    const double speed = speed_rev_s, from = rotor_rev;
    order(POSITION_ORDER_HALT, 0.0);
    ticks(600);
    EXPECT_GT(speed, 8.0);
    EXPECT_NEAR(speed_rev_s, 0.0, 1e-3);
    EXPECT_NEAR(rotor_rev - from, speed * speed / 2.0 / 100.0 + speed * 0.01, 0.3 * (rotor_rev - from));
    const double held = rotor_rev;
    ticks(200);
    EXPECT_NEAR(rotor_rev, held, 1e-6);
}

TEST_F(PositionLoop, cyclic_targets_are_reached_a_cycle_later) {
    const double amplitude = 0.5, frequency = 2.0;
    double worst = 0.0;
    for (int k = 0; k < 1000; k++) {
        const double time = k * 0.004;
        order(POSITION_ORDER_CYCLIC, 0.25 + amplitude * std::sin(2.0 * PI * frequency * time) * std::min(1.0, time));
        for (int tick = 0; tick < 4; tick++) {
            ticks(1);
            const double at = time + tick * 0.001 - 0.004;
            const double expected =
                0.25 + amplitude * std::sin(2.0 * PI * frequency * at) * std::min(1.0, std::max(at, 0.0));
            worst = k > 300 ? std::max(worst, std::fabs(double(position.status.reference) / REV_32 - expected)) : worst;
        }
    }
    EXPECT_LT(worst, amplitude * 2.0 * PI * frequency * 0.0011 + 1e-4); // within the last tick
}

TEST_F(PositionLoop, a_jump_of_a_cyclic_target_is_approached_within_the_limits) {
    order(POSITION_ORDER_CYCLIC, 0.25);
    ticks(4);
    int64_t speed = 0, acceleration = 0;
    for (int k = 0; k < 400; k++) {
        order(POSITION_ORDER_CYCLIC, k < 5 ? 0.25 : 3.0);
        for (int tick = 0; tick < 4; tick++) {
            ticks(1);
            speed = std::max(speed, std::abs(position.profile.end.v));
            acceleration = std::max(acceleration, std::abs(position.profile.end.a));
        }
    }
    EXPECT_NEAR(rotor_rev, 3.0, 1e-6);
    EXPECT_LE(acceleration, parameters.plan.limits.acceleration + parameters.plan.limits.acceleration / 1000);
    EXPECT_LE(speed, parameters.plan.limits.speed);
}

TEST_F(PositionLoop, a_sender_of_cyclic_targets_that_ceases_is_a_stop_by_the_profile) {
    for (int k = 0; k < 250; k++) {
        order(POSITION_ORDER_CYCLIC, 0.25 + 0.00002 * k * k);
        ticks(4);
    }
    const double speed = speed_rev_s, from = rotor_rev;
    EXPECT_GT(speed, 1.5);
    ticks(12);
    EXPECT_GT(speed_rev_s, 0.8 * speed); // two cycles more
    ticks(300);
    EXPECT_NEAR(speed_rev_s, 0.0, 1e-3);
    EXPECT_LT(rotor_rev - from, speed * 0.012 + speed * speed / 2.0 / 90.0 + speed * 0.015);
}

TEST_F(PositionLoop, targets_that_are_late_find_the_speed_of_those_before) {
    for (const uint32_t cycle_ms : {1u, 2u, 4u, 7u, 20u}) {
        const double cycle_s = 1e-3 * cycle_ms;
        double target = rotor_rev;
        for (int k = 0; k * cycle_s < 0.5; k++) {
            target += 2.0 * cycle_s * std::min(1.0, k * cycle_s / 0.1);
            cyclic(target, cycle_ms);
            ticks(int(cycle_ms));
        }
        const double at = double(position.profile.start.x) / REV_48;
        for (uint32_t tick = 1; tick <= 2 * cycle_ms - 1; tick++) {
            ticks(1);
            EXPECT_NEAR(double(position.profile.start.x) / REV_48, at + 2e-3 * tick, 1e-7) << cycle_ms << ", " << tick;
        }
        ticks(300);
        EXPECT_NEAR(speed_rev_s, 0.0, 1e-3);
    }
}

// A jump, and targets of which some come a tick late: the reference is soon where the targets are, and stays within the
// limits.
TEST_F(PositionLoop, targets_that_move_on_are_caught_up_with) {
    std::mt19937 random(3);
    int64_t speed = 0, acceleration = 0;
    for (const int cycle_ms : {1, 2, 5, 10, 20}) {
        for (const int jitter : {0, 1}) {
            const double cycle_s = 1e-3 * cycle_ms;
            double target = rotor_rev - 0.3, worst = 0.0;
            int late = 0;
            for (int k = 0; k * cycle_s < 2.0; k++) {
                target += 4.0 * cycle_s;
                cyclic(target, uint32_t(cycle_ms));
                const int next = cycle_ms > 1 ? jitter * int(random() % 2) : 0;
                for (int tick = late; tick < cycle_ms + next; tick++) {
                    ticks(1);
                    speed = std::max(speed, std::abs(position.profile.end.v));
                    acceleration = std::max(acceleration, std::abs(position.profile.end.a));
                }
                late = next;
                const double behind = target - double(position.profile.start.x) / REV_48;
                worst = k * cycle_s > 1.0 ? std::max(worst, std::fabs(behind)) : worst;
            }
            EXPECT_LT(worst, 4.0 * (jitter * 0.003 + 0.0011)) << cycle_ms << ", " << jitter;
            ticks(500);
        }
    }
    EXPECT_LE(acceleration, parameters.plan.limits.acceleration + parameters.plan.limits.acceleration / 1000);
    EXPECT_LE(speed, parameters.plan.limits.speed);
}

TEST_F(PositionLoop, targets_that_become_faster_than_the_limit_are_followed_at_the_limit_and_reached_when_they_stand) {
    for (const double sign : {1.0, -1.0}) {
        position = {};
        rotor_rev = speed_rev_s = 0.0;
        position_set_point_t set_point = {};
        set_point.order = POSITION_ORDER_CYCLIC;
        set_point.speed_q22 = 10 << 22; // 1.59 rev/s
        double target = 0.0, fastest = 0.0;
        for (int k = 0; k < 400; k++) {
            target += sign * 0.004 * (k < 150 ? std::min(1.9, 0.02 * k) : 0.0);
            send(set_point, target);
            for (int n = 0; n < 4; n++) {
                ticks(1);
                fastest = std::max(fastest, sign * double(position.profile.end.v));
            }
        }
        const double limit = double(command.limits.speed);
        EXPECT_LT(fastest, 1.01 * limit) << sign;
        EXPECT_GT(fastest, 0.98 * limit) << sign;
        EXPECT_NEAR(double(position.profile.end.x) / REV_48, target, 1e-6) << sign;
    }
}

TEST_F(PositionLoop, a_following_error_is_a_controlled_stop_until_a_halt) {
    highest_rev = 2.0;
    order(POSITION_ORDER_PROFILE, 5.0);
    ticks(1000);
    EXPECT_TRUE(position.status.following_error);
    EXPECT_LT(std::fabs(out.speed_q22 / 4194304.0), 1.0); // does not press on
    EXPECT_LT(std::fabs(double(position.status.error)), 0.13 * REV_32);
    order(POSITION_ORDER_PROFILE, 0.0);
    ticks(500);
    EXPECT_TRUE(position.status.following_error);
    EXPECT_NEAR(rotor_rev, 2.0, 0.01);
    order(POSITION_ORDER_HALT, 0.0);
    ticks(5);
    EXPECT_FALSE(position.status.following_error);
    order(POSITION_ORDER_PROFILE, 0.0);
    ticks(1000);
    EXPECT_NEAR(rotor_rev, 0.0, 1e-6);
    order(POSITION_ORDER_HALT, 0.0);
    ticks(5);
    rotor_rev += 0.2; // while it holds
    ticks(5);
    EXPECT_TRUE(position.status.following_error);
    order(POSITION_ORDER_HALT, 0.0);
    ticks(5);
    EXPECT_TRUE(position.status.following_error) << "a sender that repeats its order has not seen it";
    command.set_point.acknowledges = true;
    ticks(5);
    EXPECT_TRUE(position.status.following_error);
    command.set_point.sequence++;
    ticks(5);
    EXPECT_FALSE(position.status.following_error);
}

TEST_F(PositionLoop, homing_here_calls_the_place_the_target_and_moves_nothing) {
    order(POSITION_ORDER_HOME, 7.0);
    ticks(20);
    EXPECT_NEAR(rotor_rev, 0.25, 1e-5);
    EXPECT_NEAR(position_rev(), 7.0, 1e-5);
    EXPECT_TRUE(position.status.homed);
    EXPECT_FALSE(position.status.homing || position.status.homing_failed);
    order(POSITION_ORDER_PROFILE, 8.0);
    ticks(1000);
    EXPECT_NEAR(rotor_rev, 1.25, 1e-5);
}

TEST_F(PositionLoop, homing_by_the_index_returns_to_it_from_either_side) {
    for (const position_homing_t method : {POSITION_HOMING_INDEX_FORWARD, POSITION_HOMING_INDEX_BACKWARD}) {
        order(POSITION_ORDER_HALT, 0.0);
        ticks(2);
        order(POSITION_ORDER_PROFILE, position_rev() + 0.3); // off the index
        ticks(800);
        const double before = rotor_rev;
        order(POSITION_ORDER_HOME, -3.0, method);
        ticks(1500);
        EXPECT_TRUE(position.status.homed) << method;
        EXPECT_FALSE(position.status.homing || position.status.homing_failed) << method;
        EXPECT_NEAR(rotor_rev, method == POSITION_HOMING_INDEX_FORWARD ? std::ceil(before) : std::floor(before), 1e-5);
        EXPECT_NEAR(position_rev(), -3.0, 1e-5);
    }
}

TEST_F(PositionLoop, homing_by_a_stop_finds_it_and_holds_there) {
    lowest_rev = -1.4;
    order(POSITION_ORDER_HOME, 0.5, POSITION_HOMING_STOP_BACKWARD);
    ticks(10);
    EXPECT_TRUE(position.status.homing && position_seeks_stop(&position));
    ticks(1400);
    EXPECT_TRUE(position.status.homed);
    EXPECT_FALSE(position.status.homing || position.status.homing_failed || position.status.following_error);
    EXPECT_NEAR(position_rev(), 0.5, 1e-4);
    order(POSITION_ORDER_PROFILE, 1.5);
    ticks(1000);
    EXPECT_NEAR(rotor_rev, -0.4, 1e-4);
}

TEST_F(PositionLoop, a_homing_by_the_index_that_meets_a_stop_has_failed_and_does_not_press_against_it) {
    for (const position_homing_t method : {POSITION_HOMING_INDEX_FORWARD, POSITION_HOMING_INDEX_BACKWARD}) {
        position = {};
        parameters.law.following_error = int64_t(REV_48);
        speed_rev_s = 0.0;
        rotor_rev = 0.5;
        highest_rev = 0.7;
        lowest_rev = 0.3;
        order(POSITION_ORDER_HOME, 3.0, method);
        ticks(20);
        EXPECT_TRUE(position.status.homing && position_seeks_stop(&position));
        ticks(500);
        EXPECT_TRUE(position.status.homing_failed) << method;
        EXPECT_FALSE(position.status.homed || position.status.homing || position.status.following_error) << method;
        EXPECT_NEAR(rotor_rev, method == POSITION_HOMING_INDEX_FORWARD ? 0.7 : 0.3, 1e-5);
        EXPECT_NEAR(double(position.status.error) / REV_32, 0.0, 1e-4) << method;
        EXPECT_NEAR(out.speed_q22 / 4194304.0, 0.0, 0.1) << method;
        EXPECT_NEAR(position_rev(), rotor_rev, 1e-5) << "the zero is the old one";
    }
}

TEST_F(PositionLoop, a_homing_that_has_failed_is_not_found_by_a_following_error) {
    order(POSITION_ORDER_HOME, 0.0, POSITION_HOMING_STOP_FORWARD);
    ticks(50);
    order(POSITION_ORDER_HALT, 0.0);
    ticks(300);
    ASSERT_TRUE(position.status.homing_failed);
    rotor_rev += 0.3;
    ticks(3);
    EXPECT_TRUE(position.status.following_error);
    EXPECT_TRUE(position.status.homing_failed);
    // One that returns ends with it; one that has been found stays found.
    for (const bool returns : {true, false}) {
        position = {};
        rotor_rev = 0.25;
        speed_rev_s = 0.0;
        order(POSITION_ORDER_HOME, 0.0, POSITION_HOMING_INDEX_FORWARD);
        for (int k = 0; k < 1000 && position.homing != POSITION_HOMING_RETURNS; k++) {
            ticks(1);
        }
        ASSERT_EQ(position.homing, POSITION_HOMING_RETURNS);
        ticks(returns ? 0 : 1000);
        EXPECT_EQ(position.status.homing, returns);
        rotor_rev += 0.3;
        ticks(3);
        EXPECT_TRUE(position.status.following_error);
        EXPECT_EQ(position.status.homing_failed, returns);
        EXPECT_FALSE(position.status.homing);
    }
}

// A bit of the step that flips leads to a stop by the profile, not beyond the target. [SR-51]
TEST_F(PositionLoop, a_step_of_a_homing_that_is_none_stops) {
    order(POSITION_ORDER_HOME, 0.0, POSITION_HOMING_STOP_FORWARD);
    ticks(100);
    ASSERT_GT(speed_rev_s, 1.0);
    position.homing = static_cast<position_homing_step_t>(POSITION_HOMING_RETURNS + 2);
    ticks(500);
    EXPECT_NEAR(speed_rev_s, 0.0, 1e-3);
    EXPECT_TRUE(position.stops);
}

TEST_F(PositionLoop, a_homing_by_a_stop_counts_its_50_ms_anew_after_one_that_was_given_up) {
    lowest_rev = rotor_rev;
    for (unsigned trial = 0; trial < 2; trial++) {
        order(POSITION_ORDER_HOME, 0.5, POSITION_HOMING_STOP_BACKWARD);
        ticks(45);
        ASSERT_TRUE(position.status.homing) << trial;
        if (trial == 0) {
            order(POSITION_ORDER_HALT, 0.0);
            ticks(2);
        }
    }
    ticks(10);
    EXPECT_TRUE(position.status.homed);
    EXPECT_FALSE(position.status.homing || position.status.homing_failed);
}

TEST_F(PositionLoop, a_rotor_that_is_held_again_and_again_for_less_than_50_ms_is_at_no_stop) {
    const double far_rev = lowest_rev;
    order(POSITION_ORDER_HOME, 0.5, POSITION_HOMING_STOP_BACKWARD);
    for (unsigned hold = 0; hold < 5; hold++) {
        lowest_rev = rotor_rev;
        ticks(30);
        lowest_rev = far_rev;
        ticks(10);
        ASSERT_TRUE(position.status.homing) << hold;
        ASSERT_FALSE(position.status.homed) << hold;
    }
    lowest_rev = rotor_rev;
    ticks(60);
    EXPECT_TRUE(position.status.homed);
}

TEST_F(PositionLoop, a_homing_that_another_order_or_the_end_of_the_run_interrupts_has_failed) {
    order(POSITION_ORDER_HOME, 0.0, POSITION_HOMING_STOP_FORWARD);
    ticks(50);
    order(POSITION_ORDER_HALT, 0.0);
    ticks(300);
    EXPECT_TRUE(position.status.homing_failed);
    EXPECT_FALSE(position.status.homed);
    EXPECT_NEAR(speed_rev_s, 0.0, 1e-3);
    order(POSITION_ORDER_HOME, 0.0, POSITION_HOMING_STOP_FORWARD);
    ticks(50);
    EXPECT_FALSE(position.status.homing_failed);
    const position_sample_t now = sample();
    position_follow(&position, now.encoder_angle, now.angle);
    EXPECT_TRUE(position.status.homing_failed);
}

TEST_F(PositionLoop, any_set_points_keep_the_limits_and_the_formats) {
    std::mt19937_64 random(5);
    highest_rev = 200.0;
    lowest_rev = -200.0;
    for (int k = 0; k < 3000; k++) {
        position_set_point_t set_point = {};
        set_point.order = position_order_t(random() % 4);
        set_point.homing = position_homing_t(random() % 6);
        set_point.sequence = uint32_t(random());
        set_point.target = random() % 8 ? int64_t(random() >> (random() % 34)) : random() % 2 ? INT64_MIN : INT64_MAX;
        set_point.speed_q22 = int32_t(random());
        set_point.acceleration_rpm_s = int32_t(random() >> (random() % 32));
        set_point.jerk_rpm_s2 = int32_t(random());
        set_point.cycle_ms = uint32_t(random() >> (random() % 64));
        set_point.bounded = random() % 2;
        set_point.lowest = std::min(int64_t(random()), int64_t(random())) >> (2 + random() % 40);
        set_point.highest = set_point.lowest + int64_t(random() >> (2 + random() % 40));
        command = position_command(&parameters, &set_point, 1 << 14, 1 << 14);
        ticks(1 + int(random() % 8));
        ASSERT_LE(std::abs(position.profile.end.v), PROFILE_SPEED_MAX);
        ASSERT_LE(std::abs(position.profile.end.x), PROFILE_POSITION_MAX);
        ASSERT_LE(std::abs(position.status.position), POSITION_MAX + POSITION_ONE_REV);
    }
}

TEST_F(PositionLoop, the_end_of_the_range_of_positions_begins_a_new_one) {
    const position_sample_t now = sample();
    position_follow(&position, now.encoder_angle, now.angle);
    position.counted = POSITION_MAX - 10;
    position.zero = 0;
    position.status.homed = true;
    for (int k = 0; k < 10; k++) {
        rotor_rev += 0.1;
        const position_sample_t next = sample();
        position_follow(&position, next.encoder_angle, next.angle);
        ASSERT_LE(std::abs(position.status.position), POSITION_MAX + POSITION_ONE_REV);
    }
    for (int k = 0; k < 10; k++) {
        rotor_rev += 0.1;
        const position_sample_t next = sample();
        position_follow(&position, next.encoder_angle, next.angle);
    }
    EXPECT_FALSE(position.status.homed);
    EXPECT_LT(position_rev(), 2.0);
}

TEST_F(PositionLoop, the_last_position_of_the_range_is_held) {
    position_settings_t wide = settings();
    wide.lowest_rev = -8192;
    parameters = position_configure(&wide);
    step();
    order(POSITION_ORDER_HOME, -8191.9);
    ticks(20);
    const double end = rotor_rev - 0.1;
    order(POSITION_ORDER_PROFILE, -8192.0);
    ticks(500);
    EXPECT_NEAR(rotor_rev, end, 1e-5);
    rotor_rev -= 0.02; // as a load would
    double slowest = 0.0;
    for (int k = 0; k < 100; k++) {
        ticks(1);
        slowest = std::min(slowest, speed_rev_s);
    }
    EXPECT_GT(slowest, -0.01);
    EXPECT_NEAR(rotor_rev, end, 1e-4);
    EXPECT_NEAR(position_rev(), -8192.0, 1e-4);
    EXPECT_TRUE(position.status.homed && !position.status.following_error);
}

TEST_F(PositionLoop, a_stop_is_sought_at_the_speed_of_the_homing_beyond_the_range) {
    step();
    position.zero = position.counted - POSITION_MAX; // it begins at the end
    order(POSITION_ORDER_HALT, 0.0);
    const position_sample_t now = sample();
    position_follow(&position, now.encoder_angle, now.angle);
    ticks(2);
    order(POSITION_ORDER_HOME, 0.0, POSITION_HOMING_STOP_FORWARD);
    double fastest = 0.0;
    for (int k = 0; k < 2000; k++) {
        ticks(1);
        fastest = std::max(fastest, std::fabs(speed_rev_s));
    }
    EXPECT_LT(fastest, 2.1);
    highest_rev = rotor_rev + 0.5;
    ticks(1000);
    EXPECT_TRUE(position.status.homed && !position.status.homing_failed);
    EXPECT_NEAR(position_rev(), 0.0, 1e-4);
}

} // namespace
