// Programming of machine tables by XCP: the bytes of every response, and what the memory has after. [SR-61]
#include <algorithm>
#include <random>
#include <utility>

#include "support/xcp_bench.h"

namespace {

using namespace xcp_bench;

const bytes_t DONE{0xFF}, STARTED{0xFF, 0, 0, 8, 0, 0, 0};
constexpr unsigned PASSES_MAX = 20; // of the background for one command

class XcpProgram : public XcpBench {
  protected:
    XcpProgram() {
        tables = &drive->tables;
        table_store_init(tables, &memory->hal);
        wanted.machine_hash = 0x12345678;
    }

    // The response to a command, which may have waited for the memory.
    bytes_t settled(const bytes_t &command) {
        bytes_t response = send(command);
        for (unsigned pass = 0; response.empty() && pass < PASSES_MAX; pass++) {
            table_store_step(tables, &memory->hal, true);
            response = late();
        }
        return response;
    }

    bytes_t late() {
        hal_can_frame_t frame{};
        if (!xcp_late_response(&xcp, tables, &frame)) {
            return {};
        }
        EXPECT_EQ(frame.identifier, uint32_t(DRIVE_XCP_RESPONSE_FRAME_ID));
        return bytes_t(frame.data, frame.data + frame.length);
    }

    void open_programming() {
        connect();
        ASSERT_EQ(unlock(XCP_RESOURCE_PROGRAMMING), (bytes_t{0xFF, 0x05}));
        ASSERT_EQ(send({0xD2}), STARTED);
    }

    bytes_t clear(uint32_t bytes = sizeof(machine_tables_t)) { return bytes_t{0xD1, 0, 0, 0} + word(bytes); }

    bytes_t part(size_t at, unsigned count) {
        const auto *bytes = reinterpret_cast<const uint8_t *>(&wanted) + at;
        return bytes_t{0xD0, uint8_t(count)} + bytes_t(bytes, bytes + count);
    }

    void open_cleared() {
        open_programming();
        ASSERT_EQ(set_address(XCP_AREA_TABLES), DONE);
        ASSERT_EQ(settled(clear()), DONE);
    }

    void program(size_t end = sizeof(machine_tables_t)) {
        for (size_t at = 0; at < end; at += 6) {
            ASSERT_EQ(settled(part(at, unsigned(std::min<size_t>(6, end - at)))), DONE) << at;
        }
    }

    // Whether a start has the wanted tables.
    bool started() {
        machine_tables_t loaded;
        return table_store_load(&memory->hal, 40000, &machine_tables, &loaded) &&
               std::memcmp(&loaded, &wanted, sizeof loaded) == 0;
    }

    machine_tables_t wanted = machine_tables;
};

TEST_F(XcpProgram, is_offered_as_a_resource_only_where_the_port_loads_tables) {
    EXPECT_EQ(send({0xFF, 0}), (bytes_t{0xFF, 0x15, 0xC0, 8, 8, 0, 1, 1}));
    EXPECT_EQ(send({0xFD}), (bytes_t{0xFF, 0, 0x15, 0, 0, 0}));
    tables = nullptr;
    EXPECT_EQ(send({0xFF, 0}), (bytes_t{0xFF, 0x05, 0xC0, 8, 8, 0, 1, 1}));
    EXPECT_EQ(unlock(XCP_RESOURCE_PROGRAMMING), failed(XCP_ERROR_OUT_OF_RANGE));
    for (const unsigned code : {0xCF, 0xD0, 0xD1, 0xD2}) {
        EXPECT_EQ(send({uint8_t(code), 0, 0, 0, 0, 0, 0, 0}), failed(XCP_ERROR_UNKNOWN)) << code;
    }
}

TEST_F(XcpProgram, writes_tables_for_the_next_start_and_ends_the_session) {
    open_cleared();
    program();
    EXPECT_FALSE(started());
    EXPECT_EQ(settled({0xD0, 0}), DONE);
    EXPECT_TRUE(started());
    EXPECT_EQ(send({0xCF}), DONE);
    EXPECT_FALSE(xcp.connected || xcp.programming || xcp.pending);
    EXPECT_EQ(send({0xFD}), bytes_t{});
}

TEST_F(XcpProgram, needs_its_own_resource_and_the_commands_in_their_order) {
    const bytes_t commands[] = {{0xD2}, clear(), part(0, 6), {0xD0, 0}};
    open(); // the other resources
    for (const bytes_t &command : commands) {
        EXPECT_EQ(send(command), failed(XCP_ERROR_ACCESS_LOCKED));
    }
    unlock(XCP_RESOURCE_PROGRAMMING);
    for (const bytes_t &command : {clear(), part(0, 6), bytes_t{0xD0, 0}}) {
        EXPECT_EQ(send(command), failed(XCP_ERROR_SEQUENCE)) << "before the start";
    }
    EXPECT_EQ(send({0xD2}), STARTED);
    ASSERT_EQ(set_address(XCP_AREA_TABLES), DONE);
    EXPECT_EQ(send(part(0, 6)), failed(XCP_ERROR_SEQUENCE)) << "before the clearing";
    EXPECT_EQ(send({0xD0, 0}), failed(XCP_ERROR_SEQUENCE));
    EXPECT_EQ(memory->hal.nvm.operations, 0u);
    EXPECT_EQ(send({0xD0, 6, 1, 2, 3}), failed(XCP_ERROR_SYNTAX)) << "bytes that have not come";
    EXPECT_EQ(send({0xD1, 0, 0, 0}), failed(XCP_ERROR_SYNTAX));
}

TEST_F(XcpProgram, needs_its_start_in_each_session) {
    open_cleared();
    connect();
    unlock(XCP_RESOURCE_PROGRAMMING);
    ASSERT_EQ(set_address(XCP_AREA_TABLES), DONE);
    for (const bytes_t &command : {clear(), part(0, 6), bytes_t{0xD0, 0}}) {
        EXPECT_EQ(send(command), failed(XCP_ERROR_SEQUENCE));
    }
    EXPECT_EQ(send({0xD2}), STARTED);
    EXPECT_EQ(settled(clear()), DONE);
}

TEST_F(XcpProgram, clears_the_whole_area_by_its_address_alone) {
    open_programming();
    constexpr uint32_t BYTES = sizeof(machine_tables_t);
    ASSERT_EQ(set_address(XCP_AREA_TABLES + 4), DONE);
    EXPECT_EQ(send(clear()), failed(XCP_ERROR_OUT_OF_RANGE));
    ASSERT_EQ(set_address(XCP_AREA_TABLES), DONE);
    for (const uint32_t bytes : {0u, BYTES - 1, BYTES + 1, UINT32_MAX}) {
        EXPECT_EQ(send(clear(bytes)), failed(XCP_ERROR_OUT_OF_RANGE)) << bytes;
    }
    EXPECT_EQ(send(bytes_t{0xD1, 1, 0, 0} + word(BYTES)), failed(XCP_ERROR_OUT_OF_RANGE)) << "functional access";
    EXPECT_EQ(memory->hal.nvm.operations, 0u);
}

TEST_F(XcpProgram, takes_bytes_in_succession_only) {
    open_cleared();
    EXPECT_EQ(settled(part(0, 6)), DONE);
    ASSERT_EQ(set_address(XCP_AREA_TABLES), DONE);
    EXPECT_EQ(send(part(0, 6)), failed(XCP_ERROR_OUT_OF_RANGE)) << "again";
    ASSERT_EQ(set_address(XCP_AREA_TABLES + 12), DONE);
    EXPECT_EQ(send(part(12, 6)), failed(XCP_ERROR_OUT_OF_RANGE)) << "beyond";
    EXPECT_EQ(send(bytes_t{0xD0, 7, 0, 0, 0, 0, 0, 0}), failed(XCP_ERROR_OUT_OF_RANGE)) << "more than fit";
    EXPECT_EQ(send({0xD0, 0}), failed(XCP_ERROR_SEQUENCE)) << "an end before the last byte";
    ASSERT_EQ(set_address(XCP_AREA_TABLES + 6), DONE);
    EXPECT_EQ(settled(part(6, 6)), DONE);
    EXPECT_EQ(drive->tables.taken, 12u);
}

TEST_F(XcpProgram, begins_in_no_run_and_beside_no_measurement) {
    connect();
    unlock(XCP_RESOURCE_PROGRAMMING);
    conditions.running = true;
    EXPECT_EQ(send({0xD2}), failed(XCP_ERROR_GENERIC));
    conditions.running = false;
    xcp.daq.running = true;
    EXPECT_EQ(send({0xD2}), failed(XCP_ERROR_DAQ_ACTIVE));
    xcp.daq.running = false;
    EXPECT_EQ(send({0xD2}), STARTED);
}

TEST_F(XcpProgram, a_command_that_waits_for_the_memory_is_answered_once_and_others_meanwhile_are_refused_as_busy) {
    open_programming();
    set_address(XCP_AREA_TABLES);
    EXPECT_EQ(send(clear()), bytes_t{});
    EXPECT_EQ(late(), bytes_t{});
    for (const bytes_t &command :
         {bytes_t{0xFD}, clear(), part(0, 6), bytes_t{0xD2}, bytes_t{0xF6, 0, 0, 0, 0, 0, 0, 0}}) {
        EXPECT_EQ(send(command), failed(XCP_ERROR_BUSY));
    }
    EXPECT_EQ(send({0xFC}), failed(XCP_ERROR_SYNCHRONISED));
    EXPECT_TRUE(xcp.pending);
    table_store_step(tables, &memory->hal, false);
    EXPECT_EQ(late(), bytes_t{}) << "in a run the memory is not written";
    for (unsigned pass = 0; table_store_busy(tables) && pass < PASSES_MAX; pass++) {
        EXPECT_EQ(late(), bytes_t{});
        table_store_step(tables, &memory->hal, true);
    }
    EXPECT_EQ(late(), DONE);
    EXPECT_EQ(late(), bytes_t{});
    EXPECT_EQ(send({0xFD}).size(), 6u);
}

TEST_F(XcpProgram, the_end_of_the_session_gives_up_the_transfer_and_the_next_one_begins_anew) {
    for (const bytes_t &end : {bytes_t{0xFE}, bytes_t{0xFF, 0}, bytes_t{0xCF}}) {
        open_cleared();
        program(600);
        send(end);
        EXPECT_FALSE(xcp.programming || xcp.pending);
    }
    open_programming();
    set_address(XCP_AREA_TABLES);
    send(clear());
    EXPECT_EQ(send({0xFE}), DONE) << "while it waits";
    EXPECT_EQ(late(), bytes_t{}) << "nobody waits";
    open_cleared();
    program();
    EXPECT_EQ(settled({0xD0, 0}), DONE);
    EXPECT_TRUE(started());
}

TEST_F(XcpProgram, a_memory_that_fails_is_an_error) {
    open_cleared();
    memory->hal.deaf_word = &memory->hal.nvm.word[6][4]; // of bytes 16 to 23, behind header and identity
    program(18);
    EXPECT_EQ(settled(part(18, 6)), failed(XCP_ERROR_GENERIC));
    EXPECT_EQ(settled(part(24, 6)), failed(XCP_ERROR_SEQUENCE));
    EXPECT_EQ(settled({0xD0, 0}), failed(XCP_ERROR_SEQUENCE));
    EXPECT_FALSE(started());
}

TEST_F(XcpProgram, a_flipped_bit_that_says_a_command_waits_is_no_access_where_there_are_no_tables) {
    tables = nullptr;
    connect();
    xcp.pending = true;
    EXPECT_EQ(late(), bytes_t{});
    EXPECT_EQ(send({0xFD}), failed(XCP_ERROR_BUSY));
    EXPECT_EQ(send({0xFF, 0}).size(), 8u);
    EXPECT_EQ(send({0xFD}).size(), 6u);
}

TEST_F(XcpProgram, silence_locks_it_again) {
    open_cleared();
    time_us += XCP_SILENT_US + 1;
    xcp_supervise(&xcp, false, time_us);
    EXPECT_FALSE(xcp.connected || xcp.programming);
    EXPECT_EQ(xcp.unlocked, 0);
}

// With sanitizers, too: commands in any order, with any lengths, passes in which the memory is written or not.
TEST_F(XcpProgram, random_commands_write_nothing_without_key_and_start_and_no_page_but_those_of_the_slots) {
    std::mt19937 random(1);
    const auto any = [&](unsigned end) { return unsigned(random() % end); };
    unsigned written = 0, answers = 0;
    bool begun = false;
    for (unsigned frame = 0; frame < 100000; frame++) {
        const uint32_t operations = memory->hal.nvm.operations;
        const size_t next = tables->taken;
        switch (any(12)) {
        case 0:
            if (!xcp.connected || any(50) == 0) {
                send({0xFF, 0});
            }
            break;
        case 1:
            unlock(uint8_t(1u << any(5)));
            break;
        case 2:
            send({0xD2});
            break;
        case 3:
            set_address(any(4) ? XCP_AREA_TABLES + (any(2) ? uint32_t(next) : 0u) : uint32_t(random()));
            break;
        case 4:
            if (any(8) == 0) {
                const bool open = xcp.programming && (xcp.unlocked & XCP_RESOURCE_PROGRAMMING) != 0;
                const bool taken = send(any(8) ? clear() : clear(uint32_t(random()))).empty() && xcp.connected;
                ASSERT_TRUE(open || !taken);
                begun = begun || taken;
            }
            break;
        case 5:
            send({0xD0, uint8_t(any(2) ? 0 : any(256))});
            break;
        case 6: {
            bytes_t command(1 + any(8));
            for (uint8_t &byte : command) {
                byte = uint8_t(random());
            }
            command[0] = uint8_t(0xC8 + any(12));
            send(command);
            break;
        }
        default:
            send(part(std::min<size_t>(next, sizeof wanted - 6), 1 + any(6)));
        }
        conditions.running = any(50) ? conditions.running : !conditions.running;
        for (unsigned pass = any(4); pass > 0; pass--) {
            table_store_step(tables, &memory->hal, !conditions.running);
            answers += !late().empty();
        }
        const bool wrote = memory->hal.nvm.operations != operations;
        ASSERT_TRUE(begun || !wrote);
        written += wrote;
        time_us += any(1000);
        xcp_supervise(&xcp, any(500) == 0, time_us);
    }
    for (unsigned page = 0; page < 6; page++) {
        for (const uint64_t word : memory->hal.nvm.word[page]) {
            ASSERT_EQ(word, HAL_NVM_ERASED);
        }
    }
    EXPECT_GT(written, 1000u);
    EXPECT_GT(answers, 1000u);
}

TEST_F(XcpProgram, the_tables_in_effect_are_read_byte_by_byte_and_no_byte_more) {
    connect();
    const auto *bytes = reinterpret_cast<const uint8_t *>(&machine_tables);
    for (const uint32_t at : {0u, 1u, 1000u, uint32_t(sizeof machine_tables) - 7}) {
        const bytes_t response = send(bytes_t{0xF4, 7, 0, 0} + word(XCP_AREA_TABLES + at));
        ASSERT_EQ(response.size(), 8u);
        EXPECT_EQ(std::memcmp(response.data() + 1, bytes + at, 7), 0) << at;
    }
    EXPECT_EQ(send(bytes_t{0xF4, 7, 0, 0} + word(XCP_AREA_TABLES + sizeof machine_tables - 6)),
              failed(XCP_ERROR_OUT_OF_RANGE));
    unlock(XCP_RESOURCE_CALIBRATION);
    set_address(XCP_AREA_TABLES);
    EXPECT_EQ(send({0xF0, 4, 0, 0, 0, 0}), failed(XCP_ERROR_WRITE_PROTECTED)) << "no download";
}

} // namespace
