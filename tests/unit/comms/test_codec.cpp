// The generated codec: setters hold a value at the end of its signal's range instead of cutting bits off.
#include <cstdint>

#include <gtest/gtest.h>

extern "C" {
#include "drive_codec.h"
}

namespace {

TEST(Codec, setters_saturate_at_the_ends_of_a_signed_signal) {
    drive_motion_t message{};
    for (const auto &[raw, expected] : {std::pair<int64_t, int32_t>{0, 0},
                                        {8388607, 8388607},
                                        {8388608, 8388607},
                                        {-8388608, -8388608},
                                        {-8388609, -8388608},
                                        {INT64_MAX, 8388607},
                                        {INT64_MIN, -8388608}}) {
        drive_motion_set_speed_rpm(&message, raw);
        EXPECT_EQ(message.speed_rpm, expected);
    }
}

TEST(Codec, setters_saturate_at_the_range_of_the_dbc_where_it_is_narrower) {
    drive_command_t message{};
    drive_command_set_speed_reference_rpm(&message, 3000001);
    EXPECT_EQ(message.speed_reference_rpm, 3000000);
    drive_command_set_speed_reference_rpm(&message, -3000001);
    EXPECT_EQ(message.speed_reference_rpm, -3000000);
    drive_command_set_request(&message, 4);
    EXPECT_EQ(message.request, 3);
    drive_heartbeat_t heartbeat{};
    drive_heartbeat_set_phases(&heartbeat, 0);
    EXPECT_EQ(heartbeat.phases, 1);
    drive_heartbeat_set_control_rate_hz(&heartbeat, 1000000);
    EXPECT_EQ(heartbeat.control_rate_hz, 1000000u);
    drive_heartbeat_set_controller(&heartbeat, 3);
    EXPECT_EQ(heartbeat.controller, 2);
}

TEST(Codec, setters_carry_32_unsigned_bits) {
    drive_status_t message{};
    drive_status_set_time_us(&message, UINT32_MAX);
    EXPECT_EQ(message.time_us, UINT32_MAX);
    drive_status_set_time_us(&message, int64_t(UINT32_MAX) + 1);
    EXPECT_EQ(message.time_us, UINT32_MAX);
    drive_status_set_time_us(&message, -1);
    EXPECT_EQ(message.time_us, 0u);
}

TEST(Codec, a_frame_lies_as_the_dbc_says) {
    drive_motion_t message{};
    drive_motion_set_speed_rpm(&message, -2);
    drive_motion_set_speed_reference_rpm(&message, 0x123456);
    drive_motion_set_rotor_angle_deg(&message, 0xABCD);
    uint8_t data[8];
    ASSERT_EQ(drive_motion_pack(data, &message, sizeof data), 8);
    const uint8_t expected[8] = {0xFE, 0xFF, 0xFF, 0x56, 0x34, 0x12, 0xCD, 0xAB};
    for (int i = 0; i < 8; i++) {
        EXPECT_EQ(data[i], expected[i]) << i;
    }
    EXPECT_LT(drive_motion_pack(data, &message, 7), 0);
}

} // namespace
