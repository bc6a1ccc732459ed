// The recorder against a reference that knows the whole course; what it refuses, loses and survives.
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <random>
#include <string>
#include <vector>

#include <gtest/gtest.h>
#include <sys/mman.h>

extern "C" {
#include "interrupts/sampler.h"
}

namespace {

constexpr unsigned WORDS = 16; // of the memory

using words_t = std::array<uint32_t, WORDS>;
using record_t = std::array<uint32_t, 1 + SAMPLER_CHANNELS_MAX>;

// Part of a word: `bits` from `lowest` on.
struct part_t {
    unsigned lowest, bits;
    bool is_signed;

    int64_t of(uint32_t word) const {
        const uint64_t range = uint64_t(1) << bits, raw = uint64_t(word >> lowest) % range;
        return is_signed && raw >= range / 2 ? int64_t(raw) - int64_t(range) : int64_t(raw);
    }
    // Changes the part only.
    void set(uint32_t &word, int64_t value) const {
        const uint32_t mask = uint32_t((uint64_t(1) << bits) - 1) << lowest;
        word = (word & ~mask) | (uint32_t(uint64_t(value)) << lowest & mask);
    }
    int64_t least() const { return is_signed ? -(int64_t(1) << (bits - 1)) : 0; }
    int64_t most() const { return least() + (int64_t(1) << bits) - 1; }
};

// Records of the ring: the last one begins before SAMPLER_WORDS.
unsigned capacity_of(unsigned record_words) {
    return (SAMPLER_WORDS + record_words - 1) / record_words;
}

bool waits(const sampler_t &sampler) {
    return sampler.waiting_floor > 0;
}

// last: value at the event before, nullptr at the first one; armed: value at the arming.
bool holds(sampler_condition_t condition, int64_t value, int64_t level, const int64_t *last, int64_t armed) {
    switch (condition) {
    case SAMPLER_AT_ONCE:
        return true;
    case SAMPLER_AT_LEAST:
        return value >= level;
    case SAMPLER_AT_MOST:
        return value <= level;
    case SAMPLER_RISING:
        return last && *last < level && value >= level;
    case SAMPLER_FALLING:
        return last && *last > level && value <= level;
    case SAMPLER_EQUAL:
        return value == level;
    default:
        return value != armed;
    }
}

sampler_setup_t any_setup(std::mt19937 &random, const part_t &part, int64_t level) {
    sampler_setup_t setup{};
    setup.channels = uint8_t(1 + random() % SAMPLER_CHANNELS_MAX);
    for (unsigned i = 0; i < setup.channels; i++) {
        setup.word[i] = uint16_t(random() % WORDS);
    }
    setup.event = sampler_event_t(1 + random() % 4);
    setup.divider = uint16_t(random() % 3 == 0 ? 1 : 1 + random() % 5);
    const unsigned most = capacity_of(setup.channels) - 2;
    const unsigned kind = random() % 4;
    setup.before = uint16_t(kind == 0 ? 0 : kind == 1 ? most : random() % (most + 1));
    setup.condition = sampler_condition_t(random() % SAMPLER_CONDITIONS);
    setup.variable = {uint16_t(random() % WORDS), uint8_t(32 - part.lowest - part.bits), uint8_t(32 - part.bits),
                      part.is_signed};
    setup.level = int32_t(uint32_t(level));
    return setup;
}

part_t any_part(std::mt19937 &random) {
    const unsigned kinds[] = {1, 8, 16, 32, unsigned(1 + random() % 32)};
    const unsigned bits = kinds[random() % 5];
    return {unsigned(random() % (33 - bits)), bits, random() % 2 == 0};
}

class Sampler : public testing::Test {
  protected:
    void event(uint32_t time_us = 0) { sampler_record(&sampler, memory.data(), WORDS, time_us, 0); }

    // Two channels, as a stream or a buffer.
    static sampler_setup_t plain() {
        sampler_setup_t setup{};
        setup.word[0] = 3;
        setup.word[1] = 7;
        setup.channels = 2;
        setup.event = SAMPLER_EVENT_CONTROL;
        setup.divider = 1;
        return setup;
    }

    // Event number `number` of a stream: each word has a value of its own.
    void number(uint32_t number) {
        for (unsigned i = 0; i < WORDS; i++) {
            memory[i] = 1000003u * number + i;
        }
        event(25 * number);
    }

    words_t memory{};
    sampler_t sampler{};
};

// A course of random values around the level, recorded from its start to the end of the buffer.
class Course {
  public:
    explicit Course(unsigned seed) : random_(seed), part_(any_part(random_)) {
        const int64_t range = part_.most() - part_.least();
        const int64_t at_ends[] = {part_.least(), part_.most()};
        level_ = random_() % 6 == 0 ? at_ends[random_() % 2]
                                    : part_.least() + int64_t((uint64_t(random_()) << 32 | random_()) % (range + 1));
        spread_ = 1 + int64_t(random_() % 40);
        setup_ = any_setup(random_, part_, level_);
        trigger_now_ = random_() % 8 == 0 ? int64_t(random_() % 3000) : INT64_MAX;
    }

    // Whether the buffer is complete.
    bool run() {
        if (random_() % 4 != 0) { // what is recorded may have another value at the first event
            step();
        }
        armed_ = part_.of(memory_[setup_.variable.word]);
        EXPECT_TRUE(sampler_arm(&sampler_, &setup_, false, memory_.data(), WORDS));
        for (int64_t event = 0; event < 30000; event++) {
            if (event == trigger_now_) {
                sampler_trigger(&sampler_);
            }
            step();
            const bool record = event % setup_.divider == 0;
            expect_trigger(event);
            if (record) {
                records_.push_back(memory_);
            }
            EXPECT_EQ(sampler_.event, uint32_t(setup_.event));
            sampler_record(&sampler_, memory_.data(), WORDS, uint32_t(random_()), 0);
            if (trigger_record_ >= 0 && int64_t(records_.size()) == trigger_record_ + capacity() - before_) {
                expect_complete();
                return true;
            }
            if (sampler_.state != SAMPLER_ARMED || waits(sampler_) != (trigger_record_ < 0)) {
                ADD_FAILURE() << "state " << sampler_.state << " at event " << event << ", waits " << waits(sampler_);
                return false;
            }
        }
        return false;
    }

    sampler_condition_t condition() const { return setup_.condition; }

  private:
    int64_t capacity() const { return capacity_of(setup_.channels); }

    void step() {
        for (uint32_t &word : memory_) {
            word = 1664525u * word + uint32_t(random_());
        }
        const int64_t value = random_() % 50 == 0 ? level_ : level_ - spread_ + int64_t(random_() % (2 * spread_ + 1));
        const bool rare =
            random_() % 400 != 0 && (setup_.condition == SAMPLER_EQUAL || setup_.condition == SAMPLER_CHANGED);
        value_ = rare
                     ? std::max(part_.least(), std::min(part_.most(), level_ == part_.most() ? level_ - 1 : level_ + 1))
                     : std::max(part_.least(), std::min(part_.most(), value));
        part_.set(memory_[setup_.variable.word], value_);
        EXPECT_EQ(part_.of(memory_[setup_.variable.word]), value_);
    }

    // Records that precede an event belong to earlier events.
    void expect_trigger(int64_t event) {
        if (trigger_record_ < 0 &&
            (event >= trigger_now_ || holds(setup_.condition, value_, level_, has_last_ ? &last_ : nullptr, armed_))) {
            trigger_record_ = (event + setup_.divider - 1) / setup_.divider;
            trigger_events_ = trigger_record_ * setup_.divider - event;
            before_ = std::min(int64_t(setup_.before), int64_t(records_.size()));
        }
        last_ = value_;
        has_last_ = true;
    }

    void expect_complete() {
        ASSERT_EQ(sampler_.state, SAMPLER_COMPLETE);
        EXPECT_EQ(sampler_.event, 0u);
        EXPECT_EQ(sampler_.capacity, capacity());
        EXPECT_EQ(sampler_.record_words, setup_.channels);
        EXPECT_EQ(sampler_.trigger_events, trigger_events_);
        EXPECT_EQ(sampler_.capacity - sampler_.trigger_left, before_);
        const auto words = uint32_t(capacity() * setup_.channels);
        ASSERT_LE(sampler_.place, words);
        uint32_t place = sampler_.place; // of the oldest record, which `before` others follow up to the trigger
        for (int64_t k = trigger_record_ - before_; k < int64_t(records_.size()); k++) {
            for (unsigned i = 0; i < setup_.channels; i++, place++) {
                ASSERT_EQ(sampler_.ring[place % words], records_[size_t(k)][setup_.word[i]]) << "record " << k;
            }
        }
        EXPECT_EQ(place, sampler_.place + words) << "the whole ring";
    }

    std::mt19937 random_;
    part_t part_;
    int64_t level_, spread_, trigger_now_;
    sampler_setup_t setup_;
    sampler_t sampler_{};
    words_t memory_{};
    int64_t value_ = 0, last_ = 0, armed_ = 0;
    bool has_last_ = false;
    int64_t trigger_record_ = -1, trigger_events_ = 0, before_ = 0;
    std::vector<words_t> records_;
};

TEST(SamplerBuffer, triggers_at_the_event_of_the_reference_and_keeps_what_surrounds_it) {
    unsigned complete = 0, of_condition[SAMPLER_CONDITIONS] = {};
    for (unsigned seed = 0; seed < 1000; seed++) {
        Course course(seed);
        const bool completed = course.run();
        complete += completed;
        of_condition[course.condition()] += completed;
        ASSERT_FALSE(testing::Test::HasFailure()) << "seed " << seed;
    }
    EXPECT_GT(complete, 800u);
    for (const unsigned count : of_condition) {
        EXPECT_GT(count, 50u);
    }
}

TEST_F(Sampler, records_each_deferred_step_once_at_the_first_control_interrupt_after_its_end) {
    std::mt19937 random(3);
    for (const bool deferred : {true, false}) {
        sampler_setup_t setup = plain();
        setup.event = deferred ? SAMPLER_EVENT_DEFERRED : SAMPLER_EVENT_CONTROL;
        EXPECT_TRUE((setup.event & SAMPLER_IN_CONTROL) != 0);
        ASSERT_TRUE(sampler_arm(&sampler, &setup, true, memory.data(), WORDS));
        for (uint32_t k = 0, skipped = 0; k < 1000; k++) {
            skipped = random() % 2 ? skipped + 1 : 0; // some steps take longer than a period
            const uint32_t written = sampler.written;
            sampler_record(&sampler, memory.data(), WORDS, k, skipped);
            ASSERT_EQ(sampler.written - written, deferred && skipped > 0 ? 0 : 1);
        }
    }
    EXPECT_EQ((SAMPLER_EVENT_BACKGROUND | SAMPLER_EVENT_IDENTIFY) & SAMPLER_IN_CONTROL, 0u);
}

TEST(SamplerMemory, every_word_of_a_drive_of_any_size_is_the_one_that_is_recorded) {
    std::vector<uint32_t> memory(SAMPLER_DRIVE_WORDS_MAX);
    for (uint32_t i = 0; i < memory.size(); i++) {
        memory[i] = 3 * i + 1;
    }
    sampler_setup_t setup{};
    setup.channels = 1;
    setup.event = SAMPLER_EVENT_CONTROL;
    setup.divider = 1;
    sampler_t sampler{};
    for (const uint32_t words : {1u, 2u, 3u, 255u, 7552u, 32768u, 50001u, 65535u, 65536u}) {
        for (uint32_t i = 0; i < words; i++) {
            setup.word[0] = uint16_t(i);
            ASSERT_TRUE(sampler_arm(&sampler, &setup, false, memory.data(), words));
            sampler_record(&sampler, memory.data(), words, 0, 0);
            ASSERT_EQ(sampler.ring[0], memory[i]) << words;
        }
        for (const uint32_t part : {0u, 0x7FFFFFFFu, 0xFFFFFFFFu}) { // changed in memory
            sampler.part[0] = part;
            sampler_record(&sampler, memory.data(), words, 0, 0);
            ASSERT_EQ(sampler.ring[sampler.place - 1], memory[uint64_t(part) * words >> 32]);
        }
    }
}

TEST_F(Sampler, compares_an_unsigned_word_with_a_level_of_its_kind) {
    sampler_setup_t setup = plain();
    setup.variable = {5, 0, 0, false};
    setup.level = int32_t(0x80000001u);
    for (const sampler_condition_t condition : {SAMPLER_AT_LEAST, SAMPLER_RISING}) {
        setup.condition = condition;
        ASSERT_TRUE(sampler_arm(&sampler, &setup, false, memory.data(), WORDS));
        for (const uint32_t below : {0u, 0x7FFFFFFFu, 0x80000000u}) {
            memory[5] = below;
            event();
            ASSERT_TRUE(waits(sampler)) << below;
        }
        memory[5] = 0x80000001u;
        event();
        EXPECT_FALSE(waits(sampler));
    }
}

TEST_F(Sampler, refuses_each_member_out_of_range_with_nothing_changed) {
    std::mt19937 random(1);
    sampler_setup_t setup = plain();
    setup.condition = SAMPLER_EQUAL;
    setup.level = -1;
    ASSERT_TRUE(sampler_arm(&sampler, &setup, false, memory.data(), WORDS));
    for (int k = 0; k < 100; k++) {
        event();
    }
    const auto refuses = [&](const char *name, auto change, bool streams = false) {
        sampler_setup_t other = plain();
        change(other);
        const sampler_t before = sampler;
        EXPECT_FALSE(sampler_arm(&sampler, &other, streams, memory.data(), WORDS)) << name;
        EXPECT_EQ(std::memcmp(&before, &sampler, sizeof before), 0) << name;
    };
    for (const bool streams : {false, true}) {
        refuses(
            "no channel", [](auto &s) { s.channels = 0; }, streams);
        for (unsigned channels = SAMPLER_CHANNELS_MAX + 1; channels < 256; channels++) {
            refuses(
                "channels", [&](auto &s) { s.channels = uint8_t(channels); }, streams);
        }
        for (unsigned i = 0; i < SAMPLER_CHANNELS_MAX; i++) {
            for (const unsigned word : {WORDS, 65535u}) {
                refuses(
                    "word",
                    [&](auto &s) {
                        s.channels = SAMPLER_CHANNELS_MAX;
                        s.word[i] = uint16_t(word);
                    },
                    streams);
            }
        }
        refuses(
            "event 0", [](auto &s) { s.event = sampler_event_t(0); }, streams);
        refuses(
            "event 5", [](auto &s) { s.event = sampler_event_t(5); }, streams);
        refuses(
            "divider", [](auto &s) { s.divider = 0; }, streams);
        refuses(
            "condition", [](auto &s) { s.condition = SAMPLER_CONDITIONS; }, streams);
        refuses(
            "variable", [](auto &s) { s.variable.word = WORDS; }, streams);
        refuses(
            "left", [](auto &s) { s.variable.left = 32; }, streams);
        for (const int32_t level : {-1, 256, INT32_MIN}) {
            refuses(
                "level",
                [&](auto &s) {
                    s.condition = SAMPLER_AT_LEAST;
                    s.variable = {3, 24, 24, false};
                    s.level = level;
                },
                streams);
        }
        refuses(
            "right", [](auto &s) { s.variable.right = 255; }, streams);
    }
    for (unsigned channels = 1; channels <= SAMPLER_CHANNELS_MAX; channels++) {
        const unsigned most = capacity_of(channels) - 2;
        for (const unsigned before : {most + 1, 65535u}) {
            refuses("before", [&](auto &s) {
                s.channels = uint8_t(channels);
                s.before = uint16_t(before);
            });
        }
        setup = plain();
        setup.channels = uint8_t(channels);
        setup.before = uint16_t(most);
        sampler_t other{};
        EXPECT_TRUE(sampler_arm(&other, &setup, false, memory.data(), WORDS)) << "the largest that there is room for";
        setup.before = 65535;
        EXPECT_TRUE(sampler_arm(&other, &setup, true, memory.data(), WORDS)) << "a stream has no trigger";
    }
}

TEST_F(Sampler, streams_every_record_in_order_with_its_time_while_a_consumer_takes_at_random) {
    for (unsigned seed = 0; seed < 60; seed++) {
        std::mt19937 random(seed);
        sampler_setup_t setup = any_setup(random, {0, 32, true}, 0);
        ASSERT_TRUE(sampler_arm(&sampler, &setup, true, memory.data(), WORDS));
        const uint32_t capacity = capacity_of(setup.channels + 1u);
        std::vector<uint32_t> kept; // numbers of the events whose records are in the ring
        size_t taken = 0;
        uint32_t lost = 0, patience = 0;
        for (uint32_t k = 0; k < 8000; k++) {
            if (k % setup.divider == 0) {
                kept.size() - taken < capacity ? kept.push_back(k) : void(lost++);
            }
            number(k);
            ASSERT_EQ(sampler.lost, lost);
            if (patience > 0) { // the consumer is away
                patience--;
                continue;
            }
            record_t record{};
            for (unsigned take = random() % 4; take > 0; take--) {
                ASSERT_EQ(sampler_take(&sampler, record.data()), taken < kept.size());
                if (taken < kept.size()) {
                    const uint32_t from = kept[taken++];
                    ASSERT_EQ(record[0], 25 * from);
                    for (unsigned i = 0; i < setup.channels; i++) {
                        ASSERT_EQ(record[1 + i], 1000003u * from + setup.word[i]) << "seed " << seed;
                    }
                }
            }
            patience = random() % 300 == 0 ? random() % 4000 : 0;
        }
        EXPECT_EQ(sampler.event, uint32_t(setup.event));
        EXPECT_EQ(sampler.written, kept.size());
    }
}

TEST_F(Sampler, a_record_that_is_being_taken_is_overwritten_only_after_it_is_given_back) {
    const sampler_setup_t setup = plain();
    ASSERT_TRUE(sampler_arm(&sampler, &setup, true, memory.data(), WORDS));
    for (uint32_t k = 0; k < capacity_of(3); k++) {
        number(k);
    }
    const sampler_t full = sampler;
    record_t record{};
    ASSERT_TRUE(sampler_take(&sampler, record.data()));
    sampler.taken = full.taken; // the last store of taking is still to come
    number(capacity_of(3));
    EXPECT_EQ(sampler.lost, 1u);
    EXPECT_EQ(std::memcmp(sampler.ring, full.ring, sizeof full.ring), 0);
}

TEST_F(Sampler, counts_records_beyond_the_range_of_the_counter) {
    const sampler_setup_t setup = plain();
    ASSERT_TRUE(sampler_arm(&sampler, &setup, true, memory.data(), WORDS));
    sampler.written = sampler.taken = 0xFFFFFFF0u;
    record_t record{};
    for (uint32_t k = 0; k < capacity_of(3) + 5; k++) {
        number(k);
    }
    EXPECT_EQ(sampler.lost, 5u);
    for (uint32_t k = 0; k < capacity_of(3); k++) {
        ASSERT_TRUE(sampler_take(&sampler, record.data()));
        ASSERT_EQ(record[0], 25 * k);
    }
    EXPECT_FALSE(sampler_take(&sampler, record.data()));
}

TEST_F(Sampler, stops_and_is_armed_anew_in_any_state) {
    sampler_setup_t setup = plain();
    setup.before = 10;
    record_t record{};
    for (const int events : {0, 5, 12, 100000}) { // armed, waits, follows, complete
        ASSERT_TRUE(sampler_arm(&sampler, &setup, false, memory.data(), WORDS));
        for (int k = 0; k < events && sampler.event != 0; k++) {
            number(uint32_t(k));
        }
        const sampler_t before = sampler;
        sampler_stop(&sampler);
        EXPECT_EQ(sampler.event, 0u);
        EXPECT_EQ(sampler.state, events == 100000 ? SAMPLER_COMPLETE : SAMPLER_OFF);
        EXPECT_EQ(std::memcmp(sampler.ring, before.ring, sizeof before.ring), 0);
        EXPECT_FALSE(sampler_take(&sampler, record.data())) << "it is no stream";
    }
    ASSERT_TRUE(sampler_arm(&sampler, &setup, true, memory.data(), WORDS));
    number(1);
    sampler_stop(&sampler);
    EXPECT_FALSE(sampler_take(&sampler, record.data()));
    ASSERT_TRUE(sampler_arm(&sampler, &setup, true, memory.data(), WORDS));
    EXPECT_FALSE(sampler_take(&sampler, record.data())) << "none of the stream before";
    number(2);
    ASSERT_TRUE(sampler_take(&sampler, record.data()));
    EXPECT_EQ(record[0], 50u);
}

TEST_F(Sampler, trigger_now_has_no_effect_on_a_stream_and_on_what_is_complete) {
    const sampler_setup_t setup = plain();
    ASSERT_TRUE(sampler_arm(&sampler, &setup, true, memory.data(), WORDS));
    sampler_trigger(&sampler);
    number(1);
    EXPECT_EQ(sampler.state, SAMPLER_STREAMS);
    ASSERT_TRUE(sampler_arm(&sampler, &setup, false, memory.data(), WORDS));
    while (sampler.event != 0) {
        number(1);
    }
    sampler_trigger(&sampler);
    EXPECT_EQ(sampler.state, SAMPLER_COMPLETE);
    EXPECT_EQ(sampler.event, 0u);
}

// Words between pages that must not be touched.
class Guarded {
  public:
    Guarded() : area_(mmap(nullptr, 2 * GUARD + PAGE, PROT_NONE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0)) {
        EXPECT_NE(area_, MAP_FAILED);
        EXPECT_EQ(mprotect(begin(), PAGE, PROT_READ | PROT_WRITE), 0);
    }
    ~Guarded() { munmap(area_, 2 * GUARD + PAGE); }
    Guarded(const Guarded &) = delete;

    // The last `words` before the guard behind them.
    const uint32_t *last(unsigned words) const { return reinterpret_cast<uint32_t *>(begin() + PAGE) - words; }

  private:
    static constexpr size_t PAGE = 4096, GUARD = 1 << 20;
    char *begin() const { return static_cast<char *>(area_) + GUARD; }
    void *area_;
};

TEST(SamplerCorrupted, members_that_changed_in_memory_lead_nowhere_outside_the_ring_and_the_memory) {
    const Guarded guarded;
    struct {
        uint32_t before[1024];
        sampler_t sampler;
        uint32_t after[1024];
    } place{};
    sampler_t &sampler = place.sampler;
    std::mt19937 random(7);
    for (unsigned k = 0; k < 20000; k++) {
        const bool streams = random() % 2 == 0;
        const sampler_setup_t setup = any_setup(random, any_part(random), 0);
        ASSERT_TRUE(sampler_arm(&sampler, &setup, streams, guarded.last(WORDS), WORDS));
        for (unsigned events = random() % 20; events > 0; events--) {
            sampler_record(&sampler, guarded.last(WORDS), WORDS, k, random() % 2);
        }
        uint32_t *const whole[] = {
            &sampler.room,          &sampler.waiting_floor, &sampler.left,
            &sampler.countdown,     &sampler.divider,       &sampler.place,
            &sampler.record_words,  &sampler.last_channel,  &sampler.capacity,
            &sampler.trigger_part,  &sampler.factor,        &sampler.window_end,
            &sampler.window_length, &sampler.written,       &sampler.waits_for_outside,
            &sampler.taken,         &sampler.taken_place,   &sampler.part[random() % SAMPLER_CHANNELS_MAX]};
        for (uint32_t *member : whole) {
            const uint32_t any[] = {0,
                                    1,
                                    SAMPLER_WORDS - 1,
                                    SAMPLER_WORDS,
                                    0xFFFFFFFFu,
                                    uint32_t(0xFFFFFFFFu - random() % 20),
                                    uint32_t(random()),
                                    *member ^ 1u << random() % 32};
            *member = random() % 3 == 0 ? any[random() % 8] : *member;
        }
        record_t record[2] = {}; // the second one is behind the first
        for (unsigned events = 0; events < 40; events++) {
            sampler_record(&sampler, guarded.last(WORDS), WORDS, k, random() % 2);
            sampler_take(&sampler, record[0].data());
        }
        ASSERT_EQ(record[1], record_t{});
        for (unsigned i = 0; i < 1024; i++) {
            ASSERT_EQ(place.before[i] | place.after[i], 0u) << k;
        }
    }
}

} // namespace
