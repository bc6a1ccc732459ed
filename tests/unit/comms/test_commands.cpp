// Received frames: each passes all checks or changes nothing but the counter of the check that rejected it. [SR-32]
#include <cmath>
#include <cstring>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "comms/arming.h"
#include "comms/commands.h"
#include "comms/counter.h"
#include "control/machine_tables.h"
#include "drive_codec.h"
#include "hal_random.h"
#include "storage/parameters.h"
}
#include "support/frames.h"

// Its random numbers count up.
struct hal {
    uint32_t random = 0x12345678;
};

extern "C" uint32_t hal_random_u32(hal_t *hal) {
    return hal->random++;
}

namespace {

constexpr uint32_t TIMEOUT_US = 100000;

hal_can_frame_t command_frame(uint8_t counter, unsigned request = COMMAND_RUN, int32_t milli_rpm = 600000) {
    return frames::command(counter, request, milli_rpm);
}

class Commands : public testing::Test {
  protected:
    Commands() { commands_init(&commands); }

    commands_frame_t receive(const hal_can_frame_t &frame, uint32_t time_us = 1000) {
        return commands_receive(&commands, &hal, &frame, time_us, TIMEOUT_US, &command);
    }

    void supervise(drive_state_t state, uint32_t time_us) { commands_supervise(&commands, state, time_us, TIMEOUT_US); }

    // Time of the background's last round is the frame's.
    commands_frame_t take(const hal_can_frame_t &frame, drive_state_t state, uint32_t time_us) {
        supervise(state, time_us);
        return receive(frame, time_us);
    }

    // Arms in READY for a sender whose last command has this counter, a run; the last frame at time_us.
    void arm(uint8_t counter, uint32_t time_us) {
        take(command_frame(counter), DRIVE_STATE_READY, time_us - 1000);
        ASSERT_EQ(take(frames::arm(7, ARMING_STEP_REQUEST_RUN), DRIVE_STATE_READY, time_us - 1000), COMMANDS_ACCEPTED);
        ASSERT_EQ(take(frames::arm(8, ARMING_STEP_CONFIRM_RUN, ~commands.arming.challenge), DRIVE_STATE_READY, time_us),
                  COMMANDS_COMMAND);
        ASSERT_TRUE(commands.arming.armed);
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

    hal_t hal;
    commands_t commands;
    command_t command{};
};

TEST_F(Commands, a_valid_command_is_accepted) {
    EXPECT_EQ(receive(command_frame(7, COMMAND_STOP, 600000), 12345), COMMANDS_COMMAND);
    EXPECT_EQ(command.request, COMMAND_STOP);
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

TEST_F(Commands, a_position_command_has_its_order_and_target_and_each_is_a_new_one) {
    const uint32_t before = command.position.sequence;
    ASSERT_EQ(receive(frames::position_command(1, COMMAND_STOP, POSITION_ORDER_HALT, -(3 << 18))), COMMANDS_COMMAND);
    EXPECT_EQ(command.request, COMMAND_STOP);
    EXPECT_EQ(command.mode, DRIVE_MODE_POSITION);
    EXPECT_EQ(command.position.order, POSITION_ORDER_HALT);
    EXPECT_EQ(command.position.target, -3 * POSITION_ONE_REV);
    EXPECT_EQ(command.position.homing, POSITION_HOMING_METHODS) << "the parameter's";
    EXPECT_EQ(command.position.sequence, before + 1);
    ASSERT_EQ(receive(frames::position_command(2, COMMAND_STOP, POSITION_ORDER_HALT, -(3 << 18))), COMMANDS_COMMAND);
    EXPECT_EQ(command.position.sequence, before + 2) << "an equal target is one more";
}

TEST_F(Commands, a_position_command_beyond_the_last_request_or_order_is_rejected) {
    expect_rejected(frames::position_command(1, COMMAND_CLEAR_FAULT + 1, POSITION_ORDER_HALT, 0),
                    &commands.counters.out_of_range);
    expect_rejected(frames::position_command(2, COMMAND_OFF, POSITION_ORDER_HALT + 1, 0),
                    &commands.counters.out_of_range);
}

// [SR-34]
TEST_F(Commands, a_request_to_arm_of_an_armed_drive_is_refused_and_leaves_it_armed) {
    arm(1, 10000);
    const uint32_t challenge = commands.arming.challenge;
    EXPECT_EQ(take(frames::arm(9, ARMING_STEP_REQUEST_RUN), DRIVE_STATE_READY, 11000), COMMANDS_REJECTED);
    EXPECT_TRUE(commands.arming.armed);
    EXPECT_EQ(commands.arming.challenge, challenge) << "none is drawn";
    EXPECT_EQ(commands.arming.attempt, ARMING_ATTEMPT_NONE);
}

// [SR-34]
TEST_F(Commands, an_experiment_needs_arming_and_has_its_window) {
    ASSERT_EQ(receive(frames::identify_window(1, 0x1234, 0x56)), COMMANDS_COMMAND);
    ASSERT_EQ(receive(frames::identify_command(2, COMMAND_RUN, IDENTIFY_KIND_PULSE, 2, 9)), COMMANDS_COMMAND);
    EXPECT_EQ(command.request, COMMAND_OFF);
    EXPECT_EQ(commands.counters.run_unarmed, 1);
    arm(3, 10000);
    ASSERT_EQ(take(frames::identify_command(4, COMMAND_RUN, IDENTIFY_KIND_PULSE, 2, 9), DRIVE_STATE_READY, 11000),
              COMMANDS_COMMAND);
    EXPECT_EQ(command.request, COMMAND_IDENTIFY);
    EXPECT_EQ(command.time_us, 11000u);
    EXPECT_EQ(commands.identify.kind, IDENTIFY_KIND_PULSE);
    EXPECT_EQ(commands.identify.phase, 2);
    EXPECT_EQ(commands.identify.number, 9);
    EXPECT_EQ(commands.identify.level_q12, 1234);
    EXPECT_EQ(commands.identify.time_ms, 56);
    EXPECT_EQ(commands.identify.angle_q16, 0x1234);
    EXPECT_EQ(commands.identify.width_q16, 0x56);
    take(frames::identify_command(5, COMMAND_OFF, IDENTIFY_KIND_REST, 0), DRIVE_STATE_RUN, 12000);
    EXPECT_EQ(command.request, COMMAND_OFF);
    EXPECT_FALSE(commands.arming.armed);
}

TEST_F(Commands, an_experiment_out_of_range_changes_nothing) {
    receive(frames::identify_command(1, COMMAND_OFF, IDENTIFY_KIND_HOLD, 1));
    const identify_command_t before = commands.identify;
    expect_rejected(frames::identify_command(2, COMMAND_OFF, IDENTIFY_KIND_FREEWHEEL + 1, 1),
                    &commands.counters.out_of_range);
    expect_rejected(frames::identify_command(3, COMMAND_OFF, IDENTIFY_KIND_PULSE, machine_tables.phases),
                    &commands.counters.out_of_range);
    hal_can_frame_t shorter = frames::identify_command(4, COMMAND_OFF, IDENTIFY_KIND_PULSE, 1);
    shorter.length = DRIVE_COMMAND_LENGTH;
    expect_rejected(shorter, &commands.counters.wrong_length);
    hal_can_frame_t longer = command_frame(4);
    longer.length = DRIVE_IDENTIFY_COMMAND_LENGTH;
    expect_rejected(longer, &commands.counters.wrong_length);
    EXPECT_EQ(std::memcmp(&before, &commands.identify, sizeof before), 0);
}

TEST_F(Commands, a_run_does_not_become_one_of_experiments_nor_the_other_way_round) {
    arm(3, 10000);
    take(command_frame(4), DRIVE_STATE_READY, 11000);
    supervise(DRIVE_STATE_RUN, 12000);
    expect_rejected(frames::identify_command(5, COMMAND_RUN, IDENTIFY_KIND_PULSE, 0), &commands.counters.out_of_range,
                    12000);
    EXPECT_EQ(command.request, COMMAND_RUN);
    take(command_frame(6, COMMAND_OFF), DRIVE_STATE_RUN, 13000);
    supervise(DRIVE_STATE_READY, 14000);
    arm(7, 30000);
    take(frames::identify_command(8, COMMAND_RUN, IDENTIFY_KIND_PULSE, 0), DRIVE_STATE_READY, 31000);
    supervise(DRIVE_STATE_RUN, 32000);
    expect_rejected(command_frame(9), &commands.counters.out_of_range, 32000);
    expect_rejected(frames::torque_command(10, COMMAND_RUN, 0), &commands.counters.out_of_range, 32000);
    EXPECT_EQ(command.request, COMMAND_IDENTIFY);
}

TEST_F(Commands, the_message_of_the_last_command_is_the_mode) {
    ASSERT_EQ(receive(command_frame(7)), COMMANDS_COMMAND);
    EXPECT_EQ(command.mode, DRIVE_MODE_SPEED);
    ASSERT_EQ(receive(frames::torque_command(8, COMMAND_STOP, -(19 << 16) - 1), 12345), COMMANDS_COMMAND);
    EXPECT_EQ(command.mode, DRIVE_MODE_TORQUE);
    EXPECT_EQ(command.request, COMMAND_STOP);
    EXPECT_EQ(command.torque_reference_q24, -(19 << 24) - 256);
    EXPECT_EQ(command.time_us, 12345u);
    ASSERT_EQ(receive(command_frame(9)), COMMANDS_COMMAND) << "both messages have one counter";
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
            identifier != DRIVE_POSITION_COMMAND_FRAME_ID && identifier != DRIVE_IDENTIFY_COMMAND_FRAME_ID &&
            identifier != DRIVE_IDENTIFY_WINDOW_FRAME_ID && identifier != DRIVE_ARM_FRAME_ID &&
            identifier != DRIVE_PARAMETER_WRITE_FRAME_ID && identifier != DRIVE_PARAMETER_SET_CONTROL_FRAME_ID &&
            identifier != DRIVE_PARAMETER_REQUEST_FRAME_ID && identifier != DRIVE_XCP_COMMAND_FRAME_ID) {
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
            EXPECT_EQ(command.request, request == COMMAND_RUN ? COMMAND_OFF : request) << "not armed";
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

// [SR-05]
TEST_F(Commands, after_a_timeout_a_sender_may_start_with_any_counter) {
    receive(command_frame(1), 5000);
    supervise(DRIVE_STATE_READY, 5000 + TIMEOUT_US);
    expect_rejected(command_frame(100), &commands.counters.wrong_counter, 5000 + TIMEOUT_US);
    supervise(DRIVE_STATE_READY, 5000 + TIMEOUT_US + 1);
    EXPECT_EQ(receive(command_frame(100), 5000 + TIMEOUT_US + 1), COMMANDS_COMMAND);
}

// [SR-05]
TEST_F(Commands, a_command_of_either_message_restarts_the_timeout_of_both) {
    receive(command_frame(1), 0);
    receive(frames::torque_command(2, COMMAND_RUN, 0), TIMEOUT_US);
    supervise(DRIVE_STATE_READY, 2 * TIMEOUT_US);
    EXPECT_EQ(receive(command_frame(3), 2 * TIMEOUT_US), COMMANDS_COMMAND);
    expect_rejected(frames::torque_command(77, COMMAND_RUN, 0), &commands.counters.wrong_counter, 2 * TIMEOUT_US);
    supervise(DRIVE_STATE_READY, 3 * TIMEOUT_US + 1);
    EXPECT_EQ(receive(frames::torque_command(77, COMMAND_RUN, 0), 3 * TIMEOUT_US + 1), COMMANDS_COMMAND);
}

// [SR-05]
TEST_F(Commands, the_timeout_is_measured_across_the_wrap_of_the_clock) {
    const uint32_t before_wrap = UINT32_MAX - 500;
    receive(command_frame(1), before_wrap);
    supervise(DRIVE_STATE_READY, before_wrap + 1000);
    EXPECT_TRUE(commands.receiver.synchronised);
    supervise(DRIVE_STATE_READY, before_wrap + TIMEOUT_US + 1);
    EXPECT_FALSE(commands.receiver.synchronised);
}

// [SR-05]
TEST_F(Commands, rejected_frames_do_not_restart_the_timeout) {
    receive(command_frame(1), 0);
    hal_can_frame_t damaged = command_frame(2);
    damaged.data[4] ^= 1;
    receive(damaged, TIMEOUT_US - 1);
    receive(command_frame(50), TIMEOUT_US);
    supervise(DRIVE_STATE_READY, TIMEOUT_US + 1);
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

// [SR-34]
TEST_F(Commands, a_run_is_off_until_the_drive_is_armed_and_then_takes_effect_at_once) {
    supervise(DRIVE_STATE_READY, 900);
    EXPECT_EQ(receive(command_frame(1), 1000), COMMANDS_COMMAND);
    EXPECT_EQ(command.request, COMMAND_OFF);
    EXPECT_EQ(commands.counters.run_unarmed, 1);
    EXPECT_EQ(receive(frames::arm(7, ARMING_STEP_REQUEST_RUN), 2000), COMMANDS_ACCEPTED);
    EXPECT_EQ(commands.arming.challenge, 0x12345678u);
    EXPECT_EQ(commands.arming.attempt, ARMING_ATTEMPT_RUN);
    EXPECT_EQ(receive(frames::arm(8, ARMING_STEP_CONFIRM_RUN, ~0x12345678u), 3000), COMMANDS_COMMAND);
    EXPECT_EQ(command.request, COMMAND_RUN);
    EXPECT_EQ(command.time_us, 1000u) << "the age is the command's";
    EXPECT_EQ(commands.arming.attempt, ARMING_ATTEMPT_NONE);
    EXPECT_EQ(commands.arming.challenge, 0u);
    EXPECT_EQ(receive(command_frame(2), 4000), COMMANDS_COMMAND);
    EXPECT_EQ(command.request, COMMAND_RUN);
    EXPECT_EQ(commands.counters.run_unarmed, 1);
    EXPECT_EQ(commands.arming.refused, 0);
}

// [SR-34]
TEST_F(Commands, every_other_sequence_of_arming_is_refused) {
    const uint32_t challenge = 0x12345678;
    const auto refused = [&](uint8_t counter, unsigned step, uint32_t response, uint32_t after_us,
                             drive_state_t state = DRIVE_STATE_READY) {
        commands_init(&commands);
        hal.random = challenge;
        take(command_frame(1), DRIVE_STATE_READY, 1000);
        take(frames::arm(7, ARMING_STEP_REQUEST_RUN), DRIVE_STATE_READY, 2000);
        EXPECT_EQ(commands.arming.challenge, challenge);
        EXPECT_EQ(take(frames::arm(counter, step, response), state, 2000 + after_us), COMMANDS_REJECTED);
        EXPECT_EQ(commands.arming.refused, 1);
        EXPECT_FALSE(commands.arming.armed);
        // The challenge has been used: the right response comes too late.
        EXPECT_EQ(take(frames::arm(8, ARMING_STEP_CONFIRM_RUN, ~challenge), DRIVE_STATE_READY, 2000 + after_us + 1),
                  COMMANDS_REJECTED);
        EXPECT_FALSE(commands.arming.armed);
    };
    refused(8, ARMING_STEP_CONFIRM_RUN, challenge, 1000);                        // the challenge itself
    refused(8, ARMING_STEP_CONFIRM_RUN, ~challenge ^ 1, 1000);                   // wrong response
    refused(8, ARMING_STEP_CONFIRM_RUN, 0, 1000);                                // none
    refused(7, ARMING_STEP_CONFIRM_RUN, ~challenge, 1000);                       // counter of the request
    refused(9, ARMING_STEP_CONFIRM_RUN, ~challenge, 1000);                       // a frame is missing
    refused(8, ARMING_STEP_CONFIRM_RUN, ~challenge, ARMING_RESPONSE_MIN_US - 1); // cannot have read it
    refused(8, ARMING_STEP_CONFIRM_RUN, ~challenge, ARMING_RESPONSE_MAX_US + 1);
    refused(8, ARMING_STEP_CONFIRM_RUN, ~challenge, 1000, DRIVE_STATE_FAULT);
    refused(8, ARMING_STEP_CONFIRM_RUN, ~challenge, 1000, DRIVE_STATE_RUN);
}

// [SR-34]
TEST_F(Commands, a_response_is_too_late_after_a_whole_round_of_the_clock_as_well) {
    take(command_frame(1), DRIVE_STATE_READY, 1000);
    take(frames::arm(7, ARMING_STEP_REQUEST_RUN), DRIVE_STATE_READY, 2000);
    const uint32_t challenge = commands.arming.challenge;
    supervise(DRIVE_STATE_READY, 60000000);
    EXPECT_EQ(commands.arming.attempt, ARMING_ATTEMPT_NONE) << "which DRIVE_ARMING reports";
    take(command_frame(2), DRIVE_STATE_READY, 2500);
    EXPECT_EQ(take(frames::arm(8, ARMING_STEP_CONFIRM_RUN, ~challenge), DRIVE_STATE_READY, 3000), COMMANDS_REJECTED);
    EXPECT_FALSE(commands.arming.armed);
}

// [SR-34]
TEST_F(Commands, arming_without_a_living_sender_of_commands_is_refused) {
    take(frames::arm(7, ARMING_STEP_REQUEST_RUN), DRIVE_STATE_READY, 2000);
    EXPECT_EQ(take(frames::arm(8, ARMING_STEP_CONFIRM_RUN, ~commands.arming.challenge), DRIVE_STATE_READY, 3000),
              COMMANDS_REJECTED);
    take(command_frame(1), DRIVE_STATE_READY, 20000);
    take(frames::arm(7, ARMING_STEP_REQUEST_RUN), DRIVE_STATE_READY, 20000 + TIMEOUT_US - 1000);
    EXPECT_EQ(take(frames::arm(8, ARMING_STEP_CONFIRM_RUN, ~commands.arming.challenge), DRIVE_STATE_READY,
                   20000 + TIMEOUT_US + 1),
              COMMANDS_REJECTED);
    EXPECT_FALSE(commands.arming.armed);
}

// [SR-34]
TEST_F(Commands, a_recorded_command_after_a_reset_is_not_armed_by_the_living_sender_whose_own_was_refused_meanwhile) {
    take(command_frame(20), DRIVE_STATE_READY, 1000); // recorded
    take(frames::arm(7, ARMING_STEP_REQUEST_RUN), DRIVE_STATE_READY, 2000);
    EXPECT_EQ(take(command_frame(28), DRIVE_STATE_READY, 3000), COMMANDS_REJECTED);
    EXPECT_EQ(take(frames::arm(8, ARMING_STEP_CONFIRM_RUN, ~commands.arming.challenge), DRIVE_STATE_READY, 4000),
              COMMANDS_REJECTED);
    EXPECT_FALSE(commands.arming.armed);
    uint8_t counter = 29;
    for (; receive(command_frame(counter), 3000 + (counter - 28u) * 10000) != COMMANDS_COMMAND; counter++) {
        ASSERT_LT(counter, 50);
    }
    arm(uint8_t(counter + 1), 3000 + (counter - 26u) * 10000);
}

// [SR-34]
TEST_F(Commands, a_recording_that_goes_on_after_a_reset_is_not_armed_by_the_living_sender_until_one_of_them_is_silent) {
    for (uint32_t silence_us : {COMMANDS_SENDER_LOST_US - 1, COMMANDS_SENDER_LOST_US}) {
        commands_init(&commands);
        take(command_frame(20), DRIVE_STATE_READY, 1000); // recorded
        EXPECT_EQ(take(command_frame(29), DRIVE_STATE_READY, 2000), COMMANDS_REJECTED);
        take(frames::arm(7, ARMING_STEP_REQUEST_RUN), DRIVE_STATE_READY, 2000);
        take(command_frame(21), DRIVE_STATE_READY, 2000 + silence_us); // recorded
        const bool silent = silence_us == COMMANDS_SENDER_LOST_US;
        EXPECT_EQ(take(frames::arm(8, ARMING_STEP_CONFIRM_RUN, ~commands.arming.challenge), DRIVE_STATE_READY,
                       2000 + silence_us),
                  silent ? COMMANDS_COMMAND : COMMANDS_REJECTED);
        EXPECT_EQ(commands.arming.armed, silent);
    }
}

// [SR-34]
TEST_F(Commands, a_recording_of_a_whole_sequence_arms_nothing) {
    hal.random = 99;
    const hal_can_frame_t recorded[] = {command_frame(1), frames::arm(7, ARMING_STEP_REQUEST_RUN),
                                        frames::arm(8, ARMING_STEP_CONFIRM_RUN, ~99u), command_frame(2),
                                        command_frame(3)};
    uint32_t time_us = 1000;
    for (int replay = 0; replay < 200; replay++) {
        for (const hal_can_frame_t &frame : recorded) {
            take(frame, DRIVE_STATE_READY, time_us += 1000);
            EXPECT_EQ(command.request == COMMAND_RUN, replay == 0 && commands.arming.armed);
        }
        EXPECT_EQ(commands.arming.armed, replay == 0);
        if (replay == 50) {
            commands_init(&commands); // a reset: the random numbers go on
        }
        time_us += 600000;
    }
    EXPECT_GE(commands.arming.refused, 149);
}

// [SR-34]
TEST_F(Commands, challenges_are_drawn_ten_milliseconds_apart_at_most) {
    const uint32_t first = hal.random;
    for (uint32_t time_us = 100000; time_us < 200000; time_us += 100) {
        take(frames::arm(7, ARMING_STEP_REQUEST_RUN), DRIVE_STATE_READY, time_us);
    }
    EXPECT_EQ(hal.random - first, 10u);
}

// [SR-34]
TEST_F(Commands, a_damaged_arming_frame_is_counted_and_changes_nothing) {
    for (unsigned bit = 0; bit < 8 * DRIVE_ARM_LENGTH; bit++) {
        hal_can_frame_t frame = frames::arm(7, ARMING_STEP_REQUEST_RUN);
        frame.data[bit / 8] = uint8_t(frame.data[bit / 8] ^ (1u << bit % 8));
        expect_rejected(frame, &commands.counters.wrong_checksum);
    }
    for (int length = 0; length < 16; length++) {
        hal_can_frame_t frame = frames::arm(7, ARMING_STEP_REQUEST_RUN);
        frame.length = uint8_t(length);
        if (length != DRIVE_ARM_LENGTH) {
            expect_rejected(frame, &commands.counters.wrong_length);
        }
    }
    EXPECT_EQ(commands.arming.attempt, ARMING_ATTEMPT_NONE);
    for (unsigned step = ARMING_STEP_COUNT; step < 256; step++) {
        EXPECT_EQ(receive(frames::arm(7, step)), COMMANDS_REJECTED);
    }
    EXPECT_EQ(commands.arming.refused, 256 - ARMING_STEP_COUNT);
}

// [SR-52]
TEST_F(Commands, a_bit_that_flips_in_what_arms_neither_arms_nor_leaves_armed) {
    for (const bool armed : {false, true}) {
        for (uint8_t *each : {&commands.arming.armed, &commands.arming.configuring}) {
            for (unsigned bit = 0; bit < 8; bit++) {
                commands_init(&commands);
                if (armed) {
                    arm(1, 10000);
                }
                *each = uint8_t(*each ^ 1u << bit);
                const uint8_t byte = *each;
                supervise(DRIVE_STATE_READY, 11000);
                EXPECT_FALSE(commands.arming.configuring) << armed << bit;
                EXPECT_FALSE(commands.arming.armed && (!armed || byte == 0)) << armed << bit;
                EXPECT_TRUE(commands.arming.changed || armed) << "is told";
            }
        }
    }
}

// [SR-52]
TEST_F(Commands, a_bit_that_flips_in_the_check_of_the_arming_disarms) {
    for (unsigned bit = 0; bit < 16; bit++) {
        commands_init(&commands);
        arm(1, 10000);
        commands.arming.check = uint16_t(commands.arming.check ^ 1u << bit);
        supervise(DRIVE_STATE_READY, 11000);
        EXPECT_FALSE(commands.arming.armed) << bit;
    }
}

// [SR-34]
TEST_F(Commands, an_arming_for_configuration_that_ends_is_reported_and_one_that_there_is_not_does_not_end) {
    commands.arming.changed = false;
    arming_end_configuration(&commands.arming);
    EXPECT_FALSE(commands.arming.changed);
    take(frames::arm(7, ARMING_STEP_REQUEST_CONFIGURATION), DRIVE_STATE_READY, 2000);
    take(frames::arm(8, ARMING_STEP_CONFIRM_CONFIGURATION, ~commands.arming.challenge), DRIVE_STATE_READY, 3000);
    ASSERT_TRUE(commands.arming.configuring);
    commands.arming.changed = false;
    supervise(DRIVE_STATE_READY, 3000 + ARMING_CONFIGURATION_US);
    EXPECT_TRUE(commands.arming.configuring);
    EXPECT_FALSE(commands.arming.changed);
    supervise(DRIVE_STATE_READY, 3001 + ARMING_CONFIGURATION_US);
    EXPECT_FALSE(commands.arming.configuring);
    EXPECT_TRUE(commands.arming.changed);
}

// [SR-35]
TEST_F(Commands, what_disarms) {
    const auto disarms = [&](const auto &event) {
        commands_init(&commands);
        arm(1, 10000);
        take(command_frame(2), DRIVE_STATE_READY, 11000);
        EXPECT_EQ(command.request, COMMAND_RUN);
        event();
        supervise(commands.state, 12000);
        return !commands.arming.armed;
    };
    const auto in_run = [&](const auto &event) {
        return disarms([&] {
            supervise(DRIVE_STATE_RUN, 11500);
            event();
        });
    };
    EXPECT_FALSE(disarms([] {}));
    EXPECT_FALSE(in_run([] {}));
    EXPECT_FALSE(in_run([&] { receive(command_frame(3, COMMAND_STOP), 12000); })) << "a stop is part of the run";
    EXPECT_TRUE(in_run([&] { receive(command_frame(3, COMMAND_OFF), 12000); }));
    EXPECT_FALSE(in_run([&] { receive(command_frame(3, COMMAND_CLEAR_FAULT), 12000); })) << "refused, one error";
    EXPECT_TRUE(in_run([&] { supervise(DRIVE_STATE_FAULT, 12000); }));
    EXPECT_TRUE(disarms([&] { supervise(DRIVE_STATE_FAULT, 11500); })) << "before the run has begun";
    EXPECT_TRUE(in_run([&] { supervise(DRIVE_STATE_READY, 12000); })) << "the end of a stop";
    EXPECT_TRUE(disarms([&] { receive(command_frame(3, COMMAND_OFF), 12000); }));
    EXPECT_TRUE(disarms([&] { receive(command_frame(3, COMMAND_STOP), 12000); }));
    EXPECT_TRUE(disarms([&] { commands_disarm(&commands); }));
    EXPECT_FALSE(disarms([&] { supervise(DRIVE_STATE_READY, 11000 + TIMEOUT_US); }));
    EXPECT_TRUE(disarms([&] { supervise(DRIVE_STATE_READY, 11000 + TIMEOUT_US + 1); }));
    EXPECT_FALSE(in_run([&] { supervise(DRIVE_STATE_RUN, 11000 + COMMAND_LOST_US); }));
    EXPECT_TRUE(in_run([&] { supervise(DRIVE_STATE_RUN, 11000 + COMMAND_LOST_US + 1); }));
    EXPECT_TRUE(in_run([&] { commands_init(&commands); })) << "reset";
    // Each of them takes a new sequence: one command does not run.
    receive(command_frame(4), 13000);
    EXPECT_EQ(command.request, COMMAND_OFF);
}

// [SR-35]
TEST_F(Commands, what_disarms_ends_an_attempt_to_arm_for_a_run_and_none_to_arm_for_configuration) {
    for (const bool run : {true, false}) {
        commands_init(&commands);
        take(command_frame(1), DRIVE_STATE_READY, 10000);
        take(frames::arm(7, run ? ARMING_STEP_REQUEST_RUN : ARMING_STEP_REQUEST_CONFIGURATION), DRIVE_STATE_READY,
             11000);
        const uint32_t response = ~commands.arming.challenge;
        arming_disarm(&commands.arming);
        take(frames::arm(8, run ? ARMING_STEP_CONFIRM_RUN : ARMING_STEP_CONFIRM_CONFIGURATION, response),
             DRIVE_STATE_READY, 12000);
        EXPECT_FALSE(commands.arming.armed) << run;
        EXPECT_EQ(commands.arming.configuring != 0, !run);
    }
}

// [SR-32] [SR-56]
TEST_F(Commands, a_frame_of_a_set_with_an_index_or_a_step_that_there_is_not_is_out_of_range) {
    const struct {
        bool control;
        unsigned index, end;
    } cases[] = {{false, PARAMETER_COUNT - 1, PARAMETER_COUNT},
                 {false, PARAMETER_COUNT, PARAMETER_COUNT},
                 {false, 255, PARAMETER_COUNT},
                 {true, PARAMETER_SET_STEP_SAVE, PARAMETER_SET_STEP_SAVE + 1},
                 {true, PARAMETER_SET_STEP_SAVE + 1, PARAMETER_SET_STEP_SAVE + 1}};
    for (const auto &[control, index, end] : cases) {
        commands_init(&commands);
        take(frames::arm(7, ARMING_STEP_REQUEST_CONFIGURATION), DRIVE_STATE_READY, 11000);
        take(frames::arm(8, ARMING_STEP_CONFIRM_CONFIGURATION, ~commands.arming.challenge), DRIVE_STATE_READY, 12000);
        ASSERT_TRUE(commands.arming.configuring);
        const hal_can_frame_t frame =
            control ? frames::parameter_set_control(9, index) : frames::parameter_write(9, index, 0);
        const bool there = index < end;
        EXPECT_EQ(take(frame, DRIVE_STATE_READY, 12000), there ? COMMANDS_PARAMETER_SET : COMMANDS_REJECTED) << index;
        EXPECT_EQ(commands.counters.out_of_range, there ? 0 : 1) << index;
    }
}

// [SR-34]
TEST_F(Commands, an_arming_begins_without_errors_use_or_run_of_the_one_before) {
    arm(1, 10000);
    for (unsigned i = 0; i + 1 < COMMANDS_ERRORS_MAX; i++) {
        take(command_frame(99), DRIVE_STATE_RUN, 11000);
    }
    ASSERT_EQ(commands.errors, (COMMANDS_ERRORS_MAX - 1) * COMMANDS_ERROR_STEP);
    take(command_frame(2, COMMAND_OFF), DRIVE_STATE_RUN, 12000);
    ASSERT_FALSE(commands.arming.armed);
    ASSERT_FALSE(commands.failed);
    // Armed by a sender that is still off; what came out of sequence before has to be forgotten.
    uint32_t time_us = 12000 + COMMANDS_SENDER_LOST_US;
    take(command_frame(3, COMMAND_OFF), DRIVE_STATE_READY, time_us);
    take(frames::arm(7, ARMING_STEP_REQUEST_RUN), DRIVE_STATE_READY, time_us);
    take(frames::arm(8, ARMING_STEP_CONFIRM_RUN, ~commands.arming.challenge), DRIVE_STATE_READY, time_us + 1000);
    for (uint8_t counter = 4; counter < 10; counter++) {
        take(command_frame(counter, COMMAND_OFF), DRIVE_STATE_READY, time_us += 10000);
        ASSERT_TRUE(commands.arming.armed) << "no run has been requested since";
    }
    take(command_frame(10), DRIVE_STATE_READY, time_us + 1000);
    for (unsigned i = 0; i + 1 < COMMANDS_ERRORS_MAX; i++) {
        take(command_frame(99), DRIVE_STATE_RUN, time_us + 2000);
        EXPECT_FALSE(commands.failed) << i;
    }
    EXPECT_TRUE(commands.arming.armed);
}

// [SR-34]
TEST_F(Commands, a_frame_that_comes_twice_does_not_prevent_the_arming) {
    take(command_frame(1), DRIVE_STATE_READY, 1000);
    EXPECT_EQ(take(command_frame(1), DRIVE_STATE_READY, 2000), COMMANDS_REJECTED);
    take(frames::arm(7, ARMING_STEP_REQUEST_RUN), DRIVE_STATE_READY, 3000);
    EXPECT_EQ(take(frames::arm(8, ARMING_STEP_CONFIRM_RUN, ~commands.arming.challenge), DRIVE_STATE_READY, 4000),
              COMMANDS_COMMAND);
    EXPECT_TRUE(commands.arming.armed);
}

// [SR-34] [SR-36]
TEST_F(Commands, a_second_sender_of_71_minutes_ago_does_not_prevent_the_arming) {
    take(command_frame(1), DRIVE_STATE_READY, 1000);
    EXPECT_EQ(take(command_frame(50), DRIVE_STATE_READY, 2000), COMMANDS_REJECTED);
    for (uint32_t quarter = 0; quarter < 4; quarter++) {
        supervise(DRIVE_STATE_READY, 2000 + (quarter << 30)); // silence
    }
    take(command_frame(2), DRIVE_STATE_READY, 2100); // the clock has come round
    take(frames::arm(7, ARMING_STEP_REQUEST_RUN), DRIVE_STATE_READY, 2100);
    EXPECT_EQ(take(frames::arm(8, ARMING_STEP_CONFIRM_RUN, ~commands.arming.challenge), DRIVE_STATE_READY, 3100),
              COMMANDS_COMMAND);
}

// [SR-35]
TEST_F(Commands, armed_without_a_request_to_run_lasts_half_a_second) {
    take(command_frame(0, COMMAND_OFF), DRIVE_STATE_READY, 1000);
    take(frames::arm(7, ARMING_STEP_REQUEST_RUN), DRIVE_STATE_READY, 2000);
    take(frames::arm(8, ARMING_STEP_CONFIRM_RUN, ~commands.arming.challenge), DRIVE_STATE_READY, 3000);
    uint8_t counter = 0;
    for (uint32_t time_us = 10000; time_us <= 3000 + COMMANDS_ARMED_UNUSED_US; time_us += 10000) {
        take(command_frame(++counter, COMMAND_OFF), DRIVE_STATE_READY, time_us);
        ASSERT_TRUE(commands.arming.armed) << time_us;
    }
    take(command_frame(++counter), DRIVE_STATE_READY, 3001 + COMMANDS_ARMED_UNUSED_US);
    EXPECT_FALSE(commands.arming.armed);
    EXPECT_EQ(command.request, COMMAND_OFF);
}

// [SR-33]
TEST_F(Commands, four_bad_frames_in_succession_are_a_fault_and_three_are_none) {
    hal_can_frame_t damaged = command_frame(50), too_short = command_frame(50);
    damaged.data[5] ^= 1;
    too_short.length = 6;
    for (const hal_can_frame_t &bad : {damaged, too_short, command_frame(1, COMMAND_RUN, -600000), command_frame(99)}) {
        commands_init(&commands);
        arm(1, 10000);
        for (int i = 0; i < 3; i++) {
            EXPECT_EQ(take(bad, DRIVE_STATE_RUN, 11000), COMMANDS_REJECTED);
            EXPECT_FALSE(commands.failed);
        }
        EXPECT_TRUE(commands.arming.armed);
        take(bad, DRIVE_STATE_RUN, 11000);
        EXPECT_TRUE(commands.failed);
        EXPECT_FALSE(commands.arming.armed);
    }
    commands_init(&commands);
    arm(1, 10000);
    for (uint8_t i = 0; i < 4; i++) {
        take(command_frame(uint8_t(2 + i), 9), DRIVE_STATE_RUN, 11000); // out of range
    }
    EXPECT_TRUE(commands.failed);
}

// [SR-33]
TEST_F(Commands, bad_frames_among_enough_good_ones_never_add_up) {
    arm(1, 10000);
    uint8_t counter = 1;
    uint32_t time_us = 10000;
    for (int round = 0; round < 100; round++) {
        for (int i = 0; i < 3; i++) {
            hal_can_frame_t damaged = command_frame(99);
            damaged.data[5] ^= 1;
            take(damaged, DRIVE_STATE_RUN, time_us);
        }
        EXPECT_EQ(commands.errors, 3 * COMMANDS_ERROR_STEP);
        for (unsigned i = 0; i < 3 * COMMANDS_ERROR_STEP; i++) {
            time_us += 10000;
            ASSERT_EQ(take(command_frame(++counter), DRIVE_STATE_RUN, time_us), COMMANDS_COMMAND);
        }
        ASSERT_EQ(commands.errors, 0) << round;
    }
    EXPECT_FALSE(commands.failed);
    EXPECT_TRUE(commands.arming.armed);
}

// [SR-33]
TEST_F(Commands, a_valid_command_behind_the_last_bad_one_is_only_counted_until_the_run_has_ended) {
    arm(1, 10000);
    for (int i = 0; i < 4; i++) {
        take(command_frame(99), DRIVE_STATE_RUN, 11000);
    }
    ASSERT_TRUE(commands.failed);
    const command_t before = command;
    EXPECT_EQ(take(command_frame(2, COMMAND_OFF), DRIVE_STATE_RUN, 11000), COMMANDS_ACCEPTED);
    EXPECT_EQ(std::memcmp(&before, &command, sizeof command), 0);
    EXPECT_EQ(commands.counters.accepted, 2);
    EXPECT_EQ(take(command_frame(3, COMMAND_OFF), DRIVE_STATE_FAULT, 12000), COMMANDS_COMMAND);
    EXPECT_EQ(command.request, COMMAND_OFF);
}

// [SR-33]
TEST_F(Commands, duplicated_frames_are_dropped_and_counted_but_are_no_second_sender) {
    arm(0, 10000);
    uint32_t time_us = 10000;
    uint8_t counter = 0;
    for (int frame = 1; frame <= 300; frame++) {
        time_us += 10000;
        ASSERT_EQ(take(command_frame(++counter), DRIVE_STATE_RUN, time_us), COMMANDS_COMMAND);
        for (int copy = 0; copy < 10; copy++) {
            ASSERT_EQ(take(command_frame(counter), DRIVE_STATE_RUN, time_us + 5000), COMMANDS_REJECTED);
        }
        ASSERT_EQ(commands.errors, 0);
    }
    EXPECT_EQ(commands.counters.wrong_counter, 3000);
    EXPECT_EQ(commands.last_received_us, time_us) << "a copy does not prolong a run";
    EXPECT_TRUE(commands.arming.armed);
    // A copy of the last but one is no duplicate of a frame on the bus.
    for (int i = 0; i < 4; i++) {
        take(command_frame(uint8_t(counter - 1)), DRIVE_STATE_RUN, time_us);
    }
    EXPECT_TRUE(commands.failed);
}

// [SR-33]
TEST_F(Commands, bad_frames_are_no_fault_while_not_armed) {
    for (int i = 0; i < 100; i++) {
        hal_can_frame_t damaged = command_frame(1);
        damaged.data[5] ^= 1;
        take(damaged, DRIVE_STATE_READY, 1000);
    }
    EXPECT_FALSE(commands.failed);
    arm(1, 10000);
    EXPECT_EQ(commands.errors, 0) << "those before the arming do not count";
}

// [SR-36]
TEST_F(Commands, a_second_sender_neither_takes_over_nor_goes_unnoticed) {
    // 100 frames per second of the first, with lost ones; frames of the second per frame of the first.
    for (const double ratio : {10.0, 4.0, 1.0, 0.3, 0.1, 0.02}) {
        for (int offset = 0; offset < 256; offset += 5) {
            commands_init(&commands);
            arm(0, 10000);
            uint32_t time_us = 10000;
            uint8_t counter = 0, foreign = uint8_t(offset);
            int taken_over = 0, foreign_frames = 0;
            double due = 0.0;
            for (int frame = 1; frame < 3000 && !commands.failed; frame++) {
                time_us += 10000;
                counter = uint8_t(counter + (frame % 50 == 0 ? 3 : 1)); // two in 50 are lost
                take(command_frame(counter, COMMAND_RUN, 600000), DRIVE_STATE_RUN, time_us);
                for (due += ratio; due >= 1.0 && !commands.failed; due -= 1.0) {
                    foreign_frames++;
                    const bool accepted = take(command_frame(++foreign, COMMAND_RUN, -3000000), DRIVE_STATE_RUN,
                                               time_us) == COMMANDS_COMMAND;
                    taken_over += accepted && command.speed_reference_q22 < 0;
                }
            }
            ASSERT_TRUE(commands.failed) << ratio << ", " << offset;
            ASSERT_FALSE(commands.arming.armed);
            const bool near = offset < 4 || offset > 256 - 12;
            // A second sender that by chance continues the sequence of the first makes the first one's frames invalid:
            // four of them end the run. Any other has a frame in sequence now and then.
            ASSERT_LE(taken_over, near ? 4 * ratio + 2 : 6) << ratio << ", " << offset;
            ASSERT_LE(foreign_frames, near ? 5 * ratio + 4 : ratio > 0.05 ? 12 : 30) << ratio << ", " << offset;
        }
    }
}

// [SR-36]
TEST_F(Commands, three_recorded_frames_beside_the_living_sender_end_the_run) {
    arm(100, 10000);
    uint8_t counter = 100;
    int taken_over = 0;
    for (uint32_t time_us = 20000; time_us < 1000000 && !commands.failed; time_us += 10000) {
        take(command_frame(++counter, COMMAND_RUN, 600000), DRIVE_STATE_RUN, time_us);
        for (uint8_t recorded = 20; recorded < 23 && !commands.failed; recorded++) {
            taken_over +=
                take(command_frame(recorded, COMMAND_RUN, -3000000), DRIVE_STATE_RUN, time_us) == COMMANDS_COMMAND;
        }
    }
    EXPECT_TRUE(commands.failed);
    EXPECT_EQ(taken_over, 0);
}

// [SR-36]
TEST_F(Commands, recorded_frames_in_their_order_do_not_replace_a_sender_that_lives_nor_clear_a_fault) {
    uint8_t counter = 100;
    for (uint32_t time_us = 20000; time_us < 1000000; time_us += 10000) {
        ASSERT_EQ(take(command_frame(++counter, COMMAND_OFF, 0), DRIVE_STATE_FAULT, time_us), COMMANDS_COMMAND);
        for (uint8_t recorded = 20; recorded < 29; recorded++) {
            ASSERT_EQ(take(command_frame(recorded, COMMAND_CLEAR_FAULT, 0), DRIVE_STATE_FAULT,
                           time_us + 1000u * (recorded - 19u)),
                      COMMANDS_REJECTED);
        }
    }
}

// [SR-36]
TEST_F(Commands, another_sender_is_followed_after_30_ms_of_silence_with_its_third_frame) {
    take(command_frame(100, COMMAND_OFF, 0), DRIVE_STATE_READY, 20000);
    uint8_t counter = 20;
    uint32_t time_us = 30000;
    while (take(command_frame(++counter, COMMAND_OFF, 0), DRIVE_STATE_READY, time_us) != COMMANDS_COMMAND) {
        ASSERT_LT(time_us, 100000u);
        time_us += 10000;
    }
    EXPECT_EQ(time_us, 20000u + COMMANDS_SENDER_LOST_US + 2 * 10000u);
}

// [SR-33]
TEST_F(Commands, ordinary_loss_is_no_error) {
    std::mt19937 random(3);
    arm(0, 10000);
    uint8_t counter = 0;
    uint32_t time_us = 10000;
    for (int frame = 0; frame < 100000; frame++) {
        const unsigned lost = random() % 3; // up to two in succession
        time_us += 10000 * (1 + lost);
        counter = uint8_t(counter + 1 + lost);
        ASSERT_EQ(take(command_frame(counter), DRIVE_STATE_RUN, time_us), COMMANDS_COMMAND);
        ASSERT_EQ(command.request, COMMAND_RUN);
    }
    EXPECT_FALSE(commands.failed);
    EXPECT_EQ(commands.counters.wrong_counter, 0);
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
