// Random frames of XCP, most of them commands with plausible parameters: no memory of the drive changes but what an
// accepted command changes, and nothing opens without its key. Built with sanitizers, too.
#include <algorithm>
#include <random>

#include "support/xcp_bench.h"

namespace {

using namespace xcp_bench;

// Sanitizers take five times as long.
#ifdef __SANITIZE_ADDRESS__
constexpr unsigned FRAMES = 200000;
#else
constexpr unsigned FRAMES = 1000000;
#endif

// The drive but for the recorder: begin and size of each part.
constexpr std::pair<size_t, size_t> OTHER_MEMORY[] = {
    {0, offsetof(drive_t, sampler)},
    {offsetof(drive_t, comms), sizeof(drive_t) - offsetof(drive_t, comms)},
};

class XcpFuzz : public XcpBench {
  protected:
    unsigned any(unsigned end) { return unsigned(random() % end); }
    bool rarely(unsigned one_in) { return any(one_in) == 0; }

    uint32_t any_address() {
        const uint32_t begins[] = {XCP_AREA_MEMORY, XCP_AREA_PARAMETERS, XCP_AREA_SCOPE, XCP_AREA_TEXT};
        const uint32_t sizes[] = {sizeof(drive_t), 4 * PARAMETER_COUNT, 4 * XCP_SCOPE_WORDS,
                                  XCP_TEXT_BYTES * (1 + XCP_EVENTS)};
        const unsigned area = any(4);
        switch (any(8)) {
        case 0:
            return uint32_t(random());
        case 1:
            return begins[area] + sizes[area] - 8 + any(16);
        case 2:
            return begins[area] + any(sizes[area]);
        default:
            return begins[area] + 4 * any(sizes[area] / 4);
        }
    }

    uint32_t any_value() {
        const uint32_t of_address = (xcp.address & ~XCP_AREA) / 4;
        if ((xcp.address & XCP_AREA) == XCP_AREA_PARAMETERS && of_address < PARAMETER_COUNT && !rarely(4)) {
            const parameter_row_t *row = parameters_row(of_address);
            const auto present = uint32_t(drive->parameters.values[of_address]);
            const uint32_t values[] = {present,      present,     uint32_t(row->minimum), uint32_t(row->maximum),
                                       present + 1u, present - 1u};
            return values[any(6)];
        }
        const uint32_t values[] = {any(4), any(10), 4 * any(DRIVE_WORDS), any(70000), uint32_t(random())};
        return values[any(5)];
    }

    bytes_t any_command() {
        const uint8_t small = uint8_t(any(4)), byte = uint8_t(random());
        switch (any(20)) {
        case 0:
        case 1:
            return bytes_t{0xF6, 0, 0, uint8_t(rarely(20))} + word(any_address());
        case 2:
        case 3:
        case 4:
            return bytes_t{0xF0, uint8_t(rarely(10) ? byte : 4)} + word(any_value()) + bytes_t{0, 0};
        case 5:
            return {0xF5, uint8_t(rarely(2) ? byte : any(16))};
        case 6:
            return bytes_t{0xF4, uint8_t(any(9)), 0, uint8_t(rarely(20))} + word(any_address());
        case 7:
            return {0xDE, small, 0, 0};
        case 8:
            return {0xDD, small};
        case 9:
            return {0xE2, 0, 0, 0, uint8_t(any(9)), uint8_t(any(5))};
        case 10:
        case 11:
            return bytes_t{0xE1, uint8_t(rarely(20) ? byte : 0xFF), uint8_t(1 + small), 0} +
                   word(rarely(4) ? any_address() : 4 * any(DRIVE_WORDS));
        case 12:
            return {0xE0, uint8_t(rarely(10) ? byte : 0x10 * any(2)), 0, 0, small, 0, uint8_t(rarely(2) ? byte : 1), 0};
        case 13:
            return {uint8_t(0xD7 + any(9)), byte, small, 0, byte, byte, byte, byte};
        case 14:
            return {uint8_t(0xD3 + any(3)), 0, uint8_t(rarely(3)), 0, uint8_t(any(9)), uint8_t(any(9))};
        case 15:
            return {uint8_t(0xF9 + any(3)), uint8_t(any(3)), 0, 0};
        case 16:
            return {0xF8, 0, uint8_t(1 << small)};
        case 17:
            return bytes_t{0xF7, uint8_t(rarely(10) ? byte : 4)} + word(rarely(3) ? uint32_t(random()) : ~last_seed);
        case 18:
            return {uint8_t(rarely(8) ? 0xFE : 0xFD)};
        default: {
            bytes_t bytes(any(17));
            for (uint8_t &any_byte : bytes) {
                any_byte = uint8_t(random());
            }
            if (!bytes.empty() && rarely(2)) {
                bytes[0] = uint8_t(0xD0 + any(0x30));
            }
            return bytes;
        }
        }
    }

    // A list that runs, unless something on the way is refused.
    void measure() {
        const unsigned odts = 1 + any(8);
        check({0xD6});
        check({0xD5, 0, 1, 0});
        check({0xD4, 0, 0, 0, uint8_t(odts)});
        for (unsigned odt = 0; odt < odts; odt++) {
            check({0xD3, 0, 0, 0, uint8_t(odt), 1});
        }
        for (unsigned odt = 0; odt < odts; odt++) {
            check({0xE2, 0, 0, 0, uint8_t(odt), 0});
            check(bytes_t{0xE1, 0xFF, 4, 0} + word(4 * any(DRIVE_WORDS)));
        }
        check({0xE0, uint8_t(0x10 * any(2)), 0, 0, uint8_t(any(3)), 0, uint8_t(1 + any(3)), 0});
        check({0xDE, 1, 0, 0});
    }

    // A buffer that waits, likewise.
    void arm() {
        const uint32_t values[] = {
            1 + any(3), 1 + any(3), any(100),  any(SAMPLER_CONDITIONS), any(5), 4 * any(DRIVE_WORDS), any(32),
            any(32),    any(2),     1 + any(8)};
        for (unsigned i = 0; i < XCP_SCOPE_WORDS; i++) {
            check(bytes_t{0xF6, 0, 0, 0} + word(XCP_AREA_SCOPE + 4 * ((i + 1) % XCP_SCOPE_WORDS)));
            const uint32_t value = i < 10 ? values[i] : 4 * any(DRIVE_WORDS);
            check(bytes_t{0xF0, 4} + word(i + 1 < XCP_SCOPE_WORDS ? value : 1));
        }
    }

    // Sends a command and compares the drive with what it was before.
    void check(const bytes_t &command) {
        for (const auto &[begin, bytes] : OTHER_MEMORY) {
            std::memcpy((uint8_t *)before.get() + begin, (uint8_t *)drive.get() + begin, bytes);
        }
        const bool connected = xcp.connected;
        const uint32_t address = xcp.address;
        const bytes_t response = command.size() > 8 ? (sent_long(command), bytes_t{}) : send(command);
        const uint8_t code = command.empty() ? 0 : command[0];
        ASSERT_EQ(response.empty(),
                  command.empty() || command.size() > 8 || (!connected && (code != 0xFF || command.size() < 2)));
        const bool done = !response.empty() && response[0] == 0xFF;
        ASSERT_TRUE(response.empty() || done || (response[0] == 0xFE && response.size() == 2));
        follow_locks(command, done, response);
        ASSERT_EQ(xcp.unlocked, unlocked) << "frame " << frame;
        drive_t &allowed = *before;
        if (done && code == 0xF0 && (address & XCP_AREA) == XCP_AREA_PARAMETERS) {
            ASSERT_NE(unlocked & XCP_RESOURCE_CALIBRATION, 0);
            ASSERT_FALSE(allowed.comms.set.begun);
            const uint32_t index = (address - XCP_AREA_PARAMETERS) / 4;
            ASSERT_TRUE(!conditions.running || parameters_tunable(index));
            std::memcpy(&allowed.parameters.values[index], &command[2], 4);
            allowed.parameters.sum = drive->parameters.sum;
            allowed.parameters.revision++;
            writes++;
        }
        if (done && code == 0xF9) {
            ASSERT_FALSE(conditions.running);
            ASSERT_EQ(drive->store.saving, NVM_STORE_SAVING);
            drive->store.saving = allowed.store.saving;
            stores++;
        }
        ASSERT_TRUE(parameters_intact(&drive->parameters));
        if (!allowed.comms.set.begun) {
            ASSERT_FALSE(drive->comms.set.begun);
            allowed.comms.set = drive->comms.set; // where a write is staged
        }
        allowed.comms.xcp = drive->comms.xcp;
        for (const auto &[begin, bytes] : OTHER_MEMORY) {
            ASSERT_EQ(std::memcmp((uint8_t *)before.get() + begin, (uint8_t *)drive.get() + begin, bytes), 0)
                << "frame " << frame;
        }
        ASSERT_EQ(xcp.memory, drive.get());
        ASSERT_EQ(xcp.words, DRIVE_WORDS);
        ASSERT_EQ(xcp.sampler, &drive->sampler);
        frame++;
        refused += !done && !response.empty();
    }

    // A frame of the wire with a length code above 8.
    void sent_long(const bytes_t &command) {
        hal_can_frame_t response{};
        ASSERT_FALSE(receive(command, response));
    }

    void follow_locks(const bytes_t &command, bool done, const bytes_t &response) {
        const uint8_t code = command.empty() || command.size() > 8 ? 0 : command[0];
        if (code == 0xF8 && done && response[1] != 0) {
            seed_resource = command[2];
        } else if (code == 0xF7 && done) {
            ASSERT_EQ(bytes_t(command.begin() + 2, command.begin() + 6), word(~last_seed));
            unlocked |= seed_resource;
        } else if ((code == 0xFE || code == 0xFF) && done) {
            unlocked = 0;
        } else if (code == 0xF7 && response == failed(XCP_ERROR_ACCESS_LOCKED)) {
            unlocked = 0;
        }
    }

    // Time, events, frames that leave, and what the drive and the other protocol do meanwhile.
    void pass() {
        time_us += any(rarely(50) ? 700000 : 200);
        for (unsigned k = any(rarely(20) ? 3000 : 6); k > 0; k--) {
            event(sampler_event_t(1 + any(3)));
        }
        for (unsigned k = any(8); k > 0; k--) {
            measured += xcp.upload_left == 0 && !next_frame(rarely(4)).empty();
        }
        completed += drive->sampler.state == SAMPLER_COMPLETE;
        conditions.running = rarely(200) ? !conditions.running : conditions.running;
        drive->comms.set.begun =
            rarely(drive->comms.set.begun ? 10 : 200) ? !drive->comms.set.begun : drive->comms.set.begun;
        if (rarely(1000)) {
            time_us += rarely(2) ? XCP_SILENT_US + 1 : 0x80000000u;
        }
        xcp_supervise(&xcp, rarely(5000), time_us);
        if (!xcp.connected) {
            unlocked = 0;
        } else if (time_us - xcp.received_us > XCP_SILENT_US) {
            ASSERT_TRUE(xcp.daq.running);
            unlocked &= XCP_RESOURCE_DAQ;
        }
    }

    std::mt19937 random{2026};
    std::unique_ptr<drive_t> before = std::make_unique<drive_t>();
    uint8_t unlocked = 0, seed_resource = 0;
    unsigned frame = 0, writes = 0, stores = 0, refused = 0, measured = 0, completed = 0;
};

TEST_F(XcpFuzz, no_frame_changes_what_it_must_not) {
    while (frame < FRAMES) {
        if (rarely(100) || (!xcp.connected && rarely(5))) {
            check({0xFF, uint8_t(any(3))});
        }
        if (rarely(40)) {
            for (const unsigned resource : {1, 4}) {
                check({0xF8, 0, uint8_t(resource)});
                check(bytes_t{0xF7, 4} + word(~last_seed));
            }
        }
        if (rarely(60)) {
            rarely(2) ? measure() : arm();
        }
        if (rarely(10)) {
            check(bytes_t{0xF6, 0, 0, 0} + word(XCP_AREA_PARAMETERS + 4 * any(PARAMETER_COUNT)));
            check(bytes_t{0xF0, 4} + word(any_value()));
        }
        bytes_t command = any_command();
        if (!command.empty() && rarely(20)) {
            command.resize(1 + any(8));
        }
        check(command);
        pass();
        if (HasFailure()) {
            break;
        }
    }
    EXPECT_GT(writes, 1000u);
    EXPECT_GT(stores, 100u);
    EXPECT_GT(refused, FRAMES / 10);
    EXPECT_LT(refused, FRAMES * 9 / 10);
    EXPECT_GT(measured, 5000u);
    EXPECT_GT(completed, 100u);
}

} // namespace
