// SDO server: expedited, segmented and block transfers, byte by byte; every object of the table within and beyond its
// limits.
#include "support/canopen_bench.h"

#include <algorithm>
#include <random>

extern "C" {
#include "comms/canopen_sdo_block.h"
}

namespace {

using namespace canopen_bench;

constexpr unsigned SET_BYTES = 4 * PARAMETER_COUNT;

class CanopenSdo : public CanopenBench {
  protected:
    bytes_t parameter_bytes() const {
        const auto *bytes = reinterpret_cast<const uint8_t *>(parameters.values);
        return bytes_t(bytes, bytes + SET_BYTES);
    }

    // Downloads by segments; the last response.
    bytes_t download(unsigned index, unsigned sub, const bytes_t &data, bool sized = true) {
        bytes_t response = sdo(head(sized ? 0x21 : 0x20, index, sub, uint32_t(data.size())));
        bool toggle = false;
        for (size_t at = 0; at < data.size() && response[0] != 0x80; at += 7, toggle = !toggle) {
            const size_t count = std::min<size_t>(7, data.size() - at);
            bytes_t segment(8, 0);
            segment[0] = uint8_t((toggle ? 0x10 : 0) | (7 - count) << 1 | (at + 7 >= data.size() ? 1 : 0));
            std::copy(data.begin() + long(at), data.begin() + long(at + count), segment.begin() + 1);
            response = sdo(segment);
        }
        return response;
    }

    bytes_t upload(unsigned index, unsigned sub) {
        const bytes_t response = sdo(head(0x40, index, sub));
        EXPECT_EQ(response[0], 0x41);
        bytes_t data;
        for (bool toggle = false;; toggle = !toggle) {
            const bytes_t segment = sdo({uint8_t(toggle ? 0x70 : 0x60), 0, 0, 0, 0, 0, 0, 0});
            EXPECT_EQ(segment[0] & 0x10, toggle ? 0x10 : 0);
            const unsigned count = 7u - (segment[0] >> 1 & 7u);
            data.insert(data.end(), segment.begin() + 1, segment.begin() + 1 + count);
            if ((segment[0] & 1) != 0 || data.size() > 1000) {
                break;
            }
        }
        EXPECT_EQ(data.size(), word(response));
        return data;
    }

    bytes_t block_segment(const bytes_t &data, size_t segment, unsigned sequence) const {
        bytes_t frame(8, 0);
        frame[0] = uint8_t(sequence | ((segment + 1) * 7 >= data.size() ? 0x80 : 0));
        for (size_t i = 0; i < 7 && segment * 7 + i < data.size(); i++) {
            frame[1 + i] = data[segment * 7 + i];
        }
        return frame;
    }

    bytes_t end_of(const bytes_t &data, uint16_t crc) const {
        const unsigned unused = unsigned((7 - data.size() % 7) % 7);
        return {uint8_t(0xC1 | unused << 2), uint8_t(crc), uint8_t(crc >> 8), 0, 0, 0, 0, 0};
    }
};

TEST_F(CanopenSdo, reads_and_writes_numbers_in_one_frame) {
    EXPECT_EQ(sdo(head(0x40, 0x1000, 0)), head(0x43, 0x1000, 0, 0x00020192));
    EXPECT_EQ(sdo(head(0x40, 0x6060, 0)), head(0x4F, 0x6060, 0, 3));
    EXPECT_EQ(sdo(head(0x40, 0x60C2, 2)), head(0x4F, 0x60C2, 2, 0xFD)) << "-3 in a byte";
    EXPECT_EQ(sdo(head(0x2F, 0x60C2, 2, 0xFD)), head(0x60, 0x60C2, 2)) << "a constant may be written as what it is";
    EXPECT_EQ(sdo(head(0x2F, 0x60C2, 2, 0xFE)), aborted(0x60C2, 2, 0x06090031));
    EXPECT_EQ(sdo(head(0x2F, 0x60C2, 2, 0xFC)), aborted(0x60C2, 2, 0x06090032));
    EXPECT_EQ(sdo(head(0x2B, 0x1017, 0, 500)), head(0x60, 0x1017, 0));
    EXPECT_EQ(sdo(head(0x40, 0x1017, 0)), head(0x4B, 0x1017, 0, 500));
    EXPECT_EQ(sdo(head(0x22, 0x1017, 0, 700)), head(0x60, 0x1017, 0)) << "expedited without a size";
    EXPECT_EQ(read(0x1017, 0), 700u);
}

TEST_F(CanopenSdo, aborts_with_the_codes_of_the_standard) {
    EXPECT_EQ(sdo(head(0x40, 0x1002, 0)), aborted(0x1002, 0, 0x06020000));
    EXPECT_EQ(sdo(head(0x40, 0x1404, 0)), aborted(0x1404, 0, 0x06020000)) << "a fifth RPDO";
    EXPECT_EQ(sdo(head(0x40, 0x1018, 5)), aborted(0x1018, 5, 0x06090011));
    EXPECT_EQ(sdo(head(0x40, 0x1400, 3)), aborted(0x1400, 3, 0x06090011)) << "between two";
    EXPECT_EQ(sdo(head(0x40, 0x2000, 1)), aborted(0x2000, 1, 0x06090011));
    EXPECT_EQ(sdo(head(0x40, 0x2000 + PARAMETER_COUNT, 0)), aborted(0x2000 + PARAMETER_COUNT, 0, 0x06020000));
    EXPECT_EQ(sdo(head(0x2B, 0x6041, 0, 1)), aborted(0x6041, 0, 0x06010002));
    EXPECT_EQ(sdo(head(0x23, 0x1017, 0, 1)), aborted(0x1017, 0, 0x06070012)) << "four bytes for two";
    EXPECT_EQ(sdo(head(0x2F, 0x1017, 0, 1)), aborted(0x1017, 0, 0x06070013));
    EXPECT_EQ(sdo(head(0x23, 0x1010, 1, 1)), aborted(0x1010, 1, 0x08000020)) << "not the signature";
    EXPECT_EQ(sdo({0xE0, 0, 0, 0, 0, 0, 0, 0})[0], 0x80);
    EXPECT_EQ(word(sdo({0x60, 0, 0, 0, 0, 0, 0, 0})), 0x05040001u) << "a segment without a transfer";
    EXPECT_EQ(sdo({0x40, 0x00, 0x10}), bytes_t{}) << "a short frame is no SDO";
}

TEST_F(CanopenSdo, every_object_is_read_and_written_within_and_refused_beyond_its_limits) {
    unsigned written = 0, limited = 0;
    for (unsigned index = 0x1000; index < 0x7000; index++) {
        for (unsigned sub = 0; sub < 256; sub++) {
            canopen_object_t object;
            if (canopen_find(index, sub, &object) != CANOPEN_DONE || canopen_bytes(&object) == 0) {
                continue;
            }
            const unsigned bytes = canopen_bytes(&object);
            const auto before = canopen_unpack(&object, sdo(head(0x40, index, sub)).data() + 4);
            if ((object.row.access & CANOPEN_WRITE) == 0) {
                EXPECT_EQ(write(index, sub, before), 0x06010002u);
                continue;
            }
            written++;
            const bool procedure = index >= 0x1400 && index < 0x1B00; // of a valid PDO
            const uint32_t refused = write(index, sub, before);
            const bool signature = index == 0x1010 || index == 0x1011;
            EXPECT_EQ(refused, signature                   ? 0x08000020u
                               : procedure && refused != 0 ? 0x08000022u
                                                           : 0u)
                << std::hex << index << ":" << sub;
            const bool is_signed = canopen_is_signed(&object);
            const int64_t top = is_signed ? (INT64_C(1) << (8 * bytes - 1)) - 1 : (INT64_C(1) << 8 * bytes) - 1;
            const int64_t bottom = is_signed ? -top - 1 : 0;
            const int64_t maximum = is_signed ? int64_t(object.row.maximum) : uint32_t(object.row.maximum);
            const int64_t minimum = is_signed ? int64_t(object.row.minimum) : uint32_t(object.row.minimum);
            if (maximum < top) {
                EXPECT_EQ(write(index, sub, int32_t(maximum + 1)), 0x06090031u) << std::hex << index << ":" << sub;
                limited++;
            }
            if (minimum > bottom) {
                EXPECT_EQ(write(index, sub, int32_t(minimum - 1)), 0x06090032u) << std::hex << index << ":" << sub;
                limited++;
            }
            EXPECT_EQ(canopen_unpack(&object, sdo(head(0x40, index, sub)).data() + 4), before);
        }
    }
    EXPECT_GT(written, 100u);
    EXPECT_GT(limited, 100u);
}

TEST_F(CanopenSdo, a_text_comes_in_segments) {
    const bytes_t text = upload(0x1008, 0);
    EXPECT_EQ(std::string(text.begin(), text.end()), "Salient");
    EXPECT_EQ(sdo(head(0x40, 0x1009, 0)), head(0x41, 0x1009, 0, 3));
    EXPECT_EQ(sdo({0x60, 0, 0, 0, 0, 0, 0, 0}), (bytes_t{0x09, 'H', 'A', 'L', 0, 0, 0, 0}));
}

TEST_F(CanopenSdo, a_wrong_toggle_ends_a_transfer) {
    sdo(head(0x40, 0x2F00, 0));
    sdo({0x60, 0, 0, 0, 0, 0, 0, 0});
    EXPECT_EQ(word(sdo({0x60, 0, 0, 0, 0, 0, 0, 0})), 0x05030000u);
    EXPECT_EQ(word(sdo({0x70, 0, 0, 0, 0, 0, 0, 0})), 0x05040001u);
}

TEST_F(CanopenSdo, an_abort_of_the_client_ends_a_transfer_in_either_direction) {
    for (const bool uploads : {true, false}) {
        ASSERT_EQ(sdo(uploads ? head(0x40, 0x1008, 0) : head(0x21, 0x6083, 0, 4))[0], uploads ? 0x41 : 0x60);
        EXPECT_EQ(sdo(head(0x80, 0, 0, 0x08000000u)), bytes_t{});
        EXPECT_EQ(code_of(sdo({uint8_t(uploads ? 0x60 : 0x07), 1, 0, 0, 0, 0, 0, 0})), 0x05040001u) << uploads;
    }
}

TEST_F(CanopenSdo, a_number_is_written_by_segments_and_only_when_it_is_whole) {
    EXPECT_EQ(download(0x60FF, 0, {0x58, 0x02, 0, 0}), (bytes_t{0x20, 0, 0, 0, 0, 0, 0, 0}));
    EXPECT_EQ(read(0x60FF, 0), 600u);
    EXPECT_EQ(code_of(download(0x60FF, 0, {1, 2, 3})), 0x06070013u);
    EXPECT_EQ(code_of(download(0x60FF, 0, {1, 2, 3}, false)), 0x06070013u);
    EXPECT_EQ(code_of(download(0x60FF, 0, {1, 2, 3, 4, 5}, false)), 0x06070012u);
    EXPECT_EQ(read(0x60FF, 0), 600u);
}

TEST_F(CanopenSdo, the_parameter_set_is_read_and_applied_as_a_whole) {
    EXPECT_EQ(upload(0x2F00, 0), parameter_bytes());
    bytes_t data = parameter_bytes();
    const int32_t speed = 1234;
    std::memcpy(data.data() + 4 * PARAMETER_OVER_SPEED_RPM, &speed, 4);
    const uint32_t revision = parameters.revision;
    EXPECT_EQ(download(0x2F00, 0, data)[0] & 0xE0, 0x20);
    EXPECT_EQ(parameters.values[PARAMETER_OVER_SPEED_RPM], speed);
    EXPECT_EQ(parameters.revision, revision + 1);
    EXPECT_TRUE(parameters_intact(&parameters));

    const parameters_t before = parameters;
    const int32_t bad = 1;
    std::memcpy(data.data() + 4 * PARAMETER_OVER_SPEED_RPM, &bad, 4);
    EXPECT_EQ(code_of(download(0x2F00, 0, data)), 0x06090030u);
    conditions.running = true;
    EXPECT_EQ(code_of(download(0x2F00, 0, parameter_bytes())), 0x08000022u) << "not in a run";
    EXPECT_EQ(std::memcmp(&before, &parameters, sizeof before), 0);
}

TEST_F(CanopenSdo, a_parameter_is_that_of_the_other_protocol_with_its_checks) {
    EXPECT_EQ(write(0x2000 + PARAMETER_OVER_SPEED_RPM, 0, 2500), 0u);
    EXPECT_EQ(parameters.values[PARAMETER_OVER_SPEED_RPM], 2500);
    EXPECT_EQ(write(0x2000 + PARAMETER_CURRENT_TRIP_A, 0, parameters.values[PARAMETER_CURRENT_TRIP_A]), 0u);
    EXPECT_EQ(write(0x2000 + PARAMETER_UNDER_VOLTAGE_V, 0, parameters.values[PARAMETER_OVER_VOLTAGE_V]), 0x06040043u);
    conditions.running = true;
    EXPECT_EQ(write(0x2000 + PARAMETER_OVER_SPEED_RPM, 0, 2600), 0x08000022u);
    EXPECT_EQ(write(0x2000 + PARAMETER_SPEED_KP, 0, parameters.values[PARAMETER_SPEED_KP]), 0u) << "tunable";
    conditions.running = false;
    parameters.values[PARAMETER_SMC_K] ^= 1;
    EXPECT_EQ(write(0x2000 + PARAMETER_OVER_SPEED_RPM, 0, 2600), 0x06060000u) << "changed in memory";
}

TEST_F(CanopenSdo, crc_is_that_of_the_standard) {
    const bytes_t digits{'1', '2', '3', '4', '5', '6', '7', '8', '9'};
    EXPECT_EQ(canopen_sdo_crc(0, digits.data(), 9), 0x31C3);
}

TEST_F(CanopenSdo, block_upload_repeats_what_was_lost) {
    const bytes_t expected = parameter_bytes();
    EXPECT_EQ(sdo({0xA4, 0x00, 0x2F, 0, 10, 0, 0, 0}), head(0xC6, 0x2F00, 0, SET_BYTES));
    receive(0x600 + NODE, {0xA3, 0, 0, 0, 0, 0, 0, 0});
    bytes_t data;
    bytes_t end;
    std::mt19937 random(1);
    for (unsigned block = 0; block < 100 && end.empty(); block++) {
        cycle();
        const auto segments = sent();
        ASSERT_LE(segments.size(), 10u);
        unsigned got = 0;
        for (const auto &segment : segments) {
            EXPECT_EQ(segment.data[0] & 0x7Fu, got + 1);
            if (random() % 4 == 0 && block < 20) { // lost, and those behind it with it
                break;
            }
            data.insert(data.end(), segment.data.begin() + 1, segment.data.end());
            got++;
        }
        end = sdo({0xA2, uint8_t(got), 10, 0, 0, 0, 0, 0});
    }
    ASSERT_EQ(end.size(), 8u);
    const unsigned unused = end[0] >> 2 & 7u;
    data.resize(data.size() - unused);
    EXPECT_EQ(data, expected);
    EXPECT_EQ(end[1] | end[2] << 8, canopen_sdo_crc(0, expected.data(), unsigned(expected.size())));
    EXPECT_EQ(sdo({0xA1, 0, 0, 0, 0, 0, 0, 0}), bytes_t{});
    EXPECT_EQ(canopen.sdo.state, CANOPEN_SDO_IDLE);
    EXPECT_EQ(word(sdo({0xA4, 0x00, 0x2F, 0, 0, 0, 0, 0})), 0x05040002u) << "blocks of no segment";
    EXPECT_EQ(word(sdo({0xA4, 0x00, 0x2F, 0, 128, 0, 0, 0})), 0x05040002u);
}

TEST_F(CanopenSdo, a_stopped_node_sends_no_segments) {
    sdo(head(0xA4, 0x2F00, 0, 127));
    receive(0x600 + NODE, {0xA3, 0, 0, 0, 0, 0, 0, 0});
    receive(0, {2, NODE});
    cycle(10);
    for (const sent_t &frame : sent()) {
        EXPECT_NE(frame.identifier, 0x580u + NODE);
    }
}

TEST_F(CanopenSdo, block_download_with_a_gap_is_continued_behind_it) {
    bytes_t data = parameter_bytes();
    const int32_t speed = 1500;
    std::memcpy(data.data() + 4 * PARAMETER_OVER_SPEED_RPM, &speed, 4);
    EXPECT_EQ(sdo(head(0xC6, 0x2F00, 0, SET_BYTES)), head(0xA4, 0x2F00, 0, 32));
    const size_t segments = (data.size() + 6) / 7;
    bytes_t response;
    for (unsigned i = 1; i <= 32; i++) {
        response = i == 9 ? response : sdo(block_segment(data, i - 1, i)); // the ninth is lost
    }
    ASSERT_EQ(response, (bytes_t{0xA2, 8, 32, 0, 0, 0, 0, 0}));
    for (size_t first = 8; first < segments; first += 32) { // blocks of 32, the last one shorter
        const unsigned count = unsigned(std::min<size_t>(32, segments - first));
        for (unsigned i = 1; i <= count; i++) {
            response = sdo(block_segment(data, first + i - 1, i));
        }
        ASSERT_EQ(response, (bytes_t{0xA2, uint8_t(count), 32, 0, 0, 0, 0, 0}));
    }
    const uint16_t crc = canopen_sdo_crc(0, data.data(), unsigned(data.size()));
    EXPECT_EQ(sdo(end_of(data, crc)), (bytes_t{0xA1, 0, 0, 0, 0, 0, 0, 0}));
    EXPECT_EQ(parameters.values[PARAMETER_OVER_SPEED_RPM], speed);
}

TEST_F(CanopenSdo, block_download_with_a_wrong_checksum_changes_nothing) {
    const bytes_t data{0x58, 0x02, 0, 0};
    EXPECT_EQ(sdo(head(0xC6, 0x60FF, 0, 4))[0], 0xA4);
    EXPECT_EQ(sdo(block_segment(data, 0, 1)), (bytes_t{0xA2, 1, 32, 0, 0, 0, 0, 0}));
    EXPECT_EQ(word(sdo(end_of(data, 0x1234))), 0x05040004u);
    EXPECT_EQ(read(0x60FF, 0), 0u);
}

TEST_F(CanopenSdo, a_client_that_is_gone_blocks_no_other) {
    EXPECT_EQ(sdo(head(0xC6, 0x60FF, 0, 4))[0], 0xA4);
    EXPECT_NE(sdo(head(0x40, 0x1000, 0)), head(0x43, 0x1000, 0, 0x00020192)) << "taken for a segment";
    time_us += 1000001;
    EXPECT_EQ(sdo(head(0x40, 0x1000, 0)), head(0x43, 0x1000, 0, 0x00020192));
}

TEST_F(CanopenSdo, a_client_that_is_gone_blocks_none_that_tries_again_and_again) {
    EXPECT_EQ(sdo(head(0xC6, 0x60FF, 0, 4))[0], 0xA4);
    bytes_t response;
    for (unsigned trial = 0; trial < 5; trial++) {
        response = sdo(head(0x40, 0x1000, 0));
        time_us += 300000;
    }
    EXPECT_EQ(response, head(0x43, 0x1000, 0, 0x00020192));
}

TEST_F(CanopenSdo, a_transfer_lasts_as_long_as_its_pauses_are_no_longer_than_a_second) {
    for (const unsigned kind : {0x40u, 0x21u, 0xC6u}) { // upload, download, download of blocks
        for (const uint32_t pause_us : {1000000u, 1000001u}) {
            sdo({0x80, 0, 0, 0, 0, 0, 0, 0});
            EXPECT_NE(sdo(head(kind, 0x2F00, 0, SET_BYTES))[0], 0x80);
            const canopen_sdo_state_t begun = canopen.sdo.state;
            for (unsigned segment = 0; segment < 5; segment++) {
                time_us += pause_us;
                const unsigned toggle = segment % 2 << 4;
                sdo(kind == 0xC6 ? block_segment(parameter_bytes(), segment, segment + 1)
                                 : bytes_t{uint8_t((kind == 0x40 ? 0x60 : 0) | toggle), 0, 0, 0, 0, 0, 0, 0});
                EXPECT_EQ(canopen.sdo.state, pause_us > 1000000 ? CANOPEN_SDO_IDLE : begun) << kind << " " << segment;
            }
        }
    }
}

TEST_F(CanopenSdo, parameters_are_stored_and_defaults_restored_with_the_node_kept) {
    EXPECT_EQ(write(0x2000 + PARAMETER_OVER_SPEED_RPM, 0, 2222), 0u);
    EXPECT_EQ(write(0x1010, 1, 0x65766173), 0u);
    EXPECT_EQ(store.saving, NVM_STORE_SAVING);
    EXPECT_EQ(write(0x1011, 1, 0x64616F6C), 0u);
    EXPECT_EQ(parameters.values[PARAMETER_OVER_SPEED_RPM], 2222) << "not before the reset";
    receive(0, {129, NODE});
    cycle();
    EXPECT_EQ(parameters.values[PARAMETER_OVER_SPEED_RPM], machine_tables.parameter_default[PARAMETER_OVER_SPEED_RPM]);
    EXPECT_EQ(parameters.values[PARAMETER_PROTOCOL], int32_t(NODE));
    EXPECT_EQ(canopen.node, NODE);
    conditions.running = true;
    cycle();
    sent();
    EXPECT_EQ(write(0x1010, 1, 0x65766173), 0x08000022u) << "not in a run";
}

} // namespace
