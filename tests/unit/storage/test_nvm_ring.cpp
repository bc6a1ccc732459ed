// Records in two pages: what a start finds, and what one that is given up leaves. [SR-59]
#include <array>
#include <cstring>

#include <gtest/gtest.h>

extern "C" {
#include "storage/nvm_ring.h"
#include "support/power_cuts.h"
}

namespace {

constexpr unsigned PAGE = 2, PAYLOAD = 4, RECORD_WORDS = PAYLOAD + NVM_RING_OVERHEAD;

using payload_t = std::array<uint64_t, PAYLOAD>;

payload_t payload_of(uint64_t number) {
    payload_t payload;
    for (unsigned i = 0; i < PAYLOAD; i++) {
        payload[i] = number << 56 | (number * 1000003u + i);
    }
    return payload;
}

class NvmRing : public testing::Test {
  protected:
    NvmRing() {
        nvm_init(&hal.nvm);
        start();
    }

    void start() { nvm_ring_init(&ring, &hal, PAGE, RECORD_WORDS); }

    nvm_ring_result_t step(const payload_t &payload) {
        const unsigned index = nvm_ring_payload_index(&ring);
        return nvm_ring_step(&ring, &hal, index < PAYLOAD ? payload[index] : 0);
    }

    // Steps until the record is written.
    unsigned write(uint64_t number) {
        unsigned steps = 1;
        nvm_ring_result_t result;
        while ((result = step(payload_of(number))) == NVM_RING_BUSY && steps < 100) {
            steps++;
        }
        EXPECT_EQ(result, NVM_RING_WRITTEN);
        return steps;
    }

    // A record is there, and is the number's.
    bool has(uint32_t sequence, uint64_t number) {
        payload_t payload{};
        return nvm_ring_read(&ring, &hal, sequence, payload.data()) && payload == payload_of(number);
    }

    uint64_t &word(unsigned slot, unsigned index) { return hal.nvm.word[PAGE][slot * RECORD_WORDS + index]; }

    hal_t hal{};
    nvm_ring_t ring{};
};

// A program reads what an earlier one has written: the header has its places for good.
TEST_F(NvmRing, a_header_is_magic_layout_version_length_and_sequence_number) {
    for (uint32_t sequence = 1; sequence <= 3; sequence++) {
        write(sequence);
        const uint64_t header = word(sequence - 1, 0);
        EXPECT_EQ(header >> 48, 0x5344u);
        EXPECT_EQ(header >> 40 & 0xffu, 1u);
        EXPECT_EQ(header >> 32 & 0xffu, RECORD_WORDS);
        EXPECT_EQ(header & UINT32_MAX, sequence);
    }
}

// [SR-58]
TEST_F(NvmRing, an_erased_memory_has_no_record_and_no_damage) {
    EXPECT_EQ(ring.sequence, 0u);
    EXPECT_FALSE(ring.damaged);
    EXPECT_FALSE(ring.torn_commit);
    EXPECT_FALSE(has(0, 0));
    EXPECT_FALSE(has(1, 1));
}

TEST_F(NvmRing, a_record_takes_one_step_for_each_word_and_is_found_again) {
    for (uint32_t number = 1; number <= 5; number++) {
        EXPECT_EQ(write(number), RECORD_WORDS);
        start();
        EXPECT_EQ(ring.sequence, number);
        EXPECT_TRUE(has(number, number));
        EXPECT_FALSE(ring.damaged);
        EXPECT_FALSE(ring.torn_commit);
    }
}

// [SR-58]
TEST_F(NvmRing, every_bit_of_a_committed_record_that_flips_makes_it_damaged_until_one_is_written) {
    write(1);
    for (unsigned index = 0; index + 1 < RECORD_WORDS; index++) {
        for (unsigned bit = 0; bit < 64; bit++) {
            word(0, index) ^= UINT64_C(1) << bit;
            start();
            EXPECT_EQ(ring.sequence, 0u) << index << ", " << bit;
            EXPECT_TRUE(ring.damaged) << index << ", " << bit;
            EXPECT_FALSE(has(1, 1));
            word(0, index) ^= UINT64_C(1) << bit;
        }
    }
    word(0, 1) ^= 1;
    start();
    write(2);
    EXPECT_FALSE(ring.damaged) << "there is a valid one now";
    EXPECT_TRUE(has(1, 2));
}

TEST_F(NvmRing, a_place_that_has_changed_in_memory_is_written_within_both_halves_or_not_at_all) {
    write(1);
    step(payload_of(2));
    const nvm_ring_t before = ring;
    const auto check = [&](auto nvm_ring_t::*member, unsigned values) {
        for (unsigned changed = 0; changed < values; changed++) {
            ring = before;
            ring.*member = std::remove_reference_t<decltype(ring.*member)>(changed);
            const auto memory = hal.nvm;
            step(payload_of(2));
            for (unsigned page = 0; page < HAL_NVM_PAGES; page++) {
                const bool own = page == PAGE || page == PAGE + 1;
                EXPECT_TRUE(own || std::memcmp(memory.word[page], hal.nvm.word[page], sizeof memory.word[page]) == 0)
                    << changed;
            }
            hal.nvm = memory;
        }
    };
    check(&nvm_ring_t::newest_half, 256);
    check(&nvm_ring_t::half, 256);
    check(&nvm_ring_t::slot, 256);
    check(&nvm_ring_t::word, 2 * HAL_NVM_PAGE_WORDS);
    check(&nvm_ring_t::record_words, HAL_NVM_PAGE_WORDS);
    check(&nvm_ring_t::erase, 256);
}

// The test's memory, as a host's, ends with its last page.
TEST_F(NvmRing, a_length_or_first_page_that_has_changed_in_memory_is_read_and_written_within_the_memory_and_ends) {
    write(1);
    const nvm_ring_t before = ring;
    for (const unsigned changed : {0u, 1u, 2u, 3u, 256u, 257u, 2047u, 2048u, 4096u, 32768u, 65535u}) {
        for (const unsigned first_page : {PAGE, HAL_NVM_PAGES - 1u, 255u}) {
            ring = before;
            ring.record_words = uint16_t(changed);
            ring.first_page = uint8_t(first_page);
            payload_t payload;
            nvm_ring_step(&ring, &hal, 0);
            if (changed < RECORD_WORDS) { // what the caller has room for
                nvm_ring_read(&ring, &hal, 1, payload.data());
            }
            EXPECT_LT(nvm_ring_place(&ring, &hal, 7) + 1u, 1u) << changed << ", " << first_page;
        }
    }
}

TEST_F(NvmRing, an_unfinished_record_is_no_damage) {
    for (unsigned steps = 1; steps < RECORD_WORDS; steps++) {
        nvm_init(&hal.nvm);
        start();
        for (unsigned i = 0; i < steps; i++) {
            EXPECT_EQ(step(payload_of(1)), NVM_RING_BUSY);
        }
        start();
        EXPECT_EQ(ring.sequence, 0u);
        EXPECT_FALSE(ring.damaged) << steps;
    }
}

TEST_F(NvmRing, a_torn_commit_word_is_told_until_the_next_record_is_written) {
    write(1);
    word(0, RECORD_WORDS - 1) ^= 1;
    start();
    EXPECT_TRUE(has(1, 1));
    EXPECT_TRUE(ring.torn_commit);
    EXPECT_FALSE(ring.damaged);
    write(2);
    EXPECT_FALSE(ring.torn_commit);
    start();
    EXPECT_FALSE(ring.torn_commit) << "an older record's does not matter";
}

TEST_F(NvmRing, a_record_that_is_given_up_is_begun_anew_in_another_place) {
    for (unsigned steps = 0; steps < RECORD_WORDS; steps++) {
        nvm_init(&hal.nvm);
        start();
        write(1);
        for (unsigned i = 0; i < steps; i++) {
            EXPECT_EQ(step(payload_of(2)), NVM_RING_BUSY);
        }
        const unsigned slot = ring.slot;
        nvm_ring_abandon(&ring, &hal);
        EXPECT_EQ(ring.slot, slot + (steps > 0 ? 1u : 0u)) << steps;
        EXPECT_EQ(write(3), RECORD_WORDS) << "all words, after " << steps;
        EXPECT_TRUE(has(1, 1));
        EXPECT_TRUE(has(2, 3));
    }
}

TEST_F(NvmRing, a_full_page_costs_one_step_for_the_erasure_of_the_other_and_keeps_the_newest) {
    constexpr unsigned SLOTS = HAL_NVM_PAGE_WORDS / RECORD_WORDS;
    for (uint32_t number = 1; number <= 4 * SLOTS + 1; number++) {
        const bool erases = number > 1 && (number - 1) % SLOTS == 0;
        EXPECT_EQ(write(number), RECORD_WORDS + (erases ? 1 : 0)) << number;
        const uint32_t oldest = number <= 2 * SLOTS ? 1 : number - SLOTS - (number - 1) % SLOTS;
        EXPECT_TRUE(has(number, number));
        EXPECT_TRUE(has(oldest, oldest)) << number;
        EXPECT_FALSE(has(oldest - 1, oldest - 1)) << number;
    }
    EXPECT_EQ(hal.nvm.erasures[PAGE] + hal.nvm.erasures[PAGE + 1], 4u);
    EXPECT_EQ(hal.nvm.erasures[PAGE - 1] + hal.nvm.erasures[PAGE + 2], 0u);
}

TEST_F(NvmRing, fails_after_four_places_that_do_not_take_the_record_and_counts_them_anew_for_the_next) {
    for (int record = 0; record < 2; record++) {
        hal.worn_page = PAGE;
        for (unsigned attempt = 1; attempt <= NVM_RING_ATTEMPTS; attempt++) {
            EXPECT_EQ(step(payload_of(1)), attempt < NVM_RING_ATTEMPTS ? NVM_RING_BUSY : NVM_RING_FAILED) << attempt;
        }
    }
}

// --- Records that take several pages of each half ---

constexpr unsigned LONG_WORDS = 2 * HAL_NVM_PAGE_WORDS + 100, LONG_PAGES = 3, LONG_PAGE = 4;

class LongRecord : public testing::Test {
  protected:
    LongRecord() { nvm_init(&hal.nvm); }

    static uint64_t word_of(uint32_t number, unsigned index) { return uint64_t(number) << 32 | (index * 2654435761u); }

    void start() { nvm_ring_init(&ring, &hal, LONG_PAGE, LONG_WORDS); }

    // Steps until the record is written or the power is lost; the number of steps.
    unsigned write(uint32_t number) {
        for (unsigned steps = 1;; steps++) {
            const nvm_ring_result_t result = nvm_ring_step(&ring, &hal, word_of(number, nvm_ring_payload_index(&ring)));
            if (result != NVM_RING_BUSY || hal.nvm.power_lost) {
                return steps;
            }
        }
    }

    // The newest record is the number's, word for word.
    testing::AssertionResult has(uint32_t number) {
        start();
        const unsigned place = nvm_ring_place(&ring, &hal, ring.sequence);
        if (ring.sequence != number || place == NVM_RING_NOWHERE) {
            return testing::AssertionFailure() << "newest " << ring.sequence << " instead of " << number;
        }
        for (unsigned i = 0; i < LONG_WORDS - NVM_RING_OVERHEAD; i++) {
            if (nvm_ring_payload(&ring, &hal, place, i) != word_of(number, i)) {
                return testing::AssertionFailure() << "word " << i;
            }
        }
        return testing::AssertionSuccess();
    }

    hal_t hal{};
    nvm_ring_t ring{};
};

TEST_F(LongRecord, erases_every_page_of_the_other_half_and_takes_a_step_for_each_and_for_each_word) {
    start();
    for (uint32_t number = 1; number <= 5; number++) {
        EXPECT_EQ(write(number), LONG_WORDS + (number > 1 ? LONG_PAGES : 0)) << number;
        EXPECT_TRUE(has(number));
    }
    for (unsigned page = 0; page < HAL_NVM_PAGES; page++) {
        const bool own = page >= LONG_PAGE && page < LONG_PAGE + 2 * LONG_PAGES;
        EXPECT_EQ(hal.nvm.erasures[page], own ? 2u : 0u) << page;
    }
}

// [SR-59]
TEST_F(LongRecord, a_cut_at_any_operation_of_any_kind_leaves_the_record_before_or_the_new_one) {
    start();
    write(1);
    write(2);
    const nvm_t before = hal.nvm;
    for (unsigned kind = 0; kind < NVM_CUT_KINDS; kind++) {
        // Every 19th of the words in the middle, which are alike.
        constexpr unsigned LAST = LONG_WORDS + LONG_PAGES;
        for (unsigned operation = 1; operation <= LAST; operation += operation < 8 || operation > LAST - 20 ? 1 : 19) {
            hal.nvm = before;
            hal.nvm.random = operation;
            start();
            hal.nvm.cut_kind = nvm_cut_t(kind);
            hal.nvm.cut_after = operation;
            write(3);
            ASSERT_TRUE(hal.nvm.power_lost);
            nvm_power_on(&hal.nvm);
            const bool last = operation == LAST;
            ASSERT_TRUE(has(2) || (last && has(3))) << kind << ", " << operation;
            const uint32_t next = ring.sequence + 1;
            write(next);
            ASSERT_TRUE(has(next)) << "and the next one is written, " << kind << ", " << operation;
        }
    }
}

} // namespace
