// Conversions between the drive's formats and the LSBs of the bus, against double precision over their whole range.
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "comms/units.h"
}

#include "support/wide_integer.h"

namespace {

constexpr double PI = 3.14159265358979323846;
constexpr double MILLI_RPM_PER_LSB = 60000.0 / (2.0 * PI) / 4194304.0; // of Q9.22 rad/s

TEST(Units, milli_rpm_is_the_nearest) {
    std::mt19937 random(2);
    for (int i = 0; i < 200000; i++) {
        const auto speed = int32_t(uint32_t(random()));
        ASSERT_LE(std::fabs(units_milli_rpm(speed) - speed * MILLI_RPM_PER_LSB), 0.501) << speed;
    }
    EXPECT_EQ(units_milli_rpm(0), 0);
    EXPECT_EQ(units_milli_rpm(INT32_MAX), 4889240);
    EXPECT_EQ(units_milli_rpm(INT32_MIN), -4889240);
}

TEST(Units, speed_q22_is_the_nearest_and_saturates) {
    std::mt19937 random(3);
    std::uniform_int_distribution<int32_t> in_range(-4889239, 4889239);
    for (int i = 0; i < 200000; i++) {
        const int32_t milli_rpm = in_range(random);
        ASSERT_LE(std::fabs(units_speed_q22(milli_rpm) - milli_rpm / MILLI_RPM_PER_LSB), 0.61) << milli_rpm;
    }
    EXPECT_EQ(units_speed_q22(0), 0);
    for (const int32_t beyond : {4889241, 8388607, INT32_MAX}) {
        EXPECT_EQ(units_speed_q22(beyond), INT32_MAX);
        EXPECT_EQ(units_speed_q22(-beyond), INT32_MIN);
    }
    EXPECT_EQ(units_speed_q22(INT32_MIN), INT32_MIN);
}

TEST(Units, a_commanded_speed_survives_both_ways) {
    for (int32_t milli_rpm = -3000000; milli_rpm <= 3000000; milli_rpm += 7) {
        ASSERT_EQ(units_milli_rpm(units_speed_q22(milli_rpm)), milli_rpm);
    }
}

TEST(Units, quarter_rpm_rounds_halves_up) {
    for (int32_t milli_rpm = -10000; milli_rpm <= 10000; milli_rpm++) {
        ASSERT_EQ(units_quarter_rpm(milli_rpm), int32_t(std::floor(milli_rpm / 250.0 + 0.5))) << milli_rpm;
    }
    EXPECT_EQ(units_quarter_rpm(INT32_MAX), 8589935);
    EXPECT_EQ(units_quarter_rpm(INT32_MIN), -8589935);
}

TEST(Units, angle_rounds_and_wraps) {
    EXPECT_EQ(units_angle_u16(0), 0);
    EXPECT_EQ(units_angle_u16(0x7FFF), 0);
    EXPECT_EQ(units_angle_u16(0x8000), 1);
    EXPECT_EQ(units_angle_u16(0x80000000u), 0x8000);
    EXPECT_EQ(units_angle_u16(0xFFFF7FFFu), 0xFFFF);
    EXPECT_EQ(units_angle_u16(0xFFFF8000u), 0);
}

TEST(Units, torque_is_the_nearest) {
    EXPECT_EQ(units_torque_q8(0), 0);
    EXPECT_EQ(units_torque_q8(0x7FFF), 0);
    EXPECT_EQ(units_torque_q8(0x8000), 1);
    EXPECT_EQ(units_torque_q8(-0x8000), 0);
    EXPECT_EQ(units_torque_q8(-0x8001), -1);
    EXPECT_EQ(units_torque_q8(INT32_MIN), -32768);
    EXPECT_EQ(units_torque_q8(INT32_MAX), 32768);
}

// Every conversion by a power of two, over the whole range: to nearest, halves towards plus infinity.
TEST(Units, angles_deviations_and_torques_are_the_nearest_for_any_value) {
    using namespace wide_integer;
    std::mt19937 random(4);
    for (int i = 0; i < 200000; i++) {
        const int32_t value = any(random);
        ASSERT_EQ(units_angle_u16(uint32_t(value)), uint16_t(nearest(uint32_t(value), power_of_2(16)))) << value;
        ASSERT_EQ(units_deviation_q20(value), int32_t(nearest(value, power_of_2(12)))) << value;
        ASSERT_EQ(units_torque_q8(value), int32_t(nearest(value, power_of_2(16)))) << value;
        const int32_t of_24_bits = value >> 8;
        ASSERT_EQ(units_torque_q24(of_24_bits), int64_t(of_24_bits) * 256);
        ASSERT_EQ(units_quarter_rpm(value), int32_t(nearest(value, 250))) << value;
    }
    EXPECT_EQ(units_deviation_q20(INT32_MAX), 1 << 19);
    EXPECT_EQ(units_deviation_q20(INT32_MIN), -(1 << 19));
}

} // namespace
