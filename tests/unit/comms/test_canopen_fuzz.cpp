// Random frames of every service of CANopen, most of them plausible: nothing runs that was not enabled, no parameter is
// beyond its limits, no transfer hangs, and silence ends a run. Built with sanitizers, too. A longer run:
//
//     CANOPEN_FRAMES=100000000 build/host/bin/test_comms_canopen_fuzz
#include "support/canopen_bench.h"

#include <algorithm>
#include <cstdlib>
#include <random>

namespace {

using namespace canopen_bench;

class CanopenFuzz : public CanopenBench {
  protected:
    unsigned any(unsigned end) { return unsigned(random() % end); }

    void any_object(unsigned &index, unsigned &sub, uint32_t &value) {
        const unsigned at = any(CANOPEN_ROWS + PARAMETER_COUNT / 4);
        canopen_object_t object;
        if (at < CANOPEN_ROWS) {
            const canopen_row_t &row = canopen_rows[at];
            index = row.index + any(row.instances + (any(20) == 0));
            sub = row.first + any(row.count + (any(20) == 0));
        } else {
            index = 0x2000 + any(PARAMETER_COUNT + 1);
            sub = any(20) == 0;
        }
        const bool known = canopen_find(index, sub, &object) == CANOPEN_DONE;
        const uint32_t limits[] = {uint32_t(object.row.minimum), uint32_t(object.row.maximum),
                                   uint32_t(object.row.minimum) - 1u, uint32_t(object.row.maximum) + 1u};
        const uint32_t maps[] = {0x60400010, 0x60FF0020, 0x60710010, 0x60600008, 0x606C0020,
                                 0x60410010, 0x607A0020, 0x60640020, 0x60810020};
        value = known && any(2) == 0 ? limits[any(4)]
                : any(3) == 0        ? maps[any(9)]
                : any(3) == 0        ? 0x80000000u | 0x180u + any(0x400)
                : any(2) == 0        ? any(12)
                                     : uint32_t(random());
    }

    bytes_t any_sdo() {
        unsigned index, sub;
        uint32_t value;
        any_object(index, sub, value);
        if (any(3) != 0) {
            const unsigned writes[] = {0x22, 0x23, 0x2B, 0x2F};
            return head(any(3) == 0 ? 0x40 : writes[any(4)], index, sub, value);
        }
        const unsigned commands[] = {0x20, 0x21, 0x60, 0x70, 0x00, 0x01, 0x10, 0x11, 0xA0, 0xA4,
                                     0xA2, 0xA3, 0xA1, 0xC0, 0xC2, 0xC6, 0xC1, 0x80, 0xC5, unsigned(any(256))};
        bytes_t request = head(commands[any(20)], any(4) == 0 ? 0x2F00 : index, sub, any(2) == 0 ? 4 : value);
        if (canopen.sdo.state == CANOPEN_SDO_BLOCK_DOWNLOAD && any(3) != 0) {
            request[0] = uint8_t((canopen.sdo.sequence + (any(10) != 0)) | (any(8) == 0 ? 0x80 : 0));
        }
        return request;
    }

    bytes_t any_bytes(unsigned count) {
        bytes_t data(count);
        std::generate(data.begin(), data.end(), [&] { return uint8_t(random()); });
        return data;
    }

    void any_pdo() {
        const unsigned pdo = any(CANOPEN_PDOS);
        const unsigned words[] = {6,    7,    15,   6,    7, 15, 15,   0x10F,
                                  0x1F, 0x3F, 0x5F, 0x7F, 2, 0,  0x80, unsigned(any(65536))};
        bytes_t data = any_bytes(any(9));
        if (data.size() >= 2) {
            const unsigned word = words[any(16)];
            data[0] = uint8_t(word);
            data[1] = uint8_t(word >> 8);
        }
        receive(uint32_t(canopen.values[CANOPEN_VALUE_RPDO_ID + pdo]) & 0x7FFu, data);
    }

    void any_frame() {
        const unsigned node = canopen.node;
        synchronised = false;
        switch (any(20)) {
        case 0:
            receive(0, {uint8_t(any(3) != 0 ? 1 : any(2) == 0 ? 128 + any(3) : any(256)), uint8_t(any(2) * node)});
            break;
        case 1:
            synchronised = true;
            receive(0x80, any_bytes(any(2)));
            break;
        case 2:
            receive(0x700 + any(128), {5});
            break;
        case 3:
            receive(0x700 + node, {}, true);
            break;
        case 4: {
            bytes_t data = any_bytes(8);
            data[0] = any(2) == 0 ? uint8_t(0x40 + any(16)) : data[0];
            receive(0x7E5, data);
            break;
        }
        case 5:
            synchronised = true; // may be its identifier
            receive(any(0x800), any_bytes(any(10)), any(8) == 0);
            break;
        case 6:
        case 7:
        case 8:
        case 9:
        case 10:
            any_pdo();
            break;
        default:
            receive(0x600 + node, any_sdo());
            break;
        }
    }

    void expect_safe(canopen_state_t before, canopen_nmt_t nmt) {
        const canopen_state_t state = canopen.drive.state;
        ASSERT_LT(state, CANOPEN_STATES);
        if (state == CANOPEN_OPERATION_ENABLED && before != state && before != CANOPEN_QUICK_STOP_ACTIVE) {
            // By a frame, or by several that have waited for the SYNC.
            ASSERT_TRUE(before == CANOPEN_SWITCHED_ON || before == CANOPEN_READY_TO_SWITCH_ON || synchronised);
            ASSERT_EQ(nmt, CANOPEN_NMT_OPERATIONAL);
        }
        ASSERT_EQ(commands.arming.armed != 0, canopen_enabled(&canopen));
        ASSERT_TRUE(parameters_intact(&parameters));
        ASSERT_LE(canopen.sdo.state, CANOPEN_SDO_BLOCK_LAST);
        ASSERT_LE(queue.count, FRAME_QUEUE_CAPACITY);
        ASSERT_TRUE(canopen.node >= 1 && canopen.node <= 127);
    }

    void expect_safe_set_point() {
        positions++;
        const position_set_point_t &set_point = command.position;
        ASSERT_EQ(command.speed_reference_q22, 0) << "of a drive that loses its commands";
        ASSERT_LE(set_point.order, POSITION_ORDER_HALT);
        ASSERT_EQ(set_point.homing, POSITION_HOMING_METHODS);
        ASSERT_LE(std::abs(set_point.target), POSITION_MAX);
        ASSERT_TRUE(set_point.bounded);
        ASSERT_LE(set_point.lowest, set_point.highest);
        ASSERT_TRUE(set_point.cycle_ms >= 1 && set_point.cycle_ms <= 100);
        ASSERT_GE(set_point.speed_q22, 0);
        ASSERT_GE(set_point.acceleration_rpm_s, 0);
        ASSERT_GE(set_point.deceleration_rpm_s, 0);
        ASSERT_GE(set_point.jerk_rpm_s2, 0);
        if (set_point.order == POSITION_ORDER_PROFILE) {
            ASSERT_GT(set_point.speed_q22, 0) << "0 is the drive's own limit";
        }
    }

    // Reports of the position loop, plausible or not.
    void any_place() {
        position_status_t &place = canopen.place;
        place.active = command.mode == DRIVE_MODE_POSITION && any(20) != 0;
        place.sequence = any(4) != 0 ? command.position.sequence : uint32_t(random());
        place.arrived = any(4) != 0 ? place.sequence : uint32_t(random());
        place.in_position = any(2);
        place.homing = any(2);
        place.homed = any(2);
        place.homing_failed = any(4) == 0;
        place.following_error = any(30) == 0;
        place.limited = any(4) == 0;
        place.position = int64_t(uint64_t(random()) << 32 | random()) >> (18 + any(40));
        place.reference = place.position + int32_t(random());
        place.error = int32_t(random());
        place.speed_reference_q22 = int32_t(random());
    }

    void expect_safe_command() {
        ASSERT_EQ(command.request == COMMAND_RUN, canopen_enabled(&canopen));
        ASSERT_LE(std::abs(double(command.speed_reference_q22)),
                  machine_tables.speed_reference_max * 1.0472e-4 * (1 << 22) + 2);
        if (command.mode == DRIVE_MODE_POSITION) {
            expect_safe_set_point();
        }
        for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
            ASSERT_GE(parameters.values[i], parameters_row(i)->minimum) << i;
            ASSERT_LE(parameters.values[i], parameters_row(i)->maximum) << i;
        }
    }

    std::mt19937 random{20261129};
    bool synchronised = false;
    unsigned positions = 0;
};

TEST_F(CanopenFuzz, nothing_unsafe_and_no_hang) {
    const char *wanted = std::getenv("CANOPEN_FRAMES");
    const unsigned frames = wanted != nullptr ? unsigned(std::atol(wanted)) : 1000000;
    unsigned enabled = 0;
    for (unsigned i = 0; i < frames && !HasFatalFailure(); i++) {
        const canopen_state_t before = canopen.drive.state;
        const canopen_nmt_t nmt = canopen.nmt;
        any_frame();
        expect_safe(before, nmt);
        enabled += canopen_enabled(&canopen);
        if (any(3) == 0) {
            values.motion.speed_rpm = canopen_enabled(&canopen) ? int32_t(any(4000000)) - 2000000 : 0;
            values.status.state = any(500) == 0                            ? DRIVE_STATE_FAULT
                                  : command.request == COMMAND_CLEAR_FAULT ? DRIVE_STATE_READY
                                                                           : values.status.state;
            values.status.fault = values.status.state == DRIVE_STATE_FAULT ? 1 + any(FAULT_COUNT - 1) : 0;
            values.status.controller = any(50) == 0 ? DRIVE_CONTROLLER_PAPER : DRIVE_CONTROLLER_SALIENT;
            any_place();
            conditions.running = command.request == COMMAND_RUN;
            cycle();
            conditions.running = command.request == COMMAND_RUN;
            cycle();
            expect_safe_command();
            if (uint32_t(parameters.values[PARAMETER_PROTOCOL]) - 1u >=
                CANOPEN_NODE_MAX) { // the other protocol, or no node-ID
                parameters_set(&parameters, PARAMETER_PROTOCOL, NODE);
            }
        }
        sent();
        if (canopen.node - 1u >= CANOPEN_NODE_MAX) {
            canopen_init(&canopen, NODE, 1, time_us);
        }
    }
    EXPECT_GT(enabled, frames / 100) << "the frames reach what they are to try";
    EXPECT_GT(positions, frames / 2000);
    values.status.state = DRIVE_STATE_READY;
    values.motion.speed_rpm = 0;
    conditions.running = false;
    cycle(62000);
    EXPECT_NE(command.request, COMMAND_RUN) << "silence";
    EXPECT_FALSE(canopen_enabled(&canopen));
}

} // namespace
