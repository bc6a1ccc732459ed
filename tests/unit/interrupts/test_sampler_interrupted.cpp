// The background's calls of the recorder, interrupted after each of their instructions by an event.
//
// On x86-64 the processor's trap flag raises a signal after every instruction; the event comes in the handler, as an
// interrupt comes on a target. Whatever order the compiler has given the stores, the recorder must be consistent.
#include <gtest/gtest.h>

#if defined(__x86_64__)

#include <array>
#include <csignal>
#include <cstdint>
#include <cstring>
#include <functional>

#include <ucontext.h>

extern "C" {
#include "interrupts/sampler.h"
}

namespace {

constexpr unsigned WORDS = 16;
constexpr greg_t TRAP_FLAG = 0x100;

uint32_t memory[WORDS];
sampler_t sampler, result;
uint32_t events = 0;
unsigned steps = 0, interrupt_after = 0;

// Event number `events`; only when the recorder wants one.
void event() {
    for (unsigned i = 0; i < WORDS; i++) {
        memory[i] = 1000003u * events + i;
    }
    events++;
    if (*static_cast<volatile uint32_t *>(&sampler.event) != 0) {
        sampler_record(&sampler, memory, WORDS, 25 * (events - 1), 0);
    }
}

void trap(int, siginfo_t *, void *context) {
    if (++steps == interrupt_after) {
        event();
        static_cast<ucontext_t *>(context)->uc_mcontext.gregs[REG_EFL] &= ~TRAP_FLAG;
    }
}

// Calls a function with an event after this number of its instructions; false: it has fewer.
__attribute__((noinline)) bool interrupted(unsigned after, const std::function<void()> &call) {
    steps = 0;
    interrupt_after = after;
    __asm__ volatile("pushfq\n\torq $0x100, (%%rsp)\n\tpopfq" ::: "memory", "cc");
    call();
    __asm__ volatile("pushfq\n\tandq $~0x100, (%%rsp)\n\tpopfq" ::: "memory", "cc");
    return steps >= after;
}

sampler_setup_t setup_of(unsigned channels) {
    sampler_setup_t setup{};
    setup.channels = uint8_t(channels);
    for (unsigned i = 0; i < channels; i++) {
        setup.word[i] = uint16_t(i);
    }
    setup.event = SAMPLER_EVENT_CONTROL;
    setup.divider = 1;
    return setup;
}

class Interrupted : public testing::Test {
  protected:
    Interrupted() {
        struct sigaction action {};
        action.sa_sigaction = trap;
        action.sa_flags = SA_SIGINFO;
        sigaction(SIGTRAP, &action, &before_);
        events = 0;
        sampler = {};
    }
    ~Interrupted() override { sigaction(SIGTRAP, &before_, nullptr); }

    static void arm(unsigned channels, bool streams, uint16_t before = 0) {
        sampler_setup_t setup = setup_of(channels);
        setup.before = before;
        ASSERT_TRUE(sampler_arm(&sampler, &setup, streams, memory, WORDS));
    }

    static void expect_record(const std::array<uint32_t, 1 + SAMPLER_CHANNELS_MAX> &record, uint32_t number) {
        EXPECT_EQ(record[0], 25 * number);
        for (unsigned i = 0; i <= sampler.last_channel; i++) {
            EXPECT_EQ(record[1 + i], 1000003u * number + i);
        }
    }

  private:
    struct sigaction before_ {};
};

TEST_F(Interrupted, taking_from_a_full_ring_neither_mixes_nor_loses_a_record_uncounted) {
    constexpr unsigned CHANNELS = SAMPLER_CHANNELS_MAX;
    constexpr uint32_t CAPACITY = (SAMPLER_WORDS + CHANNELS) / (CHANNELS + 1);
    unsigned lost_before = 0, kept_after = 0;
    for (unsigned after = 1;; after++) {
        arm(CHANNELS, true);
        for (events = 0; events < CAPACITY;) {
            event();
        }
        std::array<uint32_t, 1 + SAMPLER_CHANNELS_MAX> record{};
        bool taken = false;
        const bool was = interrupted(after, [&] { taken = sampler_take(&sampler, record.data()); });
        ASSERT_TRUE(taken);
        expect_record(record, 0);
        if (!was) {
            break;
        }
        ASSERT_EQ(sampler.written, CAPACITY + 1 - sampler.lost);
        lost_before += sampler.lost;
        kept_after += 1 - sampler.lost;
        for (uint32_t number = 1; number < sampler.written; number++) {
            ASSERT_TRUE(sampler_take(&sampler, record.data()));
            expect_record(record, number);
            ASSERT_FALSE(HasFailure()) << "event after instruction " << after;
        }
        ASSERT_FALSE(sampler_take(&sampler, record.data()));
    }
    EXPECT_GT(lost_before, 20u);
    EXPECT_GT(kept_after, 0u);
}

TEST_F(Interrupted, taking_from_an_empty_ring_gives_a_whole_record_or_none) {
    unsigned none = 0, one = 0;
    for (unsigned after = 1;; after++) {
        arm(3, true);
        event();
        std::array<uint32_t, 1 + SAMPLER_CHANNELS_MAX> record{};
        ASSERT_TRUE(sampler_take(&sampler, record.data()));
        const uint32_t number = events;
        bool taken = false;
        const bool was = interrupted(after, [&] { taken = sampler_take(&sampler, record.data()); });
        if (!was) {
            break;
        }
        none += !taken;
        one += taken;
        ASSERT_TRUE(taken || sampler_take(&sampler, record.data()));
        expect_record(record, number);
        ASSERT_FALSE(HasFailure()) << "event after instruction " << after;
    }
    EXPECT_GT(none, 0u);
    EXPECT_GT(one, 0u);
}

// A buffer or stream that is armed while another one records has whole records only, from its first event on.
TEST_F(Interrupted, arming_anew_begins_with_a_whole_record_whatever_was_recorded_before) {
    for (const bool streams : {false, true}) {
        sampler_setup_t setup = setup_of(3);
        setup.before = 5;
        setup.condition = SAMPLER_EQUAL;
        setup.level = 5; // which no value here is
        for (unsigned after = 1;; after++) {
            arm(streams ? 2 : 7, !streams, streams ? 1000 : 0);
            for (unsigned k = 0; k < 50; k++) {
                event();
            }
            const uint32_t first = events;
            if (!interrupted(after, [&] { sampler_arm(&sampler, &setup, streams, memory, WORDS); })) {
                break;
            }
            ASSERT_EQ(sampler.state, streams ? SAMPLER_STREAMS : SAMPLER_ARMED);
            const uint32_t words = streams ? 4 : 3, records = sampler.place / words;
            ASSERT_LE(records, 1u) << "event after instruction " << after;
            const uint32_t begin = first + 1 - records; // the event was of the old one or is of the new one
            ASSERT_EQ(sampler.place, words * records);
            ASSERT_EQ(sampler.written, streams ? records : 0);
            ASSERT_EQ(sampler.left, streams ? sampler.capacity : sampler.capacity - records);
            while (events < begin + 5) {
                event();
            }
            for (uint32_t k = 0; k < 5; k++) {
                ASSERT_EQ(sampler.ring[words * k + words - 1], 1000003u * (begin + k) + 2u)
                    << "event after instruction " << after;
            }
        }
    }
}

TEST_F(Interrupted, what_is_stopped_records_no_more_and_a_complete_buffer_stays_complete) {
    for (const bool streams : {false, true}) {
        unsigned complete = 0;
        for (unsigned after = 1;; after++) {
            arm(4, streams);
            for (unsigned k = 0; k < SAMPLER_WORDS / 4 - 1; k++) { // a buffer: one record is missing
                event();
            }
            const sampler_t before = sampler;
            if (!interrupted(after, [] { sampler_stop(&sampler); })) {
                break;
            }
            const bool recorded = sampler.countdown != before.countdown || sampler.place != before.place;
            ASSERT_EQ(sampler.event, 0u);
            ASSERT_EQ(sampler.state, recorded && !streams ? SAMPLER_COMPLETE : SAMPLER_OFF)
                << "event after instruction " << after;
            complete += sampler.state == SAMPLER_COMPLETE;
            result = sampler;
            event();
            ASSERT_EQ(std::memcmp(&sampler, &result, sizeof sampler), 0);
        }
        EXPECT_EQ(complete > 0, !streams);
    }
}

TEST_F(Interrupted, the_trigger_comes_before_or_after_the_event) {
    for (unsigned after = 1;; after++) {
        sampler_setup_t setup = setup_of(1);
        setup.condition = SAMPLER_EQUAL;
        setup.level = -7;
        setup.variable = {0, 0, 0, true};
        ASSERT_TRUE(sampler_arm(&sampler, &setup, false, memory, WORDS));
        if (!interrupted(after, [] { sampler_trigger(&sampler); })) {
            break;
        }
        event();
        ASSERT_EQ(sampler.state, SAMPLER_ARMED);
        ASSERT_EQ(sampler.waiting_floor, 0u);
    }
}

} // namespace

#endif
