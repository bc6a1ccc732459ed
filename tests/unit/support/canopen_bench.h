// A CANopen device without bus and interrupts: frames in, frames out, the drive's state as the test sets it.
#pragma once

#include <cstdint>
#include <cstring>
#include <memory>
#include <vector>

#include <gtest/gtest.h>

extern "C" {
#include "comms/canopen.h"
#include "comms/canopen_demand.h"
#include "comms/canopen_drive.h"
#include "comms/canopen_entries.h"
#include "comms/canopen_objects.h"
#include "control/machine_tables.h"
#include "support/power_cuts.h"
}

namespace canopen_bench {

using bytes_t = std::vector<uint8_t>;

struct sent_t {
    uint32_t identifier;
    bytes_t data;
    bool operator==(const sent_t &other) const { return identifier == other.identifier && data == other.data; }
};

constexpr unsigned NODE = 5;
constexpr uint32_t CYCLE_US = 1000;

class CanopenBench : public testing::Test {
  protected:
    CanopenBench() {
        nvm_init(&memory->hal.nvm);
        nvm_power_on(&memory->hal.nvm);
        parameters_init(&parameters);
        parameters_set(&parameters, PARAMETER_PROTOCOL, NODE);
        nvm_store_init(&store, &memory->hal, &parameters);
        commands_init(&commands);
        canopen_init(&canopen, NODE, 1, time_us);
        values.status.state = DRIVE_STATE_READY;
        values.torque.bus_voltage_v = 200u << 6;
        cycle();
        sent();
    }

    canopen_context_t context() {
        return {&memory->hal, &parameters, &conditions, &set, &store, &commands, &queue, time_us};
    }

    // Frames since the last call.
    std::vector<sent_t> sent() {
        std::vector<sent_t> frames;
        while (const hal_can_frame_t *frame = frame_queue_peek(&queue)) {
            EXPECT_LE(frame->length, 8);
            frames.push_back({frame->identifier, bytes_t(frame->data, frame->data + frame->length)});
            frame_queue_pop(&queue);
        }
        return frames;
    }

    // Error codes of the emergencies among the frames since the last call of sent.
    std::vector<unsigned> emergencies() {
        std::vector<unsigned> codes;
        for (const sent_t &frame : sent()) {
            if (frame.identifier == 0x80 + NODE) {
                codes.push_back(frame.data[0] | unsigned(frame.data[1]) << 8);
            }
        }
        return codes;
    }

    void receive(uint32_t identifier, const bytes_t &data, bool remote = false) {
        hal_can_frame_t frame{};
        frame.identifier = identifier;
        frame.remote = remote;
        frame.length = uint8_t(data.size());
        std::copy(data.begin(), data.begin() + std::min<long>(8, long(data.size())), frame.data);
        const canopen_context_t now = context();
        canopen_receive(&canopen, &now, &frame);
    }

    // One telemetry cycle; the drive does what it is told, one cycle later.
    bool cycle(unsigned cycles = 1) {
        bool commanded = false;
        for (unsigned i = 0; i < cycles; i++) {
            time_us += CYCLE_US;
            if (follows && values.status.state != DRIVE_STATE_FAULT && values.status.state != DRIVE_STATE_INITIALISE) {
                values.status.state = command.request == COMMAND_RUN ? DRIVE_STATE_RUN : DRIVE_STATE_READY;
            }
            commands_supervise(&commands, drive_state_t(values.status.state), time_us, 50000);
            canopen_telemetry(&canopen, &values);
            const canopen_context_t now = context();
            commanded = canopen_step(&canopen, &now, &command);
        }
        return commanded;
    }

    // The response to a request of SDO, empty without one; other frames that wait are dropped.
    bytes_t sdo(const bytes_t &request) {
        sent();
        receive(0x600 + NODE, request);
        const auto frames = sent();
        if (frames.empty()) {
            return {};
        }
        EXPECT_EQ(frames.size(), 1u);
        EXPECT_EQ(frames[0].identifier, 0x580u + NODE);
        return frames[0].data;
    }

    static bytes_t head(unsigned command, unsigned index, unsigned sub, uint32_t word = 0) {
        return {uint8_t(command), uint8_t(index),     uint8_t(index >> 8), uint8_t(sub),
                uint8_t(word),    uint8_t(word >> 8), uint8_t(word >> 16), uint8_t(word >> 24)};
    }

    static bytes_t aborted(unsigned index, unsigned sub, uint32_t code) { return head(0x80, index, sub, code); }

    // Abort code of an expedited write, 0 for none.
    uint32_t write(unsigned index, unsigned sub, int32_t value) {
        canopen_object_t object;
        const unsigned bytes = canopen_find(index, sub, &object) == CANOPEN_DONE ? canopen_bytes(&object) : 4;
        return code_of(sdo(head(0x23u | (4u - bytes) << 2, index, sub, uint32_t(value))));
    }

    static uint32_t code_of(const bytes_t &response) {
        return response.size() == 8 && response[0] == 0x80 ? word(response) : 0;
    }

    static uint32_t word(const bytes_t &response) {
        return response[4] | uint32_t(response[5]) << 8 | uint32_t(response[6]) << 16 | uint32_t(response[7]) << 24;
    }

    uint32_t read(unsigned index, unsigned sub) {
        const bytes_t response = sdo(head(0x40, index, sub));
        EXPECT_EQ(response[0] & 0xE3, 0x43) << std::hex << index << ":" << sub;
        return word(response);
    }

    void control(unsigned controlword) { EXPECT_EQ(write(0x6040, 0, int32_t(controlword)), 0u); }
    unsigned status() { return read(0x6041, 0); }
    void operational() { receive(0, {1, 0}); }

    void enable() {
        operational();
        for (unsigned word : {6u, 7u, 15u}) {
            control(word);
        }
        ASSERT_EQ(canopen.drive.state, CANOPEN_OPERATION_ENABLED);
        cycle(2);
        sent();
    }

    std::unique_ptr<memory_t> memory = std::make_unique<memory_t>();
    parameters_t parameters{};
    parameters_conditions_t conditions{};
    parameter_set_t set{};
    nvm_store_t store{};
    commands_t commands{};
    frame_queue_t queue{};
    command_t command{};
    canopen_t canopen{};
    drive_telemetry_t values{};
    bool follows = true;
    uint32_t time_us = 1000;
};

} // namespace canopen_bench

extern "C" uint32_t hal_random_u32(hal_t *) {
    return 4711;
}
