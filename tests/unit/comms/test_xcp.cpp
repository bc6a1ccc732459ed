// Session, locks, areas and parameters of XCP: the bytes of every response.
#include <algorithm>
#include <string>
#include <utility>

#include "support/xcp_bench.h"

namespace {

using namespace xcp_bench;

const bytes_t DONE{0xFF};

class Xcp : public XcpBench {
  protected:
    // The bytes of an upload, all its frames.
    bytes_t upload(unsigned bytes) {
        bytes_t data;
        for (bytes_t frame = send({0xF5, uint8_t(bytes)}); !frame.empty(); frame = next_frame(true)) {
            EXPECT_EQ(frame[0], 0xFF);
            EXPECT_TRUE(frame.size() == 8 || data.size() + frame.size() - 1 == bytes) << "only the last one is shorter";
            data.insert(data.end(), frame.begin() + 1, frame.end());
        }
        return data;
    }

    bytes_t short_upload(uint32_t address, unsigned bytes) {
        return send(bytes_t{0xF4, uint8_t(bytes), 0, 0} + word(address));
    }

    void expect_ended() {
        EXPECT_FALSE(xcp.connected);
        EXPECT_EQ(xcp.unlocked, 0);
        EXPECT_EQ(xcp.seed, 0u);
        EXPECT_EQ(xcp.upload_left, 0);
        EXPECT_FALSE(xcp.daq.running);
        EXPECT_EQ(drive->sampler.event, 0u);
    }

    void measure() {
        ASSERT_EQ(send({0xD6}), DONE);
        ASSERT_EQ(send({0xD5, 0, 1, 0}), DONE);
        ASSERT_EQ(send({0xD4, 0, 0, 0, 1}), DONE);
        ASSERT_EQ(send({0xD3, 0, 0, 0, 0, 1}), DONE);
        ASSERT_EQ(send({0xE2, 0, 0, 0, 0, 0}), DONE);
        ASSERT_EQ(send({0xE1, 0xFF, 4, 0, 8, 0, 0, 0}), DONE);
        ASSERT_EQ(send({0xE0, 0, 0, 0, 0, 0, 1, 0}), DONE);
        ASSERT_EQ(send({0xDE, 1, 0, 0}), (bytes_t{0xFF, 0}));
        ASSERT_TRUE(xcp.daq.running);
    }

    uint32_t areas[5] = {XCP_AREA_MEMORY, XCP_AREA_PARAMETERS, XCP_AREA_SCOPE, XCP_AREA_TEXT, XCP_AREA_TABLES};
    uint32_t sizes[5] = {sizeof(drive_t), 4 * PARAMETER_COUNT, 4 * XCP_SCOPE_WORDS, XCP_TEXT_BYTES *(1 + XCP_EVENTS),
                         sizeof(machine_tables_t)};
};

TEST_F(Xcp, answers_nothing_before_a_connect) {
    for (unsigned code = 0; code < 255; code++) {
        for (unsigned bytes = 1; bytes <= 8; bytes++) {
            bytes_t command(bytes, 0);
            command[0] = uint8_t(code);
            EXPECT_EQ(send(command), bytes_t{}) << code;
        }
    }
    EXPECT_EQ(send({}), bytes_t{});
    EXPECT_EQ(send({0xFF}), bytes_t{}) << "a connect without its mode";
    EXPECT_EQ(send(bytes_t(9, 0xFF)), bytes_t{});
    EXPECT_FALSE(xcp.connected);
    EXPECT_EQ(next_frame(), bytes_t{});
}

TEST_F(Xcp, connects_and_disconnects_with_the_responses_of_the_standard) {
    // RESOURCE calibration and DAQ; low byte first, bytes, slave block mode, optional; MAX_CTO, MAX_DTO; versions.
    EXPECT_EQ(send({0xFF, 0}), (bytes_t{0xFF, 0x05, 0xC0, 8, 8, 0, 1, 1}));
    EXPECT_EQ(send({0xFD}), (bytes_t{0xFF, 0x00, 0x05, 0, 0, 0}));
    EXPECT_EQ(send({0xFB}), (bytes_t{0xFF, 0, 0, 0, 0, 0, 0, 0x10}));
    EXPECT_EQ(send({0xFC}), failed(XCP_ERROR_SYNCHRONISED));
    EXPECT_EQ(failed(XCP_ERROR_SYNCHRONISED), (bytes_t{0xFE, 0x00}));
    EXPECT_EQ(send({0xFE}), DONE);
    expect_ended();
    EXPECT_EQ(send({0xFD}), bytes_t{});
}

TEST_F(Xcp, an_unknown_command_and_a_short_one_are_refused) {
    open();
    const unsigned known[] = {0xF0, 0xF4, 0xF5, 0xF6, 0xF7, 0xF8, 0xF9, 0xFA, 0xFB, 0xFC, 0xFD, 0xFE, 0xFF, 0xD3,
                              0xD4, 0xD5, 0xD6, 0xD7, 0xD8, 0xD9, 0xDA, 0xDC, 0xDD, 0xDE, 0xDF, 0xE0, 0xE1, 0xE2};
    for (unsigned code = 0; code < 255; code++) {
        if (std::find(std::begin(known), std::end(known), code) == std::end(known)) {
            EXPECT_EQ(send({uint8_t(code), 0, 0, 0, 0, 0, 0, 0}), failed(XCP_ERROR_UNKNOWN)) << code;
        }
    }
    const std::pair<unsigned, unsigned> least[] = {{0xF4, 8}, {0xF5, 2}, {0xF6, 8}, {0xF8, 3}, {0xF9, 4}, {0xFA, 2},
                                                   {0xFF, 2}, {0xD3, 6}, {0xD4, 5}, {0xD5, 4}, {0xD7, 4}, {0xD8, 4},
                                                   {0xDD, 2}, {0xDE, 4}, {0xDF, 4}, {0xE0, 7}, {0xE1, 8}, {0xE2, 6}};
    for (const auto &[code, bytes] : least) {
        for (unsigned count = 1; count < bytes; count++) {
            bytes_t command(count, 1);
            command[0] = uint8_t(code);
            const xcp_t before = xcp;
            EXPECT_EQ(send(command), failed(XCP_ERROR_SYNTAX)) << code << " of " << count;
            EXPECT_EQ(std::memcmp(&before, &xcp, sizeof before), 0);
        }
    }
}

TEST_F(Xcp, a_write_whose_bytes_have_not_all_come_changes_nothing) {
    open();
    ASSERT_EQ(set_address(XCP_AREA_PARAMETERS + 4 * PARAMETER_OVER_SPEED_RPM), DONE);
    const parameters_t before = drive->parameters;
    for (unsigned count = 1; count < 6; count++) {
        bytes_t command{0xF0, 4, 100, 1, 0, 0};
        command.resize(count);
        EXPECT_EQ(send(command), failed(XCP_ERROR_SYNTAX));
    }
    EXPECT_EQ(std::memcmp(&before, &drive->parameters, sizeof before), 0);
    send({0xF8, 0, 1});
    xcp.unlocked = 0;
    ASSERT_EQ(send({0xF8, 0, 1}).size(), 6u);
    EXPECT_EQ(send({0xF7, 4, 0, 0, 0}), failed(XCP_ERROR_SYNTAX)) << "a key";
    EXPECT_TRUE(xcp.connected);
}

TEST_F(Xcp, identifies_program_and_events_by_texts) {
    connect();
    for (const unsigned type : {0, 1, 5}) {
        EXPECT_EQ(send({0xFA, uint8_t(type)}), (bytes_t{0xFF, 0, 0, 0, 31, 0, 0, 0}));
        const bytes_t text = upload(31);
        char hashes[32];
        std::snprintf(hashes, sizeof hashes, "%08x%08x", machine_tables.dbc_hash, unsigned(DRIVE_WORDS));
        const std::string expected(hashes);
        EXPECT_EQ(std::string(text.begin(), text.begin() + 7), "salient");
        EXPECT_EQ(std::string(text.begin() + 15, text.end()), expected);
    }
    for (const unsigned type : {2, 3, 4, 6, 128, 255}) {
        EXPECT_EQ(send({0xFA, uint8_t(type)}), (bytes_t{0xFF, 0, 0, 0, 0, 0, 0, 0})) << "there is none";
    }
    const char *names[] = {"control", "background", "deferred", "identify"};
    for (unsigned event = 0; event < XCP_EVENTS; event++) {
        const std::string name = names[event];
        EXPECT_EQ(send({0xD7, 0, uint8_t(event), 0}), (bytes_t{0xFF, 0x04, 1, uint8_t(name.size()), 0, 0, 0}));
        const bytes_t text = upload(unsigned(name.size()));
        EXPECT_EQ(std::string(text.begin(), text.end()), name);
    }
    EXPECT_EQ(send({0xD7, 0, XCP_EVENTS, 0}), failed(XCP_ERROR_OUT_OF_RANGE));
    EXPECT_EQ(send({0xD7, 0, 0, 1}), failed(XCP_ERROR_OUT_OF_RANGE));
}

TEST_F(Xcp, seeds_open_one_resource_once) {
    connect();
    EXPECT_EQ(send({0xF7, 4, 0, 0, 0, 0}), failed(XCP_ERROR_SEQUENCE)) << "no seed";
    EXPECT_TRUE(xcp.connected);
    for (const unsigned resource : {0x00, 0x02, 0x05, 0x08, 0x10, 0xFF}) {
        EXPECT_EQ(send({0xF8, 0, uint8_t(resource)}), failed(XCP_ERROR_OUT_OF_RANGE)) << resource;
    }
    EXPECT_EQ(send({0xF8, 1, 1}), failed(XCP_ERROR_OUT_OF_RANGE)) << "no second part";
    const bytes_t seed = send({0xF8, 0, 4});
    EXPECT_EQ(seed, (bytes_t{0xFF, 4} + word(last_seed)));
    const bytes_t key = bytes_t{0xF7, 4} + word(~last_seed);
    time_us += ARMING_RESPONSE_MAX_US;
    EXPECT_EQ(send(key), (bytes_t{0xFF, 0x01})) << "calibration is still locked";
    EXPECT_EQ(send({0xFD}), (bytes_t{0xFF, 0, 0x01, 0, 0, 0}));
    EXPECT_EQ(send(key), failed(XCP_ERROR_SEQUENCE)) << "the key again";
    EXPECT_TRUE(xcp.connected);
    EXPECT_EQ(send({0xF8, 0, 4}), (bytes_t{0xFF, 0, 0, 0, 0, 0})) << "it is open";
    EXPECT_EQ(unlock(1), (bytes_t{0xFF, 0x00}));
}

// Which would read as unlocked, and as none.
TEST_F(Xcp, a_seed_is_not_zero) {
    connect();
    uint32_t inverse = 1664525; // modulo 2^32, of the random numbers' factor
    for (unsigned i = 0; i < 5; i++) {
        inverse *= 2u - 1664525u * inverse;
    }
    last_seed = (0u - 1013904223u) * inverse;
    EXPECT_EQ(send({0xF8, 0, 1}), (bytes_t{0xFF, 4} + word(1)));
    EXPECT_EQ(last_seed, 0u) << "the random number";
    EXPECT_EQ(send(bytes_t{0xF7, 4} + word(~1u)), (bytes_t{0xFF, 0x04}));
}

TEST_F(Xcp, a_wrong_key_a_late_one_and_that_of_another_seed_end_the_session) {
    const auto expect_refused = [this](const bytes_t &key) {
        EXPECT_EQ(send(key), failed(XCP_ERROR_ACCESS_LOCKED));
        expect_ended();
        EXPECT_EQ(send({0xFD}), bytes_t{});
    };
    for (unsigned bit = 0; bit < 32; bit++) {
        open();
        xcp.unlocked = XCP_RESOURCE_DAQ;
        measure();
        send({0xF8, 0, 1});
        expect_refused(bytes_t{0xF7, 4} + word(~last_seed ^ 1u << bit));
    }
    for (const unsigned length : {0, 1, 3, 5, 255}) {
        connect();
        send({0xF8, 0, 1});
        expect_refused(bytes_t{0xF7, uint8_t(length)} + word(~last_seed) + bytes_t{0, 0});
    }
    connect();
    send({0xF8, 0, 1});
    time_us += ARMING_RESPONSE_MAX_US + 1;
    expect_refused(bytes_t{0xF7, 4} + word(~last_seed));
    connect();
    send({0xF8, 0, 1});
    const uint32_t first = last_seed;
    send({0xF8, 0, 4}); // another seed in its place
    expect_refused(bytes_t{0xF7, 4} + word(~first));
    connect();
    send({0xF8, 0, 1});
    send({0xFE});
    connect();
    EXPECT_EQ(send(bytes_t{0xF7, 4} + word(~last_seed)), failed(XCP_ERROR_SEQUENCE)) << "a seed of another session";
}

TEST_F(Xcp, a_key_is_late_even_when_the_time_has_wrapped) {
    connect();
    send({0xF8, 0, 1});
    const bytes_t key = bytes_t{0xF7, 4} + word(~last_seed);
    for (unsigned k = 0; k < 1024; k++) {
        time_us += 0x400000u; // 71 minutes in all
        EXPECT_EQ(send({0xFD}).size(), 6u);
        xcp_supervise(&xcp, false, time_us);
    }
    EXPECT_EQ(send(key), failed(XCP_ERROR_SEQUENCE));
    EXPECT_EQ(xcp.unlocked, 0);
}

TEST_F(Xcp, the_end_of_a_session_locks_and_stops_measuring) {
    const auto begin = [this] {
        open();
        measure();
        event(SAMPLER_EVENT_CONTROL);
    };
    begin();
    send({0xFE});
    expect_ended();
    begin();
    connect(); // a new session
    EXPECT_EQ(xcp.unlocked, 0);
    EXPECT_FALSE(xcp.daq.running);
    EXPECT_EQ(drive->sampler.event, 0u);
    EXPECT_EQ(send({0xDE, 1, 0, 0}), failed(XCP_ERROR_ACCESS_LOCKED));
    begin();
    xcp_supervise(&xcp, true, time_us);
    expect_ended();
    time_us = 0xFFFFFF00u;
    open();
    xcp_supervise(&xcp, false, time_us + XCP_SILENT_US);
    EXPECT_TRUE(xcp.connected);
    time_us += XCP_SILENT_US;
    EXPECT_FALSE(send({0xFD}).empty()); // no silence
    xcp_supervise(&xcp, false, time_us + XCP_SILENT_US);
    EXPECT_TRUE(xcp.connected);
    xcp_supervise(&xcp, false, time_us + XCP_SILENT_US + 1);
    expect_ended();
    EXPECT_EQ(next_frame(), bytes_t{});
}

TEST_F(Xcp, a_silent_master_goes_on_measuring_and_writes_no_parameter) {
    time_us = 0xFFFFFF00u;
    open();
    measure();
    const bytes_t key_needed = failed(XCP_ERROR_ACCESS_LOCKED);
    for (unsigned k = 0; k <= 500; k++) { // 83 minutes in all
        xcp_supervise(&xcp, false, time_us + XCP_SILENT_US);
        ASSERT_EQ(xcp.unlocked, k == 0 ? XCP_RESOURCE_DAQ | XCP_RESOURCE_CALIBRATION : XCP_RESOURCE_DAQ);
        time_us += XCP_SILENT_US + 1;
        xcp_supervise(&xcp, false, time_us);
        ASSERT_TRUE(xcp.connected && xcp.daq.running);
        ASSERT_EQ(xcp.unlocked, XCP_RESOURCE_DAQ);
    }
    EXPECT_EQ(write_parameter(0, drive->parameters.values[0]), key_needed);
    EXPECT_EQ(send({0xDE, 0, 0, 0}), (bytes_t{0xFF, 0}));
    xcp_supervise(&xcp, false, time_us + XCP_SILENT_US + 1);
    expect_ended();
}

TEST_F(Xcp, every_write_and_every_command_of_a_measurement_is_refused_while_locked) {
    connect();
    const drive_t before = *drive;
    for (unsigned index = 0; index < PARAMETER_COUNT; index++) {
        EXPECT_EQ(write_parameter(index, drive->parameters.values[index]), failed(XCP_ERROR_ACCESS_LOCKED));
    }
    for (unsigned index = 0; index < XCP_SCOPE_WORDS; index++) {
        EXPECT_EQ(write(XCP_AREA_SCOPE + 4 * index, 1), failed(XCP_ERROR_ACCESS_LOCKED));
    }
    EXPECT_EQ(send({0xF9, 1, 0, 0}), failed(XCP_ERROR_ACCESS_LOCKED));
    for (const unsigned code : {0xD3, 0xD4, 0xD5, 0xD6, 0xDD, 0xDE, 0xE0, 0xE1, 0xE2}) {
        for (const unsigned value : {0, 1, 2}) {
            EXPECT_EQ(send({uint8_t(code), uint8_t(value), 0, 0, 0, 0, 1, 0}), failed(XCP_ERROR_ACCESS_LOCKED));
        }
    }
    EXPECT_EQ(std::memcmp(&before.parameters, &drive->parameters, sizeof before.parameters), 0);
    EXPECT_EQ(std::memcmp(&before.sampler, &drive->sampler, sizeof before.sampler), 0);
    EXPECT_EQ(std::memcmp(xcp.scope, before.comms.xcp.scope, sizeof xcp.scope), 0);
    EXPECT_EQ(std::memcmp(&xcp.daq, &before.comms.xcp.daq, sizeof xcp.daq), 0);
    EXPECT_EQ(drive->store.saving, NVM_STORE_IDLE);
    // One resource does not open the other one's.
    unlock(XCP_RESOURCE_DAQ);
    EXPECT_EQ(write_parameter(0, drive->parameters.values[0]), failed(XCP_ERROR_ACCESS_LOCKED));
    EXPECT_EQ(send({0xF9, 1, 0, 0}), failed(XCP_ERROR_ACCESS_LOCKED));
    EXPECT_EQ(write(XCP_AREA_SCOPE + 4, 1), DONE);
    connect();
    unlock(XCP_RESOURCE_CALIBRATION);
    EXPECT_EQ(write(XCP_AREA_SCOPE + 4, 1), failed(XCP_ERROR_ACCESS_LOCKED));
    EXPECT_EQ(send({0xD6}), failed(XCP_ERROR_ACCESS_LOCKED));
    EXPECT_EQ(write_parameter(0, drive->parameters.values[0]), DONE);
}

TEST_F(Xcp, reads_each_area_up_to_its_end_and_nothing_beyond) {
    connect();
    for (unsigned area = 0; area < std::size(areas); area++) {
        const uint32_t begin = areas[area], end = begin + sizes[area];
        for (unsigned bytes = 1; bytes <= 7; bytes++) {
            EXPECT_EQ(short_upload(begin, bytes).size(), 1 + bytes);
            EXPECT_EQ(short_upload(end - bytes, bytes).size(), 1 + bytes);
            EXPECT_EQ(short_upload(end - bytes + 1, bytes), failed(XCP_ERROR_OUT_OF_RANGE)) << area;
            EXPECT_EQ(short_upload(begin - bytes, bytes), failed(XCP_ERROR_OUT_OF_RANGE)) << area;
            EXPECT_EQ(short_upload(begin - 1, bytes), failed(XCP_ERROR_OUT_OF_RANGE)) << area;
        }
        const unsigned most = std::min<uint32_t>(255, sizes[area]);
        ASSERT_EQ(set_address(end - most), DONE);
        EXPECT_EQ(upload(most).size(), most);
        EXPECT_EQ(send({0xF5, 1}), failed(XCP_ERROR_OUT_OF_RANGE)) << "the address has gone on to the end";
        ASSERT_EQ(set_address(end - most + 1), DONE);
        EXPECT_EQ(send({0xF5, uint8_t(most)}), failed(XCP_ERROR_OUT_OF_RANGE));
        EXPECT_EQ(next_frame(true), bytes_t{});
        ASSERT_EQ(set_address(begin - 1), DONE);
        EXPECT_EQ(send({0xF5, 255}), failed(XCP_ERROR_OUT_OF_RANGE));
    }
    EXPECT_EQ(short_upload(0, 0), failed(XCP_ERROR_OUT_OF_RANGE));
    EXPECT_EQ(short_upload(0, 8), failed(XCP_ERROR_OUT_OF_RANGE));
    EXPECT_EQ(send({0xF5, 0}), failed(XCP_ERROR_OUT_OF_RANGE));
    for (uint32_t area = 5; area < 16; area++) {
        EXPECT_EQ(short_upload(area << 28, 1), failed(XCP_ERROR_OUT_OF_RANGE));
    }
    ASSERT_EQ(set_address(16), DONE);
    EXPECT_EQ(send({0xF6, 0, 0, 1, 0, 0, 0, 0}), failed(XCP_ERROR_OUT_OF_RANGE)) << "an address extension";
    EXPECT_EQ(xcp.address, 16u);
    EXPECT_EQ(send({0xF4, 1, 0, 1, 0, 0, 0, 0}), failed(XCP_ERROR_OUT_OF_RANGE));
}

TEST_F(Xcp, bytes_across_the_end_of_an_area_are_not_read) {
    for (unsigned area = 0; area < std::size(areas); area++) {
        const uint32_t end = areas[area] + sizes[area];
        uint8_t to[4];
        EXPECT_TRUE(xcp_memory_read(&xcp, &drive->parameters, end - 4, 4, to)) << area;
        EXPECT_FALSE(xcp_memory_read(&xcp, &drive->parameters, end - 3, 4, to)) << area;
        EXPECT_FALSE(xcp_memory_read(&xcp, &drive->parameters, end, 1, to)) << area;
    }
}

TEST_F(Xcp, blocks_of_any_size_have_the_bytes_of_the_memory_in_order) {
    connect();
    const uint32_t end = uint32_t(offsetof(drive_t, comms)); // what no command changes
    for (unsigned bytes = 1; bytes <= 255; bytes++) {
        const uint32_t from = bytes * 37 % (end - 255);
        ASSERT_EQ(set_address(from), DONE);
        EXPECT_EQ(upload(bytes), bytes_t(drive_bytes() + from, drive_bytes() + from + bytes)) << bytes;
        EXPECT_EQ(xcp.address, from + bytes);
    }
    ASSERT_EQ(set_address(XCP_AREA_PARAMETERS), DONE);
    const auto *values = reinterpret_cast<const uint8_t *>(drive->parameters.values);
    EXPECT_EQ(upload(252), bytes_t(values, values + 252));
    EXPECT_EQ(upload(4 * PARAMETER_COUNT - 252), bytes_t(values + 252, values + 4 * PARAMETER_COUNT));
}

TEST_F(Xcp, an_upload_that_is_given_up_does_not_go_on) {
    open();
    for (const bytes_t &command : {bytes_t{0xFC}, bytes_t{0xFD}, bytes_t{0xF5, 7}, bytes_t{0x00}, bytes_t{0xFE}}) {
        ASSERT_EQ(set_address(0), DONE);
        ASSERT_EQ(send({0xF5, 255}).size(), 8u);
        ASSERT_EQ(next_frame(true).size(), 8u);
        EXPECT_FALSE(send(command).empty());
        EXPECT_EQ(next_frame(true), bytes_t{});
    }
}

TEST_F(Xcp, a_parameter_is_written_as_a_set_of_one) {
    open();
    for (unsigned index = 0; index < PARAMETER_COUNT; index++) {
        const parameters_t before = drive->parameters;
        const parameter_row_t *row = parameters_row(index);
        if (row->minimum > INT32_MIN) {
            EXPECT_EQ(write_parameter(index, row->minimum - 1), failed(XCP_ERROR_OUT_OF_RANGE));
        }
        if (row->maximum < INT32_MAX) {
            EXPECT_EQ(write_parameter(index, row->maximum + 1), failed(XCP_ERROR_OUT_OF_RANGE));
        }
        EXPECT_EQ(std::memcmp(&before, &drive->parameters, sizeof before), 0);
        EXPECT_EQ(write_parameter(index, before.values[index]), DONE);
        conditions.running = true;
        EXPECT_EQ(write_parameter(index, before.values[index]),
                  parameters_tunable(index) ? DONE : failed(XCP_ERROR_WRITE_PROTECTED));
        conditions.running = false;
    }
    EXPECT_EQ(write_parameter(PARAMETER_OVER_SPEED_RPM, 1000), DONE);
    EXPECT_EQ(drive->parameters.values[PARAMETER_OVER_SPEED_RPM], 1000);
    EXPECT_TRUE(parameters_intact(&drive->parameters));
    EXPECT_EQ(xcp.address, XCP_AREA_PARAMETERS + 4 * PARAMETER_OVER_SPEED_RPM + 4) << "the next one";
    EXPECT_EQ(write_parameter(PARAMETER_COUNT, 0), failed(XCP_ERROR_OUT_OF_RANGE));
    const int32_t over_voltage = drive->parameters.values[PARAMETER_OVER_VOLTAGE_V];
    EXPECT_EQ(write_parameter(PARAMETER_UNDER_VOLTAGE_V, over_voltage), failed(XCP_ERROR_OUT_OF_RANGE));
    EXPECT_FALSE(drive->comms.set.begun);
}

TEST_F(Xcp, a_write_leaves_a_staged_set_of_the_other_protocol_alone) {
    open();
    drive->comms.set.begun = true;
    const parameter_set_t staged = drive->comms.set;
    const parameters_t before = drive->parameters;
    EXPECT_EQ(write_parameter(PARAMETER_OVER_SPEED_RPM, 1000), failed(XCP_ERROR_BUSY));
    EXPECT_EQ(std::memcmp(&staged, &drive->comms.set, sizeof staged), 0);
    EXPECT_EQ(std::memcmp(&before, &drive->parameters, sizeof before), 0);
    drive->comms.set.begun = false;
    drive->parameters.values[3] ^= 1 << 9; // has changed in memory
    EXPECT_EQ(write_parameter(PARAMETER_OVER_SPEED_RPM, 1000), failed(XCP_ERROR_ACCESS_DENIED));
    EXPECT_FALSE(parameters_intact(&drive->parameters)) << "not covered up";
    EXPECT_EQ(send({0xF9, 1, 0, 0}), failed(XCP_ERROR_ACCESS_DENIED));
}

TEST_F(Xcp, memory_and_texts_are_write_protected_and_parts_of_words_refused) {
    open();
    const drive_t before = *drive;
    for (const uint32_t address : {0u, 4u, uint32_t(sizeof(drive_t)), XCP_AREA_TEXT, 0x40000000u, 0xF0000000u}) {
        EXPECT_EQ(write(address, 1), failed(XCP_ERROR_WRITE_PROTECTED)) << address;
    }
    for (const uint32_t area : {XCP_AREA_PARAMETERS, XCP_AREA_SCOPE}) {
        for (const unsigned odd : {1, 2, 3}) {
            EXPECT_EQ(write(area + odd, 1), failed(XCP_ERROR_OUT_OF_RANGE));
        }
        for (const unsigned bytes : {0, 1, 2, 3, 5, 6, 7, 255}) {
            ASSERT_EQ(set_address(area), DONE);
            EXPECT_EQ(send({0xF0, uint8_t(bytes), 1, 2, 3, 4, 5, 6}), failed(XCP_ERROR_OUT_OF_RANGE));
            EXPECT_EQ(xcp.address, area);
        }
    }
    EXPECT_EQ(write(XCP_AREA_SCOPE + 4 * XCP_SCOPE_WORDS, 1), failed(XCP_ERROR_OUT_OF_RANGE));
    EXPECT_EQ(std::memcmp(&before, drive.get(), offsetof(drive_t, comms)), 0);
    EXPECT_EQ(std::memcmp(&before.sampler, &drive->sampler, sizeof before.sampler), 0);
}

TEST_F(Xcp, stores_the_parameters_while_the_drive_does_not_run) {
    open();
    for (const unsigned mode : {0, 2, 3, 4, 8, 255}) {
        EXPECT_EQ(send({0xF9, uint8_t(mode), 0, 0}), failed(XCP_ERROR_OUT_OF_RANGE)) << mode;
    }
    conditions.running = true;
    EXPECT_EQ(send({0xF9, 1, 0, 0}), failed(XCP_ERROR_ACCESS_DENIED));
    EXPECT_EQ(drive->store.saving, NVM_STORE_IDLE);
    conditions.running = false;
    ASSERT_EQ(write_parameter(PARAMETER_OVER_SPEED_RPM, 1000), DONE);
    EXPECT_EQ(send({0xF9, 1, 0, 0}), DONE);
    EXPECT_EQ(send({0xFD})[1], 0x01) << "STORE_CAL_REQ until it is done";
    while (drive->store.saving == NVM_STORE_SAVING) {
        nvm_store_step(&drive->store, &memory->hal, &drive->parameters, time_us++, true);
    }
    EXPECT_EQ(send({0xFD})[1], 0x00);
    started_t next{};
    start_drive(&next, memory.get());
    EXPECT_EQ(next.parameters.values[PARAMETER_OVER_SPEED_RPM], 1000);
}

TEST_F(Xcp, the_area_of_the_buffer_arms_triggers_and_stops_it) {
    open();
    const uint32_t setup[XCP_SCOPE_WORDS] = {
        0, SAMPLER_EVENT_BACKGROUND, 2, 100, SAMPLER_EQUAL, 0xFFFFFFFFu, 40, 16, 24, 1, 2, 8, 12};
    for (unsigned i = 1; i < XCP_SCOPE_WORDS; i++) {
        ASSERT_EQ(write(XCP_AREA_SCOPE + 4 * i, setup[i]), DONE);
        EXPECT_EQ(short_upload(XCP_AREA_SCOPE + 4 * i, 4), bytes_t{0xFF} + word(setup[i]));
    }
    const auto refuses = [&](unsigned member, uint32_t value) {
        ASSERT_EQ(write(XCP_AREA_SCOPE + 4 * member, value), DONE);
        const sampler_t before = drive->sampler;
        EXPECT_EQ(write(XCP_AREA_SCOPE, 1), failed(XCP_ERROR_OUT_OF_RANGE)) << member << " " << value;
        EXPECT_EQ(std::memcmp(&before, &drive->sampler, sizeof before), 0);
        ASSERT_EQ(write(XCP_AREA_SCOPE + 4 * member, setup[member]), DONE);
    };
    const uint32_t end = sizeof(drive_t);
    const std::pair<unsigned, std::vector<uint32_t>> wrong[] = {
        {XCP_SCOPE_EVENT, {0, 5, 258, 0xFFFFFFFFu}},
        {XCP_SCOPE_DIVIDER, {0, 65536, 65537}},
        {XCP_SCOPE_BEFORE, {2047, 65536 + 5}},
        {XCP_SCOPE_CONDITION, {SAMPLER_CONDITIONS, 256, 0xFFFFFFFFu}},
        {XCP_SCOPE_VARIABLE, {end, 0x40000, 0x80000000u}},
        {XCP_SCOPE_LEFT, {32, 256}},
        {XCP_SCOPE_RIGHT, {32, 256, 256 + 5}},
        {XCP_SCOPE_CHANNELS, {0, 9, 256 + 2}},
        {XCP_SCOPE_CHANNEL, {1, 2, end, 0x40008}},
        {XCP_SCOPE_CHANNEL + 1, {3, 0xFFFFFFFCu}}};
    for (const auto &[member, values] : wrong) {
        for (const uint32_t value : values) {
            refuses(member, value);
        }
    }
    EXPECT_EQ(write(XCP_AREA_SCOPE, 3), failed(XCP_ERROR_OUT_OF_RANGE));
    EXPECT_EQ(write(XCP_AREA_SCOPE, 1), DONE);
    const sampler_t &armed = drive->sampler;
    EXPECT_EQ(armed.state, SAMPLER_ARMED);
    EXPECT_EQ(armed.event, uint32_t(SAMPLER_EVENT_BACKGROUND));
    EXPECT_TRUE(armed.divider == 2 && armed.capacity - armed.waiting_floor == 100 && armed.record_words == 2);
    EXPECT_TRUE(armed.factor == 1u << 16 && armed.window_end == 0xFFFFFFFFu && armed.window_length == 0xFFFFFFu);
    const auto word_of = [](uint32_t part) { return uint64_t(part) * DRIVE_WORDS >> 32; };
    EXPECT_TRUE(word_of(armed.trigger_part) == 10 && word_of(armed.part[0]) == 2 && word_of(armed.part[1]) == 3);
    EXPECT_EQ(write(XCP_AREA_SCOPE, 2), DONE);
    while (drive->sampler.event != 0) {
        event(SAMPLER_EVENT_BACKGROUND);
    }
    EXPECT_EQ(drive->sampler.state, SAMPLER_COMPLETE);
    EXPECT_EQ(write(XCP_AREA_SCOPE, 1), DONE);
    EXPECT_EQ(write(XCP_AREA_SCOPE, 0), DONE);
    EXPECT_EQ(drive->sampler.state, SAMPLER_OFF);
    measure();
    for (const uint32_t command : {0u, 1u, 2u, 3u}) {
        EXPECT_EQ(write(XCP_AREA_SCOPE, command), failed(XCP_ERROR_DAQ_ACTIVE)) << "the recorder streams";
    }
    EXPECT_EQ(drive->sampler.state, SAMPLER_STREAMS);
}

} // namespace
