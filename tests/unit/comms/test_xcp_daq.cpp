// The DAQ list of XCP: sequence of its allocation, what it refuses, and the bytes of its frames.
#include <algorithm>
#include <random>
#include <utility>

#include "support/xcp_bench.h"

namespace {

using namespace xcp_bench;

const bytes_t DONE{0xFF};
constexpr unsigned WORDS = 8;

struct entry_t {
    uint32_t address;
    unsigned bytes;
};
using odts_t = std::vector<std::vector<entry_t>>;

class XcpDaq : public XcpBench {
  protected:
    XcpDaq() { open(); }

    bytes_t free_daq() { return send({0xD6}); }
    bytes_t alloc_daq(unsigned lists) { return send({0xD5, 0, uint8_t(lists), uint8_t(lists >> 8)}); }
    bytes_t alloc_odt(unsigned odts, unsigned list = 0) {
        return send({0xD4, 0, uint8_t(list), uint8_t(list >> 8), uint8_t(odts)});
    }
    bytes_t alloc_entries(unsigned odt, unsigned entries, unsigned list = 0) {
        return send({0xD3, 0, uint8_t(list), uint8_t(list >> 8), uint8_t(odt), uint8_t(entries)});
    }
    bytes_t set_pointer(unsigned odt, unsigned entry, unsigned list = 0) {
        return send({0xE2, 0, uint8_t(list), uint8_t(list >> 8), uint8_t(odt), uint8_t(entry)});
    }
    bytes_t write_entry(uint32_t address, unsigned bytes, unsigned bit = 0xFF, unsigned extension = 0) {
        return send(bytes_t{0xE1, uint8_t(bit), uint8_t(bytes), uint8_t(extension)} + word(address));
    }
    bytes_t set_mode(unsigned mode, unsigned event, unsigned divider, unsigned list = 0) {
        return send({0xE0, uint8_t(mode), uint8_t(list), uint8_t(list >> 8), uint8_t(event), uint8_t(event >> 8),
                     uint8_t(divider), 0});
    }
    bytes_t start_stop(unsigned mode, unsigned list = 0) {
        return send({0xDE, uint8_t(mode), uint8_t(list), uint8_t(list >> 8)});
    }
    bytes_t synch(unsigned mode) { return send({0xDD, uint8_t(mode)}); }
    unsigned mode() { return send({0xDF, 0, 0, 0}).at(1); }

    void configure(const odts_t &odts, bool timestamps = false, unsigned event = 0, unsigned divider = 1) {
        ASSERT_EQ(free_daq(), DONE);
        ASSERT_EQ(alloc_daq(1), DONE);
        ASSERT_EQ(alloc_odt(unsigned(odts.size())), DONE);
        for (unsigned odt = 0; odt < odts.size(); odt++) {
            ASSERT_EQ(alloc_entries(odt, unsigned(odts[odt].size())), DONE);
        }
        for (unsigned odt = 0; odt < odts.size(); odt++) {
            if (!odts[odt].empty()) {
                ASSERT_EQ(set_pointer(odt, 0), DONE);
            }
            for (const entry_t &entry : odts[odt]) {
                ASSERT_EQ(write_entry(entry.address, entry.bytes), DONE);
            }
        }
        ASSERT_EQ(set_mode(timestamps ? 0x10 : 0, event, divider), DONE);
    }

    uint8_t *bytes() { return reinterpret_cast<uint8_t *>(drive.get()); }
};

TEST_F(XcpDaq, describes_what_there_is) {
    EXPECT_EQ(send({0xDA}), (bytes_t{0xFF, 0x93, 1, 0, XCP_EVENTS, 0, 0, 0}))
        << "dynamic, prescaler, timestamps, event";
    EXPECT_EQ(send({0xD9}), (bytes_t{0xFF, 1, 4, 1, 0, 0x32, 1, 0})) << "two bytes of 1 us";
    EXPECT_EQ(send({0xD8, 0, 0, 0}), (bytes_t{0xFF, 0x04, 8, 8, 0, 0}));
    EXPECT_EQ(send({0xD8, 0, 1, 0}), failed(XCP_ERROR_OUT_OF_RANGE));
    time_us = 0x12345678;
    EXPECT_EQ(send({0xDC}), (bytes_t{0xFF, 0, 0, 0, 0x78, 0x56, 0x34, 0x12}));
    EXPECT_EQ(send({0xDF, 0, 0, 0}), (bytes_t{0xFF, 0, 0, 0, 0, 0, 0, 0}));
    EXPECT_EQ(send({0xDF, 0, 0, 1}), failed(XCP_ERROR_OUT_OF_RANGE));
    configure({{{0, 4}}}, true, 1, 200);
    EXPECT_EQ(send({0xDF, 0, 0, 0}), (bytes_t{0xFF, 0x10, 0, 0, 1, 0, 200, 0}));
}

TEST_F(XcpDaq, is_allocated_in_order_only) {
    EXPECT_EQ(alloc_odt(1), failed(XCP_ERROR_SEQUENCE));
    EXPECT_EQ(alloc_entries(0, 1), failed(XCP_ERROR_SEQUENCE));
    EXPECT_EQ(set_pointer(0, 0), failed(XCP_ERROR_OUT_OF_RANGE));
    EXPECT_EQ(write_entry(0, 4), failed(XCP_ERROR_SEQUENCE));
    EXPECT_EQ(set_mode(0, 0, 1), failed(XCP_ERROR_OUT_OF_RANGE)) << "there is no list";
    EXPECT_EQ(start_stop(1), failed(XCP_ERROR_OUT_OF_RANGE));
    EXPECT_EQ(alloc_daq(0), DONE);
    EXPECT_EQ(alloc_odt(1), failed(XCP_ERROR_SEQUENCE)) << "no list";
    EXPECT_EQ(alloc_daq(1), DONE);
    EXPECT_EQ(alloc_daq(1), failed(XCP_ERROR_SEQUENCE));
    EXPECT_EQ(alloc_entries(0, 1), failed(XCP_ERROR_SEQUENCE));
    EXPECT_EQ(alloc_odt(2), DONE);
    EXPECT_EQ(alloc_daq(1), failed(XCP_ERROR_SEQUENCE));
    EXPECT_EQ(alloc_odt(2), failed(XCP_ERROR_SEQUENCE));
    EXPECT_EQ(alloc_entries(0, 2), DONE);
    EXPECT_EQ(alloc_entries(0, 2), failed(XCP_ERROR_SEQUENCE));
    EXPECT_EQ(alloc_odt(2), failed(XCP_ERROR_SEQUENCE));
    EXPECT_EQ(alloc_entries(1, 1), DONE);
    EXPECT_EQ(free_daq(), DONE);
    EXPECT_EQ(alloc_odt(1), failed(XCP_ERROR_SEQUENCE)) << "all of it is freed";
    EXPECT_EQ(set_pointer(0, 0), failed(XCP_ERROR_OUT_OF_RANGE));
    EXPECT_EQ(alloc_daq(1), DONE);
}

TEST_F(XcpDaq, refuses_more_than_there_is) {
    for (const unsigned lists : {2, 255, 256, 65535}) {
        EXPECT_EQ(alloc_daq(lists), failed(XCP_ERROR_MEMORY_OVERFLOW));
    }
    ASSERT_EQ(alloc_daq(1), DONE);
    for (const unsigned odts : {0, 9, 255}) {
        EXPECT_EQ(alloc_odt(odts), failed(XCP_ERROR_MEMORY_OVERFLOW));
    }
    EXPECT_EQ(alloc_odt(1, 1), failed(XCP_ERROR_OUT_OF_RANGE));
    EXPECT_EQ(alloc_odt(1, 256), failed(XCP_ERROR_OUT_OF_RANGE));
    ASSERT_EQ(alloc_odt(3), DONE);
    EXPECT_EQ(alloc_entries(3, 1), failed(XCP_ERROR_OUT_OF_RANGE));
    EXPECT_EQ(alloc_entries(255, 1), failed(XCP_ERROR_OUT_OF_RANGE));
    EXPECT_EQ(alloc_entries(0, 1, 1), failed(XCP_ERROR_OUT_OF_RANGE));
    EXPECT_EQ(alloc_entries(0, 9), failed(XCP_ERROR_MEMORY_OVERFLOW));
    ASSERT_EQ(alloc_entries(2, 5), DONE); // in any order
    EXPECT_EQ(alloc_entries(0, 4), failed(XCP_ERROR_MEMORY_OVERFLOW));
    ASSERT_EQ(alloc_entries(0, 3), DONE);
    EXPECT_EQ(alloc_entries(1, 1), failed(XCP_ERROR_MEMORY_OVERFLOW));
    for (const auto &[odt, entry] :
         {std::pair<unsigned, unsigned>{0, 3}, {1, 0}, {2, 5}, {3, 0}, {255, 255}, {0, 255}}) {
        EXPECT_EQ(set_pointer(odt, entry), failed(XCP_ERROR_OUT_OF_RANGE)) << odt << " " << entry;
    }
    EXPECT_EQ(set_pointer(0, 0, 1), failed(XCP_ERROR_OUT_OF_RANGE));
    for (const unsigned event : {unsigned(XCP_EVENTS), 256u, 65535u}) {
        EXPECT_EQ(set_mode(0, event, 1), failed(XCP_ERROR_OUT_OF_RANGE));
    }
    EXPECT_EQ(set_mode(0, 0, 0), failed(XCP_ERROR_OUT_OF_RANGE)) << "the prescaler is at least 1";
    EXPECT_EQ(set_mode(0, 0, 1, 1), failed(XCP_ERROR_OUT_OF_RANGE));
    for (const unsigned bad : {0x01, 0x02, 0x20, 0x80, 0xEF}) {
        EXPECT_EQ(set_mode(bad, 0, 1), failed(XCP_ERROR_MODE_NOT_VALID));
    }
    EXPECT_EQ(start_stop(3), failed(XCP_ERROR_MODE_NOT_VALID));
    EXPECT_EQ(start_stop(1, 1), failed(XCP_ERROR_OUT_OF_RANGE));
    EXPECT_EQ(synch(3), failed(XCP_ERROR_MODE_NOT_VALID));
}

TEST_F(XcpDaq, entries_lie_within_a_word_of_the_drive_and_an_odt) {
    ASSERT_EQ(alloc_daq(1), DONE);
    ASSERT_EQ(alloc_odt(2), DONE);
    ASSERT_EQ(alloc_entries(0, 2), DONE);
    ASSERT_EQ(alloc_entries(1, 1), DONE);
    ASSERT_EQ(set_pointer(0, 0), DONE);
    for (unsigned first = 0; first < 4; first++) {
        for (unsigned bytes = 0; bytes < 256; bytes++) {
            ASSERT_EQ(set_pointer(0, 0), DONE);
            EXPECT_EQ(write_entry(400 + first, bytes),
                      bytes >= 1 && first + bytes <= 4 ? DONE : failed(XCP_ERROR_OUT_OF_RANGE));
        }
    }
    ASSERT_EQ(set_pointer(0, 0), DONE);
    EXPECT_EQ(write_entry(sizeof(drive_t), 1), failed(XCP_ERROR_OUT_OF_RANGE));
    EXPECT_EQ(write_entry(XCP_AREA_PARAMETERS, 4), failed(XCP_ERROR_OUT_OF_RANGE));
    EXPECT_EQ(write_entry(0x40000, 4), failed(XCP_ERROR_OUT_OF_RANGE)) << "beyond 16 bits of words";
    EXPECT_EQ(write_entry(0, 4, 0), failed(XCP_ERROR_OUT_OF_RANGE)) << "a bit";
    EXPECT_EQ(write_entry(0, 4, 0xFF, 1), failed(XCP_ERROR_OUT_OF_RANGE)) << "an address extension";
    EXPECT_EQ(write_entry(sizeof(drive_t) - 1, 1), DONE);
    EXPECT_EQ(write_entry(0, 4), DONE);
    EXPECT_EQ(write_entry(0, 4), failed(XCP_ERROR_SEQUENCE)) << "not into the next ODT";
    EXPECT_EQ(xcp.daq.entry[2].bytes, 0);
}

TEST_F(XcpDaq, starts_with_entries_that_are_written_and_frames_that_fit_only) {
    ASSERT_EQ(alloc_daq(1), DONE);
    ASSERT_EQ(alloc_odt(1), DONE);
    EXPECT_EQ(start_stop(1), failed(XCP_ERROR_OUT_OF_RANGE)) << "no entry";
    ASSERT_EQ(alloc_entries(0, 2), DONE);
    ASSERT_EQ(set_mode(0, 0, 1), DONE);
    EXPECT_EQ(start_stop(1), failed(XCP_ERROR_DAQ_CONFIGURATION)) << "none is written";
    ASSERT_EQ(set_pointer(0, 0), DONE);
    ASSERT_EQ(write_entry(0, 4), DONE);
    EXPECT_EQ(start_stop(1), failed(XCP_ERROR_DAQ_CONFIGURATION)) << "the second one is not";
    ASSERT_EQ(write_entry(4, 4), DONE);
    EXPECT_EQ(start_stop(1), failed(XCP_ERROR_DAQ_CONFIGURATION)) << "9 bytes";
    ASSERT_EQ(set_pointer(0, 1), DONE);
    ASSERT_EQ(write_entry(4, 3), DONE);
    ASSERT_EQ(set_mode(0x10, 0, 1), DONE);
    EXPECT_EQ(start_stop(1), failed(XCP_ERROR_DAQ_CONFIGURATION)) << "10 bytes with the time";
    EXPECT_EQ(start_stop(2), (bytes_t{0xFF, 0}));
    EXPECT_EQ(synch(1), failed(XCP_ERROR_DAQ_CONFIGURATION));
    EXPECT_EQ(drive->sampler.event, 0u);
    ASSERT_EQ(set_mode(0, 0, 1), DONE);
    EXPECT_EQ(start_stop(1), (bytes_t{0xFF, 0}));
    EXPECT_EQ(drive->sampler.event, 1u);
    ASSERT_EQ(free_daq(), DONE);
    ASSERT_EQ(alloc_daq(1), DONE);
    ASSERT_EQ(alloc_odt(1), DONE);
    ASSERT_EQ(alloc_entries(0, 1), DONE);
    ASSERT_EQ(set_pointer(0, 0), DONE);
    ASSERT_EQ(write_entry(0, 4), DONE);
    EXPECT_EQ(start_stop(1), failed(XCP_ERROR_DAQ_CONFIGURATION)) << "no mode";
}

TEST_F(XcpDaq, starts_and_stops_by_list_or_by_selection) {
    configure({{{0, 4}}});
    EXPECT_EQ(mode(), 0x00u);
    EXPECT_EQ(synch(1), failed(XCP_ERROR_DAQ_CONFIGURATION)) << "none is selected";
    EXPECT_EQ(start_stop(2), (bytes_t{0xFF, 0}));
    EXPECT_EQ(mode(), 0x01u);
    EXPECT_EQ(synch(1), DONE);
    EXPECT_EQ(mode(), 0x40u) << "runs, and is selected no more";
    EXPECT_EQ(send({0xFD}), (bytes_t{0xFF, 0x40, 0, 0, 0, 0}));
    EXPECT_EQ(synch(2), DONE);
    EXPECT_EQ(mode(), 0x40u) << "it is not selected";
    EXPECT_EQ(start_stop(2), (bytes_t{0xFF, 0}));
    EXPECT_EQ(synch(2), DONE);
    EXPECT_EQ(mode(), 0x00u);
    EXPECT_EQ(drive->sampler.event, 0u);
    EXPECT_EQ(start_stop(1), (bytes_t{0xFF, 0}));
    EXPECT_EQ(synch(0), DONE);
    EXPECT_EQ(mode(), 0x00u);
    EXPECT_EQ(start_stop(2), (bytes_t{0xFF, 0}));
    EXPECT_EQ(start_stop(0), (bytes_t{0xFF, 0}));
    EXPECT_EQ(mode(), 0x00u);
    EXPECT_EQ(start_stop(0), (bytes_t{0xFF, 0})) << "stopped before";
}

TEST_F(XcpDaq, does_not_change_while_it_runs_and_may_be_freed) {
    configure({{{0, 4}}, {{4, 2}}});
    ASSERT_EQ(start_stop(1), (bytes_t{0xFF, 0}));
    const xcp_daq_t before = xcp.daq;
    EXPECT_EQ(alloc_daq(1), failed(XCP_ERROR_DAQ_ACTIVE));
    EXPECT_EQ(alloc_odt(1), failed(XCP_ERROR_DAQ_ACTIVE));
    EXPECT_EQ(alloc_entries(0, 1), failed(XCP_ERROR_DAQ_ACTIVE));
    EXPECT_EQ(set_pointer(0, 0), failed(XCP_ERROR_DAQ_ACTIVE));
    EXPECT_EQ(write_entry(8, 4), failed(XCP_ERROR_DAQ_ACTIVE));
    EXPECT_EQ(set_mode(0x10, 1, 2), failed(XCP_ERROR_DAQ_ACTIVE));
    EXPECT_EQ(std::memcmp(&before, &xcp.daq, sizeof before), 0);
    event(SAMPLER_EVENT_CONTROL);
    EXPECT_EQ(next_frame().size(), 5u);
    EXPECT_EQ(free_daq(), DONE);
    EXPECT_EQ(next_frame(), bytes_t{}) << "not the second frame of the record";
    EXPECT_EQ(drive->sampler.event, 0u);
    EXPECT_EQ(xcp.daq.allocated, XCP_DAQ_FREE);
}

TEST_F(XcpDaq, sends_no_rest_of_a_record_of_the_measurement_before) {
    configure({{{0, 4}}, {{4, 2}}});
    ASSERT_EQ(start_stop(1), (bytes_t{0xFF, 0}));
    event(SAMPLER_EVENT_CONTROL);
    event(SAMPLER_EVENT_CONTROL);
    ASSERT_EQ(next_frame()[0], 0);
    ASSERT_EQ(start_stop(0), (bytes_t{0xFF, 0}));
    EXPECT_EQ(next_frame(), bytes_t{});
    ASSERT_EQ(start_stop(1), (bytes_t{0xFF, 0}));
    EXPECT_EQ(next_frame(), bytes_t{});
    event(SAMPLER_EVENT_CONTROL);
    EXPECT_EQ(next_frame()[0], 0);
    EXPECT_EQ(next_frame()[0], 1);
    EXPECT_EQ(next_frame(), bytes_t{});
}

TEST_F(XcpDaq, a_list_that_has_changed_in_memory_does_not_start) {
    configure({{{0, 4}}});
    ASSERT_LT(DRIVE_WORDS, 0xFFFFu);
    xcp.daq.entry[0].word = 0xFFFF;
    EXPECT_EQ(start_stop(1), failed(XCP_ERROR_DAQ_CONFIGURATION));
    EXPECT_FALSE(xcp.daq.running);
    EXPECT_EQ(drive->sampler.event, 0u);
    xcp.daq.entry[0].word = 0;
    EXPECT_EQ(start_stop(1), (bytes_t{0xFF, 0}));
    EXPECT_TRUE(xcp.daq.running);
}

TEST_F(XcpDaq, a_frame_has_its_entries_and_eight_bytes_whatever_has_changed_in_memory) {
    configure({{{0, 4}}});
    ASSERT_EQ(start_stop(1), (bytes_t{0xFF, 0}));
    const auto byte = [&](unsigned i) { return bytes()[i]; };
    event(SAMPLER_EVENT_CONTROL);
    xcp.daq.odt[0].end = 0xFF;
    EXPECT_EQ(next_frame(), (bytes_t{0, byte(0), byte(1), byte(2), byte(3)})) << "the others are not written";
    event(SAMPLER_EVENT_CONTROL);
    xcp.daq.entry[0].bytes = 0xFF;
    EXPECT_EQ(next_frame(), (bytes_t{0, byte(0), byte(1), byte(2), byte(3), byte(0), byte(1), byte(2)}));
}

TEST_F(XcpDaq, waits_for_the_mailboxes_and_lets_uploads_pass) {
    configure({{{0, 4}}});
    ASSERT_EQ(start_stop(1), (bytes_t{0xFF, 0}));
    event(SAMPLER_EVENT_CONTROL);
    EXPECT_EQ(next_frame(true), bytes_t{});
    ASSERT_EQ(set_address(0), DONE);
    ASSERT_EQ(send({0xF5, 8}).size(), 8u);
    EXPECT_EQ(next_frame(true), (bytes_t{0xFF, drive_bytes()[7]}));
    EXPECT_EQ(next_frame(true), bytes_t{});
    EXPECT_EQ(next_frame(), (bytes_t{0} + bytes_t(drive_bytes(), drive_bytes() + 4)));
}

// Any list: entries of 1 to 4 bytes, up to eight in up to eight frames.
odts_t any_odts(std::mt19937 &random, bool timestamps) {
    odts_t odts(1 + random() % XCP_ODTS_MAX);
    for (unsigned left = unsigned(1 + random() % SAMPLER_CHANNELS_MAX), tries = 0; left > 0 && tries < 50; tries++) {
        const size_t at = random() % odts.size();
        const unsigned bytes = unsigned(1 + random() % 4);
        unsigned used = bytes + (at == 0 && timestamps ? 2 : 0);
        for (const entry_t &entry : odts[at]) {
            used += entry.bytes;
        }
        if (used <= 7) {
            odts[at].push_back({uint32_t(4 * (random() % WORDS) + random() % (5 - bytes)), bytes});
            left--;
        }
    }
    return odts;
}

TEST_F(XcpDaq, frames_are_the_bytes_of_the_records_at_every_divider_in_order) {
    unsigned frames = 0, lost = 0;
    for (unsigned seed = 0; seed < 300; seed++) {
        std::mt19937 random(seed);
        const bool timestamps = random() % 2 == 0;
        const odts_t odts = any_odts(random, timestamps);
        if (std::all_of(odts.begin(), odts.end(), [](const auto &odt) { return odt.empty(); })) {
            continue;
        }
        const auto at = sampler_event_t(1 + random() % XCP_EVENTS);
        const unsigned divider = unsigned(random() % 4 == 0 ? 255 : 1 + random() % 3);
        configure(odts, timestamps, at - 1u, divider);
        ASSERT_EQ(start_stop(1), (bytes_t{0xFF, 0}));
        std::vector<std::vector<bytes_t>> expected;      // frames of each record
        const uint32_t loss = seed % 30 == 0 ? 6000 : 0; // events before the first frame is sent
        size_t record = 0, odt = 0, told_record = 0;
        uint32_t overloads = 0, told_lost = 0;
        for (uint32_t k = 0; k < 600 + loss; k++) {
            time_us += random() % 100;
            for (unsigned i = 0; i < 4 * WORDS; i++) {
                bytes()[i] = uint8_t(random());
            }
            for (unsigned other = 1; other <= XCP_EVENTS; other++) {
                const uint32_t written = drive->sampler.written;
                event(sampler_event_t(other));
                const bool due = other == unsigned(at) && k % divider == 0;
                ASSERT_TRUE(due || drive->sampler.written == written);
                if (due && drive->sampler.written != written) {
                    std::vector<bytes_t> of_record;
                    for (unsigned number = 0; number < odts.size(); number++) {
                        bytes_t frame{uint8_t(number)};
                        if (number == 0 && timestamps) {
                            frame = frame + bytes_t{uint8_t(time_us), uint8_t(time_us >> 8)};
                        }
                        for (const entry_t &entry : odts[number]) {
                            frame = frame + bytes_t(bytes() + entry.address, bytes() + entry.address + entry.bytes);
                        }
                        of_record.push_back(frame);
                    }
                    expected.push_back(of_record);
                }
            }
            for (unsigned sent = k < loss ? 0 : unsigned(random() % 5); sent > 0; sent--) {
                const bool tells = odt == 0 && drive->sampler.lost != told_lost &&
                                   (overloads == 0 || record - told_record >= XCP_OVERLOAD_RECORDS);
                const bytes_t frame = next_frame();
                if (tells) {
                    ASSERT_EQ(frame, (bytes_t{0xFD, 0x06})) << "seed " << seed;
                    overloads++;
                    told_lost = drive->sampler.lost;
                    told_record = record;
                    continue;
                }
                ASSERT_EQ(frame, record < expected.size() ? expected[record][odt] : bytes_t{}) << "seed " << seed;
                odt += !frame.empty();
                record += odt == odts.size();
                odt %= odts.size();
                frames += !frame.empty();
            }
        }
        ASSERT_EQ(drive->sampler.written, expected.size());
        ASSERT_EQ(expected.size() + drive->sampler.lost, (600 + loss + divider - 1) / divider);
        ASSERT_EQ(xcp.daq.overloads, overloads);
        ASSERT_EQ(overloads > 0, drive->sampler.lost > 0);
        lost += drive->sampler.lost > 0;
    }
    EXPECT_GT(frames, 20000u);
    EXPECT_GT(lost, 2u);
}

} // namespace
