// Requests about the non-volatile memory: each part of each answer, what there is not, and that nothing is written.
#include <cmath>
#include <cstring>

#include <gtest/gtest.h>

extern "C" {
#include "comms/memory_protocol.h"
#include "drive_codec.h"
#include "support/power_cuts.h"
}
#include "support/frames.h"

namespace {

class MemoryProtocol : public testing::Test {
  protected:
    MemoryProtocol() {
        std::memset(&memory, 0, sizeof memory);
        nvm_init(&memory.hal.nvm);
        start_drive(&drive, &memory);
    }

    // False: not answered.
    bool ask(unsigned operation, unsigned part, int32_t value = 0) {
        const hal_can_frame_t frame = frames::parameter_request(operation, 5, part, value);
        hal_can_frame_t answer{};
        if (!memory_protocol_respond(&drive.store, &test, &memory.hal, &frame, &answer)) {
            return false;
        }
        EXPECT_EQ(answer.identifier, DRIVE_PARAMETER_RESPONSE_FRAME_ID);
        EXPECT_EQ(answer.length, DRIVE_PARAMETER_RESPONSE_LENGTH);
        drive_parameter_response_unpack(&response, answer.data, sizeof answer.data);
        EXPECT_EQ(response.operation, operation);
        EXPECT_EQ(response.index, 5);
        EXPECT_EQ(response.part, part);
        return true;
    }

    int32_t value_of(unsigned operation, unsigned part, int32_t value = 0) {
        EXPECT_TRUE(ask(operation, part, value));
        EXPECT_EQ(response.status, PARAMETER_STATUS_DONE) << part;
        return response.value;
    }

    void write(const fault_record_t &record) {
        nvm_store_follow_fault(&drive.store, &record);
        while (drive.store.waiting_count > 0) {
            nvm_store_step(&drive.store, &memory.hal, &drive.parameters, record.time_us, true);
        }
        nvm_store_follow_fault(&drive.store, nullptr);
    }

    memory_t memory;
    started_t drive;
    self_test_t test{};
    drive_parameter_response_t response{};
};

TEST_F(MemoryProtocol, tells_the_origin_of_the_parameters_and_what_has_become_of_storing_them) {
    test.stack_unused = 100;
    test.code_passes = 7;
    const auto parts = [this] {
        std::vector<int32_t> values;
        for (unsigned part = 0; part < 7; part++) {
            values.push_back(value_of(PARAMETER_OPERATION_MEMORY, part));
        }
        return values;
    };
    EXPECT_EQ(parts(), (std::vector<int32_t>{NVM_STORE_IDLE, 0, 1, 0, 0, 400, 7})) << "defaults of an erased memory";
    parameter_store_save(&drive.store);
    EXPECT_EQ(value_of(PARAMETER_OPERATION_MEMORY, 0), NVM_STORE_SAVING);
    while (drive.store.saving == NVM_STORE_SAVING || !drive.store.start_written) {
        nvm_store_step(&drive.store, &memory.hal, &drive.parameters, 1, true);
    }
    write(fault_of(1));
    EXPECT_EQ(parts(), (std::vector<int32_t>{NVM_STORE_SAVED, 0, 1, 1, 1, 400, 7}));
    start_drive(&drive, &memory);
    EXPECT_EQ(parts(), (std::vector<int32_t>{NVM_STORE_IDLE, 1, 2, 1, 1, 400, 7})) << "of the memory, second start";
    memory.hal.nvm.word[0][2] ^= 1;
    start_drive(&drive, &memory);
    EXPECT_EQ(value_of(PARAMETER_OPERATION_MEMORY, 1), 2) << "a set that cannot be used";
    for (unsigned part = 7; part < 256; part++) {
        ASSERT_TRUE(ask(PARAMETER_OPERATION_MEMORY, part));
        EXPECT_EQ(response.status, PARAMETER_STATUS_NO_SUCH_ENTRY);
        EXPECT_EQ(response.value, 0);
    }
}

TEST_F(MemoryProtocol, reads_every_part_of_a_logged_fault_in_the_units_of_the_bus) {
    fault_record_t record = fault_of(1);
    record.fault_mask = FAULT_BIT(FAULT_ENCODER) | FAULT_BIT(31);
    record.time_us = 0xFFFFFFF0u;
    record.speed_q22 = -10 * (1 << 22);           // rad/s
    record.torque_reference_q24 = -(3 << 24) / 2; // N m
    record.dc_link_voltage_q6 = 240 * 64;         // V
    record.angle = 0xFEDC;
    record.phases = 0xA;
    record.self_test = 0x8100;
    record.sensors = 0x9;
    const uint16_t current_q9[HAL_PHASES_MAX] = {512, 40000, 3, 7, 11, 13};
    std::memcpy(record.current_q9, current_q9, sizeof current_q9);
    write(record);
    const int32_t quarter_rpm = int32_t(std::lround(-10.0 * 30.0 / M_PI * 4.0));
    const int32_t expected[] = {FAULT_ENCODER,
                                DRIVE_STATE_RUN,
                                int32_t(record.fault_mask),
                                1,
                                int32_t(record.time_us),
                                0,
                                quarter_rpm,
                                240 * 64,
                                40000,
                                -3 * 128,
                                512,
                                40000,
                                3,
                                7,
                                0xFEDC,
                                0x98100,
                                0xA,
                                11,
                                13};
    for (unsigned part = 0; part < 256; part++) {
        ASSERT_TRUE(ask(PARAMETER_OPERATION_FAULT_LOG, part, 1));
        const bool there = part < std::size(expected);
        EXPECT_EQ(response.status, there ? PARAMETER_STATUS_DONE : PARAMETER_STATUS_NO_SUCH_ENTRY) << part;
        EXPECT_EQ(response.value, there ? expected[part] : 0) << part;
    }
}

TEST_F(MemoryProtocol, the_current_of_a_logged_fault_is_the_largest_of_all_phases) {
    for (unsigned largest = 0; largest < HAL_PHASES_MAX; largest++) {
        fault_record_t record = fault_of(largest + 1);
        for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
            record.current_q9[phase] = uint16_t(phase == largest ? 30000 : 100 + phase);
        }
        write(record);
        EXPECT_EQ(value_of(PARAMETER_OPERATION_FAULT_LOG, 8, int32_t(largest) + 1), 30000) << largest;
    }
}

TEST_F(MemoryProtocol, reads_the_last_16_faults_by_their_number_and_no_other) {
    for (uint32_t number = 1; number <= 20; number++) {
        write(fault_of(number));
    }
    for (const int32_t number : {INT32_MIN, -1, 0, 1, 4, 5, 20, 21, INT32_MAX}) {
        ASSERT_TRUE(ask(PARAMETER_OPERATION_FAULT_LOG, 4, number));
        const bool there = number >= 5 && number <= 20;
        EXPECT_EQ(response.status, there ? PARAMETER_STATUS_DONE : PARAMETER_STATUS_NO_SUCH_ENTRY) << number;
        EXPECT_EQ(response.value, there ? int32_t(fault_of(uint32_t(number)).time_us) : 0);
    }
}

TEST_F(MemoryProtocol, saves_and_restores_by_no_unprotected_request_and_answers_no_other_operation) {
    const nvm_t before = memory.hal.nvm;
    for (const unsigned operation : {PARAMETER_OPERATION_SAVE, PARAMETER_OPERATION_RESTORE_DEFAULTS}) {
        ASSERT_TRUE(ask(operation, 0));
        EXPECT_EQ(response.status, PARAMETER_STATUS_UNPROTECTED);
    }
    EXPECT_EQ(drive.store.saving, NVM_STORE_IDLE);
    for (unsigned operation = 0; operation < 256; operation++) {
        const bool own = operation == PARAMETER_OPERATION_SAVE || operation == PARAMETER_OPERATION_RESTORE_DEFAULTS ||
                         operation == PARAMETER_OPERATION_MEMORY || operation == PARAMETER_OPERATION_FAULT_LOG;
        EXPECT_EQ(ask(operation, 0, 1), own) << operation;
    }
    EXPECT_EQ(std::memcmp(&before, &memory.hal.nvm, sizeof before), 0);
}

} // namespace
