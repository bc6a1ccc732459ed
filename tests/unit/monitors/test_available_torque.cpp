// Available torque: the smallest limit of each direction is named, exactly. [SR-09]
#include <gtest/gtest.h>

extern "C" {
#include "monitors/available_torque.h"
}

namespace {

constexpr int32_t LARGEST_Q24 = 19 << 24, SPEED_Q22 = 60 << 22;

available_torque_input_t healthy() {
    available_torque_input_t input = {};
    input.run = input.four_quadrant = true;
    input.speed_q22 = SPEED_Q22;
    input.largest_q24 = LARGEST_Q24;
    input.by_voltage_q24[0] = input.by_voltage_q24[1] = LARGEST_Q24;
    input.by_link_q24 = input.by_degraded_q24 = INT32_MAX;
    input.by_heat_q24 = LARGEST_Q24;
    return input;
}

void expect_side(const available_torque_side_t &side, int32_t torque_q24, torque_limit_t limit) {
    EXPECT_EQ(side.torque_q24, torque_q24);
    EXPECT_EQ(side.limited_by, limit);
}

TEST(AvailableTorque, is_the_largest_torque_without_another_limit) {
    const available_torque_input_t input = healthy();
    const available_torque_t available = available_torque(&input);
    expect_side(available.forward, LARGEST_Q24, TORQUE_LIMIT_CURRENT);
    expect_side(available.backward, LARGEST_Q24, TORQUE_LIMIT_CURRENT);
    EXPECT_FALSE(available.load_exceeds);
}

TEST(AvailableTorque, one_quadrant_has_none_backwards) {
    available_torque_input_t input = healthy();
    input.four_quadrant = false;
    input.by_voltage_q24[1] = 0;
    const available_torque_t available = available_torque(&input);
    expect_side(available.forward, LARGEST_Q24, TORQUE_LIMIT_CURRENT);
    expect_side(available.backward, 0, TORQUE_LIMIT_CONTROLLER);
}

TEST(AvailableTorque, each_direction_has_the_voltage_limit_of_its_own) {
    available_torque_input_t input = healthy();
    input.by_voltage_q24[0] = LARGEST_Q24 - 1;
    input.by_voltage_q24[1] = 3 << 24;
    const available_torque_t available = available_torque(&input);
    expect_side(available.forward, LARGEST_Q24 - 1, TORQUE_LIMIT_VOLTAGE);
    expect_side(available.backward, 3 << 24, TORQUE_LIMIT_VOLTAGE);
}

// [SR-09] [SR-14]
TEST(AvailableTorque, the_link_limits_the_torque_against_the_speed_only) {
    for (const int32_t speed_q22 : {SPEED_Q22, -SPEED_Q22}) {
        available_torque_input_t input = healthy();
        input.speed_q22 = speed_q22;
        input.by_link_q24 = 1 << 20;
        const available_torque_t available = available_torque(&input);
        const bool forward = speed_q22 < 0;
        expect_side(forward ? available.forward : available.backward, 1 << 20, TORQUE_LIMIT_DC_LINK);
        expect_side(forward ? available.backward : available.forward, LARGEST_Q24, TORQUE_LIMIT_CURRENT);
    }
}

// [SR-09] [SR-14]
TEST(AvailableTorque, a_link_that_fills_up_is_named_for_what_the_voltage_takes_against_the_speed) {
    available_torque_input_t input = healthy();
    input.link_fills = true;
    input.by_voltage_q24[0] = input.by_voltage_q24[1] = 5 << 24;
    const available_torque_t available = available_torque(&input);
    expect_side(available.forward, 5 << 24, TORQUE_LIMIT_VOLTAGE);
    expect_side(available.backward, 5 << 24, TORQUE_LIMIT_DC_LINK);
}

TEST(AvailableTorque, heat_and_a_lost_phase_limit_both_and_the_smaller_one_is_named) {
    available_torque_input_t input = healthy();
    input.by_heat_q24 = 7 << 24;
    available_torque_t available = available_torque(&input);
    expect_side(available.forward, 7 << 24, TORQUE_LIMIT_HEAT);
    expect_side(available.backward, 7 << 24, TORQUE_LIMIT_HEAT);
    input.by_degraded_q24 = (7 << 24) - 1;
    available = available_torque(&input);
    expect_side(available.forward, (7 << 24) - 1, TORQUE_LIMIT_DEGRADED);
    input.by_degraded_q24 = 7 << 24;
    expect_side(available_torque(&input).forward, 7 << 24, TORQUE_LIMIT_HEAT);
}

TEST(AvailableTorque, a_load_exceeds_it_from_a_sixteenth_of_the_largest_torque_on_in_a_run) {
    available_torque_input_t input = healthy();
    input.by_link_q24 = 1 << 24;
    for (const int32_t beyond : {LARGEST_Q24 / 16, LARGEST_Q24 / 16 + 1}) {
        const bool exceeds = beyond > LARGEST_Q24 / 16;
        input.load_torque_q24 = LARGEST_Q24 + beyond;
        EXPECT_EQ(available_torque(&input).load_exceeds, exceeds);
        input.load_torque_q24 = -(1 << 24) - beyond;
        EXPECT_EQ(available_torque(&input).load_exceeds, exceeds);
    }
    input.run = false;
    EXPECT_FALSE(available_torque(&input).load_exceeds);
    input.run = true;
    input.largest_q24 = INT32_MAX;
    input.load_torque_q24 = INT32_MIN;
    EXPECT_TRUE(available_torque(&input).load_exceeds);
}

TEST(AvailableTorque, at_standstill_neither_direction_brakes) {
    available_torque_input_t input = healthy();
    input.speed_q22 = 0;
    input.by_link_q24 = 1 << 20;
    input.link_fills = true;
    available_torque_t available = available_torque(&input);
    expect_side(available.forward, LARGEST_Q24, TORQUE_LIMIT_CURRENT);
    expect_side(available.backward, LARGEST_Q24, TORQUE_LIMIT_CURRENT);
    input.by_voltage_q24[0] = input.by_voltage_q24[1] = 5 << 24;
    available = available_torque(&input);
    expect_side(available.forward, 5 << 24, TORQUE_LIMIT_VOLTAGE);
    expect_side(available.backward, 5 << 24, TORQUE_LIMIT_VOLTAGE);
}

} // namespace
