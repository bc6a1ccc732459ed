// Steps of a set of parameters: each response, what a refused step leaves as it was, and when the arming ends.
#include <cstring>

#include <gtest/gtest.h>

extern "C" {
#include "comms/parameter_set.h"
#include "drive_codec.h"
#include "support/power_cuts.h"
}
#include "support/frames.h"

namespace {

class ParameterSet : public testing::Test {
  protected:
    ParameterSet() {
        std::memset(&memory, 0, sizeof memory);
        nvm_init(&memory.hal.nvm);
        start_drive(&drive, &memory);
    }

    // Executes a step; its response names parameters only where a set is refused for them.
    void expect(unsigned step, parameter_status_t status, bool ends, uint32_t check = 0, unsigned index = 0,
                unsigned other = 0) {
        const hal_can_frame_t frame = frames::parameter_set_control(++counter, step, check);
        hal_can_frame_t answer{};
        EXPECT_EQ(parameter_set_control(&set, armed, &drive.parameters, &drive.store, &conditions, &frame, &answer),
                  ends);
        EXPECT_EQ(answer.identifier, DRIVE_PARAMETER_RESPONSE_FRAME_ID);
        EXPECT_EQ(answer.length, DRIVE_PARAMETER_RESPONSE_LENGTH);
        drive_parameter_response_t response{};
        drive_parameter_response_unpack(&response, answer.data, sizeof answer.data);
        EXPECT_EQ(response.operation, PARAMETER_OPERATION_SET_CONTROL);
        EXPECT_EQ(response.status, status);
        EXPECT_EQ(response.index, index);
        EXPECT_EQ(response.part, other);
        EXPECT_EQ(response.value, counter * 256 + int32_t(step));
    }

    // The CRC-32 of all writes.
    uint32_t write(unsigned index, int32_t value) {
        const hal_can_frame_t frame = frames::parameter_write(++counter, index, value);
        parameter_set_write(&set, &frame);
        return check = crc32_continue(check, frame.data + E2E_HEADER_BYTES, unsigned(frame.length - E2E_HEADER_BYTES));
    }

    int32_t value(unsigned index) const { return drive.parameters.values[index]; }

    memory_t memory;
    started_t drive;
    parameter_set_t set{};
    parameters_conditions_t conditions{};
    bool armed = true;
    uint8_t counter = 0;
    uint32_t check = 0;
};

TEST_F(ParameterSet, a_whole_set_is_applied_with_its_last_frame) {
    expect(PARAMETER_SET_STEP_BEGIN, PARAMETER_STATUS_DONE, false);
    write(PARAMETER_OVER_SPEED_RPM, 1000);
    const uint32_t all = write(PARAMETER_CURRENT_LIMIT_A, 40 << 9);
    const parameters_t before = drive.parameters;
    EXPECT_NE(value(PARAMETER_OVER_SPEED_RPM), 1000);
    expect(PARAMETER_SET_STEP_APPLY, PARAMETER_STATUS_DONE, true, all);
    for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
        EXPECT_EQ(value(i), i == PARAMETER_OVER_SPEED_RPM    ? 1000
                            : i == PARAMETER_CURRENT_LIMIT_A ? 40 << 9
                                                             : before.values[i]);
    }
    EXPECT_TRUE(parameters_intact(&drive.parameters));
}

TEST_F(ParameterSet, begins_with_the_values_in_effect_or_with_the_defaults) {
    parameters_set(&drive.parameters, PARAMETER_OVER_SPEED_RPM, 1234);
    for (const bool defaults : {false, true}) {
        expect(defaults ? PARAMETER_SET_STEP_BEGIN_DEFAULTS : PARAMETER_SET_STEP_BEGIN, PARAMETER_STATUS_DONE, false);
        expect(PARAMETER_SET_STEP_APPLY, PARAMETER_STATUS_DONE, true, 0);
        EXPECT_EQ(value(PARAMETER_OVER_SPEED_RPM),
                  defaults ? parameters_default(&drive.parameters, PARAMETER_OVER_SPEED_RPM) : 1234);
    }
    // Defaults write every parameter, in a run those that are not tunable, too.
    conditions.running = true;
    expect(PARAMETER_SET_STEP_BEGIN, PARAMETER_STATUS_DONE, false);
    expect(PARAMETER_SET_STEP_APPLY, PARAMETER_STATUS_DONE, true, 0);
    expect(PARAMETER_SET_STEP_BEGIN_DEFAULTS, PARAMETER_STATUS_DONE, false);
    unsigned first = 0;
    while (parameters_tunable(first)) {
        first++;
    }
    expect(PARAMETER_SET_STEP_APPLY, PARAMETER_STATUS_NOT_WHILE_RUNNING, true, 0, first);
}

TEST_F(ParameterSet, without_begin_or_with_another_checksum_a_set_is_incomplete) {
    expect(PARAMETER_SET_STEP_APPLY, PARAMETER_STATUS_INCOMPLETE, true, 0);
    expect(PARAMETER_SET_STEP_BEGIN, PARAMETER_STATUS_DONE, false);
    const uint32_t all = write(PARAMETER_OVER_SPEED_RPM, 1000);
    const parameters_t before = drive.parameters;
    for (const uint32_t wrong : {all ^ 1u, all ^ (1u << 31), 0u}) {
        expect(PARAMETER_SET_STEP_APPLY, PARAMETER_STATUS_INCOMPLETE, true, wrong);
    }
    EXPECT_EQ(std::memcmp(&before, &drive.parameters, sizeof before), 0);
    expect(PARAMETER_SET_STEP_BEGIN, PARAMETER_STATUS_DONE, false);
    expect(PARAMETER_SET_STEP_APPLY, PARAMETER_STATUS_INCOMPLETE, true, all);
}

TEST_F(ParameterSet, a_set_that_contradicts_itself_names_both_parameters) {
    expect(PARAMETER_SET_STEP_BEGIN, PARAMETER_STATUS_DONE, false);
    const uint32_t all = write(PARAMETER_UNDER_VOLTAGE_V, value(PARAMETER_OVER_VOLTAGE_V));
    expect(PARAMETER_SET_STEP_APPLY, PARAMETER_STATUS_CONTRADICTION, true, all, PARAMETER_UNDER_VOLTAGE_V,
           PARAMETER_OVER_VOLTAGE_V);
}

TEST_F(ParameterSet, values_that_changed_in_memory_are_neither_copied_applied_nor_stored) {
    expect(PARAMETER_SET_STEP_BEGIN, PARAMETER_STATUS_DONE, false);
    const uint32_t all = write(PARAMETER_OVER_SPEED_RPM, 1000);
    set.values[PARAMETER_CURRENT_TRIP_A] ^= 1 << 11; // staged
    expect(PARAMETER_SET_STEP_APPLY, PARAMETER_STATUS_MEMORY, true, all);
    EXPECT_NE(value(PARAMETER_OVER_SPEED_RPM), 1000);
    set.values[PARAMETER_CURRENT_TRIP_A] ^= 1 << 11;
    drive.parameters.values[PARAMETER_CURRENT_TRIP_A] ^= 1 << 11; // in effect
    expect(PARAMETER_SET_STEP_APPLY, PARAMETER_STATUS_MEMORY, true, all);
    EXPECT_NE(value(PARAMETER_OVER_SPEED_RPM), 1000);
    const parameter_set_t before = set;
    expect(PARAMETER_SET_STEP_BEGIN, PARAMETER_STATUS_MEMORY, false);
    expect(PARAMETER_SET_STEP_BEGIN_DEFAULTS, PARAMETER_STATUS_MEMORY, false);
    EXPECT_EQ(std::memcmp(&before, &set, sizeof set), 0);
    expect(PARAMETER_SET_STEP_SAVE, PARAMETER_STATUS_MEMORY, true);
    EXPECT_EQ(drive.store.saving, NVM_STORE_IDLE);
}

TEST_F(ParameterSet, is_stored_while_the_drive_does_not_run_and_is_not_in_a_run) {
    conditions.running = true;
    expect(PARAMETER_SET_STEP_SAVE, PARAMETER_STATUS_NOT_WHILE_RUNNING, true);
    EXPECT_EQ(drive.store.saving, NVM_STORE_IDLE);
    conditions.running = false;
    expect(PARAMETER_SET_STEP_SAVE, PARAMETER_STATUS_DONE, true);
    EXPECT_EQ(drive.store.saving, NVM_STORE_SAVING);
}

TEST_F(ParameterSet, abandoning_ends_the_arming_and_changes_nothing) {
    expect(PARAMETER_SET_STEP_BEGIN, PARAMETER_STATUS_DONE, false);
    write(PARAMETER_OVER_SPEED_RPM, 1000);
    const parameters_t before = drive.parameters;
    expect(PARAMETER_SET_STEP_ABANDON, PARAMETER_STATUS_DONE, true);
    EXPECT_EQ(std::memcmp(&before, &drive.parameters, sizeof before), 0);
}

TEST_F(ParameterSet, without_the_arming_no_step_has_an_effect) {
    armed = false;
    const parameters_t before = drive.parameters;
    for (const unsigned step : {PARAMETER_SET_STEP_BEGIN, PARAMETER_SET_STEP_BEGIN_DEFAULTS, PARAMETER_SET_STEP_APPLY,
                                PARAMETER_SET_STEP_ABANDON, PARAMETER_SET_STEP_SAVE}) {
        expect(step, PARAMETER_STATUS_NOT_ARMED, false);
    }
    EXPECT_FALSE(set.begun);
    EXPECT_EQ(drive.store.saving, NVM_STORE_IDLE);
    EXPECT_EQ(std::memcmp(&before, &drive.parameters, sizeof before), 0);
}

} // namespace
