// Received frames: each passes all checks or changes nothing but the counter of the check that rejected it.
#include <cmath>
#include <cstring>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "comms/commands.h"
#include "comms/counter.h"
#include "drive_codec.h"
}
#include "support/frames.h"

namespace {

constexpr uint32_t TIMEOUT_US = 100000;

hal_can_frame_t command_frame(uint8_t counter, unsigned request = COMMAND_RUN, int32_t milli_rpm = 600000) {
    return frames::command(counter, request, milli_rpm);
}

class Commands : public testing::Test {
  protected:
    Commands() { commands_init(&commands); }

    commands_frame_t receive(const hal_can_frame_t &frame, uint32_t time_us = 1000) {
        return commands_receive(&commands, &frame, time_us, &command);
    }

    // The frame is rejected, *counter rises by one, and nothing else that matters changes.
    void expect_rejected(const hal_can_frame_t &frame, uint16_t *counter, uint32_t time_us = 1000) {
        const commands_counters_t counters_before = commands.counters;
        const command_t command_before = command;
        const uint16_t before = *counter;
        ASSERT_EQ(receive(frame, time_us), COMMANDS_REJECTED);
        ASSERT_EQ(*counter, before + 1);
        *counter = before;
        ASSERT_EQ(std::memcmp(&counters_before, &commands.counters, sizeof counters_before), 0);
        *counter = uint16_t(before + 1);
        ASSERT_EQ(std::memcmp(&command_before, &command, sizeof command), 0);
    }

    commands_t commands;
    command_t command{};
};

TEST_F(Commands, a_valid_command_is_accepted) {
    EXPECT_EQ(receive(command_frame(7, COMMAND_RUN, 600000), 12345), COMMANDS_COMMAND);
    EXPECT_EQ(command.request, COMMAND_RUN);
    EXPECT_NEAR(command.speed_reference_q22 / 4194304.0, 600 * 2 * M_PI / 60, 1e-6);
    EXPECT_EQ(command.time_us, 12345u);
    EXPECT_EQ(commands.counters.accepted, 1);
}

TEST_F(Commands, a_reference_has_a_sign_and_is_symmetric) {
    uint8_t counter = 0;
    for (const int32_t milli_rpm : {1, 1000, 150000, 599999, 3000000}) {
        ASSERT_EQ(receive(command_frame(++counter, COMMAND_RUN, milli_rpm)), COMMANDS_COMMAND);
        const int32_t forwards_q22 = command.speed_reference_q22;
        ASSERT_EQ(receive(command_frame(++counter, COMMAND_RUN, -milli_rpm)), COMMANDS_COMMAND);
        EXPECT_GT(forwards_q22, 0);
        EXPECT_NEAR(command.speed_reference_q22, -forwards_q22, 1) << milli_rpm; // halves round upwards
    }
}

TEST_F(Commands, the_message_of_the_last_command_is_the_mode) {
    ASSERT_EQ(receive(command_frame(7)), COMMANDS_COMMAND);
    EXPECT_EQ(command.mode, DRIVE_MODE_SPEED);
    ASSERT_EQ(receive(frames::torque_command(200, COMMAND_RUN, -(19 << 16) - 1), 12345), COMMANDS_COMMAND);
    EXPECT_EQ(command.mode, DRIVE_MODE_TORQUE);
    EXPECT_EQ(command.request, COMMAND_RUN);
    EXPECT_EQ(command.torque_reference_q24, -(19 << 24) - 256);
    EXPECT_EQ(command.time_us, 12345u);
    ASSERT_EQ(receive(command_frame(8)), COMMANDS_COMMAND) << "each message has a counter of its own";
    EXPECT_EQ(command.mode, DRIVE_MODE_SPEED);
    EXPECT_EQ(commands.counters.accepted, 3);
}

TEST_F(Commands, a_torque_command_has_the_whole_range_of_its_bits) {
    uint8_t counter = 0;
    for (const int32_t torque_q16 : {0, 1, -1, 0x7FFFFF, -0x800000}) {
        ASSERT_EQ(receive(frames::torque_command(++counter, COMMAND_RUN, torque_q16)), COMMANDS_COMMAND);
        EXPECT_EQ(command.torque_reference_q24, torque_q16 * 256);
    }
}

TEST_F(Commands, a_torque_command_is_protected_as_a_speed_command) {
    receive(frames::torque_command(1, COMMAND_RUN, 0));
    for (unsigned bit = 0; bit < 8 * DRIVE_TORQUE_COMMAND_LENGTH; bit++) {
        hal_can_frame_t frame = frames::torque_command(2, COMMAND_RUN, 5 << 16);
        frame.data[bit / 8] = uint8_t(frame.data[bit / 8] ^ (1u << bit % 8));
        expect_rejected(frame, &commands.counters.wrong_checksum);
    }
    expect_rejected(frames::torque_command(1, COMMAND_RUN, 0), &commands.counters.wrong_counter);
    expect_rejected(frames::torque_command(5, COMMAND_RUN, 0), &commands.counters.wrong_counter);
    expect_rejected(frames::torque_command(2, COMMAND_CLEAR_FAULT + 1, 0), &commands.counters.out_of_range);
    hal_can_frame_t other = command_frame(3);
    other.identifier = DRIVE_TORQUE_COMMAND_FRAME_ID;
    expect_rejected(other, &commands.counters.wrong_checksum); // a speed is no torque: another data ID
    for (int length = 0; length < 16; length++) {
        hal_can_frame_t frame = frames::torque_command(3, COMMAND_RUN, 0);
        frame.length = uint8_t(length);
        if (length != DRIVE_TORQUE_COMMAND_LENGTH) {
            expect_rejected(frame, &commands.counters.wrong_length);
        }
    }
    EXPECT_EQ(receive(frames::torque_command(3, COMMAND_RUN, 0)), COMMANDS_COMMAND);
}

TEST_F(Commands, every_wrong_length_is_rejected) {
    for (int length = 0; length < 16; length++) {
        hal_can_frame_t frame = command_frame(1);
        frame.length = uint8_t(length);
        if (length != DRIVE_COMMAND_LENGTH) {
            expect_rejected(frame, &commands.counters.wrong_length);
        }
        frame.identifier = DRIVE_PARAMETER_REQUEST_FRAME_ID;
        std::memset(frame.data, 0, sizeof frame.data);
        if (length != DRIVE_PARAMETER_REQUEST_LENGTH) {
            expect_rejected(frame, &commands.counters.wrong_length);
        }
    }
}

TEST_F(Commands, every_unknown_standard_identifier_is_rejected) {
    for (uint32_t identifier = 0; identifier < 0x800; identifier++) {
        hal_can_frame_t frame = command_frame(1);
        frame.identifier = identifier;
        frame.length = 8;
        if (identifier != DRIVE_COMMAND_FRAME_ID && identifier != DRIVE_TORQUE_COMMAND_FRAME_ID &&
            identifier != DRIVE_PARAMETER_REQUEST_FRAME_ID) {
            expect_rejected(frame, &commands.counters.unknown_frame);
        }
    }
}

TEST_F(Commands, extended_frames_are_rejected_with_any_identifier) {
    std::mt19937 random(4);
    for (int i = 0; i < 10000; i++) {
        hal_can_frame_t frame = command_frame(1);
        frame.extended = true;
        frame.identifier = i == 0 ? DRIVE_COMMAND_FRAME_ID : random() & 0x1FFFFFFFu;
        expect_rejected(frame, &commands.counters.unknown_frame);
    }
}

TEST_F(Commands, remote_frames_are_rejected) {
    for (const uint32_t identifier : {DRIVE_COMMAND_FRAME_ID, DRIVE_PARAMETER_REQUEST_FRAME_ID, 0x123u}) {
        hal_can_frame_t frame = command_frame(1);
        frame.remote = true;
        frame.identifier = identifier;
        expect_rejected(frame, &commands.counters.unknown_frame);
    }
}

TEST_F(Commands, a_damaged_command_is_rejected) {
    receive(command_frame(1));
    for (unsigned bit = 0; bit < 8 * DRIVE_COMMAND_LENGTH; bit++) {
        hal_can_frame_t frame = command_frame(2);
        frame.data[bit / 8] = uint8_t(frame.data[bit / 8] ^ (1u << bit % 8));
        expect_rejected(frame, &commands.counters.wrong_checksum);
    }
    EXPECT_EQ(receive(command_frame(2)), COMMANDS_COMMAND);
}

TEST_F(Commands, repeated_and_jumped_counters_are_rejected) {
    receive(command_frame(1));
    expect_rejected(command_frame(1), &commands.counters.wrong_counter);
    expect_rejected(command_frame(5), &commands.counters.wrong_counter);
    expect_rejected(command_frame(0), &commands.counters.wrong_counter);
    EXPECT_EQ(receive(command_frame(4)), COMMANDS_COMMAND);
}

TEST_F(Commands, every_request_beyond_the_last_is_rejected) {
    uint8_t counter = 0;
    for (unsigned request = 0; request < 256; request++) {
        const hal_can_frame_t frame = command_frame(++counter, request);
        if (request <= COMMAND_CLEAR_FAULT) {
            EXPECT_EQ(receive(frame), COMMANDS_COMMAND);
            EXPECT_EQ(command.request, request);
        } else {
            expect_rejected(frame, &commands.counters.out_of_range);
        }
    }
}

TEST_F(Commands, a_speed_beyond_the_range_is_rejected) {
    uint8_t counter = 0;
    for (const int32_t milli_rpm : {3000000, -3000000, 0}) {
        EXPECT_EQ(receive(command_frame(++counter, COMMAND_RUN, milli_rpm)), COMMANDS_COMMAND);
    }
    for (const int32_t milli_rpm : {3000001, -3000001, 8388607, -8388608}) {
        expect_rejected(command_frame(++counter, COMMAND_RUN, milli_rpm), &commands.counters.out_of_range);
    }
}

TEST_F(Commands, a_parameter_request_with_a_reserved_bit_is_rejected) {
    hal_can_frame_t frame{};
    frame.identifier = DRIVE_PARAMETER_REQUEST_FRAME_ID;
    frame.length = DRIVE_PARAMETER_REQUEST_LENGTH;
    EXPECT_EQ(receive(frame), COMMANDS_PARAMETER_REQUEST);
    for (int bit = 0; bit < 8; bit++) {
        frame.data[3] = uint8_t(1 << bit);
        expect_rejected(frame, &commands.counters.out_of_range);
    }
}

TEST_F(Commands, after_a_timeout_a_sender_may_start_with_any_counter) {
    receive(command_frame(1), 5000);
    commands_check_timeout(&commands, 5000 + TIMEOUT_US, TIMEOUT_US);
    expect_rejected(command_frame(100), &commands.counters.wrong_counter, 5000 + TIMEOUT_US);
    commands_check_timeout(&commands, 5000 + TIMEOUT_US + 1, TIMEOUT_US);
    EXPECT_EQ(receive(command_frame(100), 5000 + TIMEOUT_US + 1), COMMANDS_COMMAND);
}

TEST_F(Commands, a_command_of_either_message_restarts_the_timeout_of_both) {
    receive(command_frame(1), 0);
    receive(frames::torque_command(1, COMMAND_RUN, 0), TIMEOUT_US);
    commands_check_timeout(&commands, 2 * TIMEOUT_US, TIMEOUT_US);
    EXPECT_EQ(receive(command_frame(2), 2 * TIMEOUT_US), COMMANDS_COMMAND);
    expect_rejected(frames::torque_command(77, COMMAND_RUN, 0), &commands.counters.wrong_counter, 2 * TIMEOUT_US);
    commands_check_timeout(&commands, 3 * TIMEOUT_US + 1, TIMEOUT_US);
    EXPECT_EQ(receive(frames::torque_command(77, COMMAND_RUN, 0), 3 * TIMEOUT_US + 1), COMMANDS_COMMAND);
}

TEST_F(Commands, the_timeout_is_measured_across_the_wrap_of_the_clock) {
    const uint32_t before_wrap = UINT32_MAX - 500;
    receive(command_frame(1), before_wrap);
    commands_check_timeout(&commands, before_wrap + 1000, TIMEOUT_US);
    EXPECT_TRUE(commands.receiver.synchronised);
    commands_check_timeout(&commands, before_wrap + TIMEOUT_US + 1, TIMEOUT_US);
    EXPECT_FALSE(commands.receiver.synchronised);
}

TEST_F(Commands, rejected_frames_do_not_restart_the_timeout) {
    receive(command_frame(1), 0);
    hal_can_frame_t damaged = command_frame(2);
    damaged.data[4] ^= 1;
    receive(damaged, TIMEOUT_US - 1);
    receive(command_frame(50), TIMEOUT_US);
    commands_check_timeout(&commands, TIMEOUT_US + 1, TIMEOUT_US);
    EXPECT_FALSE(commands.receiver.synchronised);
}

TEST_F(Commands, random_frames_are_rejected) {
    std::mt19937 random(5);
    unsigned accepted = 0;
    for (int i = 0; i < 100000; i++) {
        hal_can_frame_t frame{};
        frame.identifier = DRIVE_COMMAND_FRAME_ID;
        frame.length = DRIVE_COMMAND_LENGTH;
        for (uint8_t &byte : frame.data) {
            byte = uint8_t(random());
        }
        accepted += receive(frame) == COMMANDS_COMMAND;
    }
    // One in 65536 has the right checksum; most of those are out of sequence or out of range.
    EXPECT_LE(accepted, 1u);
    EXPECT_GE(commands.counters.wrong_checksum, 65535);
}

TEST(Counter, saturates) {
    uint16_t counter = 65533;
    counter_add(&counter, 1);
    EXPECT_EQ(counter, 65534);
    counter_add(&counter, 5);
    EXPECT_EQ(counter, 65535);
    counter_add(&counter, 1);
    EXPECT_EQ(counter, 65535);
    counter_add(&counter, ~0u);
    EXPECT_EQ(counter, 65535);
    counter = 0;
    counter_add(&counter, ~0u);
    EXPECT_EQ(counter, 65535);
}

} // namespace
