// End-to-end protection: published check value, every pair of counters, corrupted frames, resynchronisation. [SR-32]
#include <array>
#include <cstring>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "comms/e2e.h"
}

#include "support/e2e_protect.h"

namespace {

constexpr uint16_t DATA_ID = 0x5A1E;
constexpr size_t LENGTH = 7;
using frame_t = std::array<uint8_t, LENGTH>;

frame_t protected_frame(uint8_t counter, uint32_t data = 0x01020304) {
    frame_t frame{};
    std::memcpy(&frame[E2E_HEADER_BYTES], &data, sizeof data);
    e2e_protect(DATA_ID, counter, frame.data(), frame.size());
    return frame;
}

struct receiver_t : e2e_receiver_t {
    receiver_t() { e2e_receiver_init(this); }
    e2e_result_t take(uint8_t counter) {
        const frame_t frame = protected_frame(counter);
        return e2e_check(this, DATA_ID, frame.data(), frame.size());
    }
};

TEST(E2e, crc_gives_the_published_check_value) {
    const char *text = "123456789";
    const auto *bytes = reinterpret_cast<const uint8_t *>(text);
    EXPECT_EQ(e2e_crc16(0xFFFF, bytes, 9), 0x29B1);
    EXPECT_EQ(e2e_crc16(e2e_crc16(0xFFFF, bytes, 4), bytes + 4, 5), 0x29B1);
    EXPECT_EQ(e2e_crc16(0xFFFF, bytes, 0), 0xFFFF);
}

TEST(E2e, layout_is_that_of_profile_5) {
    const frame_t frame = protected_frame(0x42, 0x0403A201);
    // the bytes that the checksum covers: counter, data, data ID low byte first
    const uint8_t covered[] = {0x42, 0x01, 0xA2, 0x03, 0x04, 0x1E, 0x5A};
    const uint16_t crc = e2e_crc16(0xFFFF, covered, sizeof covered);
    EXPECT_EQ(frame, (frame_t{uint8_t(crc & 0xFF), uint8_t(crc >> 8), 0x42, 0x01, 0xA2, 0x03, 0x04}));
}

TEST(E2e, first_frame_is_accepted_with_any_counter) {
    for (int counter = 0; counter < 256; counter++) {
        receiver_t receiver;
        EXPECT_EQ(receiver.take(uint8_t(counter)), E2E_ACCEPTED);
    }
}

TEST(E2e, every_pair_of_counters) {
    for (int before = 0; before < 256; before++) {
        for (int counter = 0; counter < 256; counter++) {
            receiver_t receiver;
            ASSERT_EQ(receiver.take(uint8_t(before)), E2E_ACCEPTED);
            const int step = (counter - before + 256) % 256;
            const e2e_result_t expected = step == 0 ? E2E_REPEATED : step <= 3 ? E2E_ACCEPTED : E2E_WRONG_SEQUENCE;
            ASSERT_EQ(receiver.take(uint8_t(counter)), expected) << before << " then " << counter;
            ASSERT_EQ(receiver.counter, expected == E2E_ACCEPTED ? counter : before);
        }
    }
}

TEST(E2e, a_jump_is_believed_at_the_third_frame_in_sequence) {
    receiver_t receiver;
    receiver.take(10);
    EXPECT_EQ(receiver.take(100), E2E_WRONG_SEQUENCE);
    EXPECT_EQ(receiver.take(101), E2E_WRONG_SEQUENCE);
    EXPECT_EQ(receiver.take(102), E2E_RESYNCHRONISED);
    EXPECT_EQ(receiver.take(103), E2E_ACCEPTED);
}

TEST(E2e, a_jump_within_the_jump_counts_from_one_again) {
    receiver_t receiver;
    receiver.take(10);
    EXPECT_EQ(receiver.take(100), E2E_WRONG_SEQUENCE);
    EXPECT_EQ(receiver.take(101), E2E_WRONG_SEQUENCE);
    EXPECT_EQ(receiver.take(200), E2E_WRONG_SEQUENCE);
    EXPECT_EQ(receiver.take(201), E2E_WRONG_SEQUENCE);
    EXPECT_EQ(receiver.take(201), E2E_WRONG_SEQUENCE); // a repetition is no progress
    EXPECT_EQ(receiver.take(202), E2E_WRONG_SEQUENCE);
    EXPECT_EQ(receiver.take(203), E2E_RESYNCHRONISED);
}

// [SR-36]
TEST(E2e, a_replayed_sequence_is_refused_while_the_true_sender_lives) {
    receiver_t receiver;
    receiver.take(0);
    for (int i = 1; i < 1000; i++) {
        ASSERT_EQ(receiver.take(uint8_t(i)), E2E_ACCEPTED);
        ASSERT_EQ(receiver.take(uint8_t(i + 128)), E2E_WRONG_SEQUENCE);
    }
}

// [SR-36]
TEST(E2e, a_locked_receiver_stays_with_its_sender) {
    receiver_t receiver;
    receiver.take(10);
    receiver.locked = true;
    for (int i = 0; i < 1000; i++) {
        ASSERT_EQ(receiver.take(uint8_t(100 + i % 100)), E2E_WRONG_SEQUENCE) << i;
    }
    EXPECT_EQ(receiver.take(13), E2E_ACCEPTED) << "two frames lost";
    EXPECT_EQ(receiver.take(17), E2E_WRONG_SEQUENCE) << "three";
    e2e_receiver_restart(&receiver);
    EXPECT_EQ(receiver.take(200), E2E_ACCEPTED);
}

// [SR-36]
TEST(E2e, messages_with_one_receiver_have_one_sequence) {
    receiver_t receiver;
    receiver.take(10);
    frame_t other{};
    e2e_protect(DATA_ID + 1, 11, other.data(), other.size());
    EXPECT_EQ(e2e_check(&receiver, DATA_ID, other.data(), other.size()), E2E_WRONG_CHECKSUM);
    EXPECT_EQ(e2e_check(&receiver, DATA_ID + 1, other.data(), other.size()), E2E_ACCEPTED);
    EXPECT_EQ(e2e_check(&receiver, DATA_ID + 1, other.data(), other.size()), E2E_REPEATED);
    EXPECT_EQ(receiver.take(11), E2E_WRONG_SEQUENCE) << "another message with the same counter";
    EXPECT_EQ(receiver.take(12), E2E_ACCEPTED);
}

TEST(E2e, only_an_exact_repetition_of_the_last_accepted_frame_is_a_repeated_one) {
    for (const bool locked : {false, true}) {
        for (unsigned bit = 0; bit < 8; bit++) {
            receiver_t receiver;
            receiver.take(10);
            receiver.locked = locked;
            EXPECT_EQ(receiver.take(10), E2E_REPEATED);
            frame_t other = protected_frame(10);
            other[E2E_HEADER_BYTES] = uint8_t(other[E2E_HEADER_BYTES] ^ (1u << bit));
            e2e_protect(DATA_ID, 10, other.data(), other.size());
            EXPECT_EQ(e2e_check(&receiver, DATA_ID, other.data(), other.size()), E2E_WRONG_SEQUENCE);
            EXPECT_EQ(receiver.take(10), E2E_REPEATED) << "the other one has not become the last";
            receiver.take(11);
            EXPECT_EQ(receiver.take(10), E2E_WRONG_SEQUENCE) << "no longer the last";
        }
    }
}

// [SR-36]
TEST(E2e, the_last_frame_once_more_is_no_sender_that_starts_again) {
    receiver_t receiver;
    receiver.take(10);
    e2e_receiver_restart(&receiver);
    for (int i = 0; i < 100; i++) {
        ASSERT_EQ(receiver.take(10), E2E_REPEATED) << i;
    }
    EXPECT_EQ(receiver.take(200), E2E_ACCEPTED);
}

TEST(E2e, a_wrong_checksum_leaves_the_receiver_alone) {
    receiver_t receiver;
    receiver.take(10);
    receiver.take(100);
    const e2e_receiver_t before = receiver;
    frame_t frame = protected_frame(11);
    frame[5] ^= 0x10;
    EXPECT_EQ(e2e_check(&receiver, DATA_ID, frame.data(), frame.size()), E2E_WRONG_CHECKSUM);
    EXPECT_EQ(receiver.synchronised, before.synchronised);
    EXPECT_EQ(receiver.counter, before.counter);
    EXPECT_EQ(receiver.candidate_frames, before.candidate_frames);
    EXPECT_EQ(receiver.candidate_counter, before.candidate_counter);
}

TEST(E2e, another_data_id_fails) {
    frame_t frame{};
    e2e_protect(DATA_ID ^ 0x0100, 1, frame.data(), frame.size());
    receiver_t receiver;
    EXPECT_EQ(e2e_check(&receiver, DATA_ID, frame.data(), frame.size()), E2E_WRONG_CHECKSUM);
}

TEST(E2e, a_frame_shorter_than_the_header_fails) {
    const frame_t frame = protected_frame(1);
    receiver_t receiver;
    for (size_t length = 0; length < E2E_HEADER_BYTES; length++) {
        EXPECT_EQ(e2e_check(&receiver, DATA_ID, frame.data(), length), E2E_WRONG_CHECKSUM);
    }
}

TEST(E2e, every_one_and_two_bit_error_is_found) {
    std::mt19937 random(1);
    constexpr size_t BITS = 8 * LENGTH;
    const auto damaged_is_found = [](frame_t frame, uint64_t error) {
        for (size_t bit = 0; bit < BITS; bit++) {
            frame[bit / 8] = uint8_t(frame[bit / 8] ^ ((error >> bit & 1) << bit % 8));
        }
        receiver_t receiver;
        return e2e_check(&receiver, DATA_ID, frame.data(), frame.size()) == E2E_WRONG_CHECKSUM;
    };
    for (int sample = 0; sample < 50; sample++) {
        const frame_t frame = protected_frame(uint8_t(random()), uint32_t(random()));
        for (size_t a = 0; a < BITS; a++) {
            ASSERT_TRUE(damaged_is_found(frame, uint64_t(1) << a));
            for (size_t b = a + 1; b < BITS; b++) {
                ASSERT_TRUE(damaged_is_found(frame, uint64_t(1) << a | uint64_t(1) << b)) << a << ", " << b;
            }
        }
    }
}

// [SR-36]
TEST(E2e, restart_hears_a_sender_that_starts_again) {
    receiver_t receiver;
    receiver.take(10);
    receiver.take(100);
    e2e_receiver_restart(&receiver);
    EXPECT_EQ(receiver.take(200), E2E_ACCEPTED);
    EXPECT_EQ(receiver.take(101), E2E_WRONG_SEQUENCE);
}

// [SR-36]
TEST(E2e, restart_ends_the_lock_so_that_a_later_jump_is_believed_again) {
    receiver_t receiver;
    receiver.take(10);
    receiver.locked = true;
    e2e_receiver_restart(&receiver);
    receiver.take(20);
    receiver.take(100);
    receiver.take(101);
    EXPECT_EQ(receiver.take(102), E2E_RESYNCHRONISED);
}

TEST(E2e, a_frame_of_the_header_alone_has_a_checksum_like_any_other) {
    uint8_t header[E2E_HEADER_BYTES] = {};
    e2e_protect(DATA_ID, 7, header, sizeof header);
    EXPECT_TRUE(e2e_checksum_matches(DATA_ID, header, sizeof header));
    header[E2E_HEADER_BYTES - 1] ^= 1;
    EXPECT_FALSE(e2e_checksum_matches(DATA_ID, header, sizeof header));
}

} // namespace
