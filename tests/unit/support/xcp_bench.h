// A drive's memory and its XCP slave, without interrupts and bus: commands in, responses out.
#pragma once

#include <cstdint>
#include <cstring>
#include <initializer_list>
#include <memory>
#include <vector>

#include <gtest/gtest.h>

extern "C" {
#include "comms/arming.h"
#include "comms/xcp.h"
#include "comms/xcp_memory.h"
#include "control/machine_tables.h"
#include "drive/drive.h"
#include "drive_codec.h"
#include "support/power_cuts.h"
}

namespace xcp_bench {

using bytes_t = std::vector<uint8_t>;

inline uint32_t last_seed = 0; // of hal_random_u32

inline bytes_t word(uint32_t value) {
    return {uint8_t(value), uint8_t(value >> 8), uint8_t(value >> 16), uint8_t(value >> 24)};
}

inline bytes_t operator+(bytes_t a, const bytes_t &b) {
    a.insert(a.end(), b.begin(), b.end());
    return a;
}

inline bytes_t failed(xcp_error_t error) {
    return {0xFE, uint8_t(error)};
}

class XcpBench : public testing::Test {
  protected:
    XcpBench() {
        std::memset(memory.get(), 0, sizeof *memory);
        nvm_init(&memory->hal.nvm);
        nvm_power_on(&memory->hal.nvm);
        auto *bytes = reinterpret_cast<uint8_t *>(drive.get());
        for (size_t i = 0; i < sizeof *drive; i++) { // each word another value
            bytes[i] = uint8_t(i % 4 == 0 ? i / 4 : i % 4 == 1 ? i / 1024 : 0x5A + i);
        }
        drive->comms.set = {};
        drive->sampler = {};
        parameters_init(&drive->parameters);
        nvm_store_init(&drive->store, &memory->hal, &drive->parameters);
        xcp_init(&xcp, drive.get(), DRIVE_WORDS, &drive->sampler);
    }

    bool receive(const bytes_t &command, hal_can_frame_t &response) {
        hal_can_frame_t frame{};
        frame.identifier = DRIVE_XCP_COMMAND_FRAME_ID;
        frame.length = uint8_t(command.size());
        std::copy(command.begin(), command.begin() + std::min<long>(8, long(command.size())), frame.data);
        const xcp_context_t context = {&drive->parameters, &conditions, &drive->comms.set, &drive->store, tables};
        return xcp_receive(&xcp, &memory->hal, &frame, &context, time_us, &response);
    }

    // Empty without a response.
    bytes_t send(const bytes_t &command) {
        hal_can_frame_t response{};
        if (!receive(command, response)) {
            return {};
        }
        EXPECT_EQ(response.identifier, uint32_t(DRIVE_XCP_RESPONSE_FRAME_ID));
        EXPECT_FALSE(response.extended || response.remote);
        EXPECT_TRUE(response.length >= 1 && response.length <= 8);
        return bytes_t(response.data, response.data + std::min<unsigned>(8, response.length));
    }

    void connect() {
        send({0xFF, 0});
        ASSERT_TRUE(xcp.connected);
    }

    bytes_t unlock(uint8_t resource) {
        const bytes_t seed = send({0xF8, 0, resource});
        if (seed.size() != 6 || seed[1] == 0) {
            return seed;
        }
        return send({0xF7, 4, uint8_t(~seed[2]), uint8_t(~seed[3]), uint8_t(~seed[4]), uint8_t(~seed[5])});
    }

    void open() {
        connect();
        unlock(XCP_RESOURCE_CALIBRATION);
        unlock(XCP_RESOURCE_DAQ);
        ASSERT_EQ(xcp.unlocked, XCP_RESOURCE_CALIBRATION | XCP_RESOURCE_DAQ);
    }

    bytes_t set_address(uint32_t address) { return send(bytes_t{0xF6, 0, 0, 0} + word(address)); }

    bytes_t write(uint32_t address, uint32_t value) {
        EXPECT_EQ(set_address(address), bytes_t{0xFF});
        return send(bytes_t{0xF0, 4} + word(value));
    }

    bytes_t write_parameter(unsigned index, int32_t value) {
        return write(XCP_AREA_PARAMETERS + 4 * index, uint32_t(value));
    }

    bytes_t next_frame(bool transmitting = false) {
        hal_can_frame_t frame{};
        if (!xcp_next_frame(&xcp, &drive->parameters, transmitting, &frame)) {
            return {};
        }
        EXPECT_EQ(frame.identifier, uint32_t(DRIVE_XCP_RESPONSE_FRAME_ID));
        EXPECT_TRUE(frame.length >= 1 && frame.length <= 8);
        return bytes_t(frame.data, frame.data + frame.length);
    }

    // An event of the drive with its whole memory.
    void event(sampler_event_t at) {
        if (drive->sampler.event == uint32_t(at)) {
            sampler_record(&drive->sampler, drive.get(), DRIVE_WORDS, time_us, 0);
        }
    }

    const uint8_t *drive_bytes() const { return reinterpret_cast<const uint8_t *>(drive.get()); }

    std::unique_ptr<memory_t> memory = std::make_unique<memory_t>();
    std::unique_ptr<drive_t> drive = std::make_unique<drive_t>();
    xcp_t &xcp = drive->comms.xcp;
    parameters_conditions_t conditions{};
    table_store_t *tables = nullptr; // of a port that cannot load them
    uint32_t time_us = 1000;
};

} // namespace xcp_bench

extern "C" uint32_t hal_random_u32(hal_t *) {
    return xcp_bench::last_seed = 1664525u * xcp_bench::last_seed + 1013904223u;
}
