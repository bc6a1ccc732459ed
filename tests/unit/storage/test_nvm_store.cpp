// The memory of the drive: what survives a reset, power cuts at every operation, sets that must not be loaded. [SR-59]
#include <cstdio>
#include <cstring>
#include <vector>

#include <gtest/gtest.h>

extern "C" {
#include "control/machine_tables.h"
#include "storage/nvm_ring.h"
#include "support/power_cuts.h"
}

namespace {

constexpr unsigned PARAMETER_PAGE = 0, FAULT_PAGE = 2;
constexpr unsigned SET_WORDS = 1 + (PARAMETER_COUNT + 1) / 2 + NVM_RING_OVERHEAD;
constexpr unsigned FAULT_WORDS = sizeof(nvm_store_fault_t) / 8 + NVM_RING_OVERHEAD;
constexpr unsigned SETS_PER_PAGE = HAL_NVM_PAGE_WORDS / SET_WORDS;
constexpr unsigned FAULTS_PER_PAGE = HAL_NVM_PAGE_WORDS / FAULT_WORDS;

void expect_nothing_lost(const char *what, const power_cuts_t &result) {
    std::printf("%s: %u single cuts, %u pairs of cuts, %u losses, %u mixed\n", what, result.cuts, result.pairs,
                result.losses, result.mixed);
    EXPECT_EQ(result.losses, 0u);
    EXPECT_EQ(result.mixed, 0u);
    EXPECT_EQ(result.failures, 0u);
}

power_cuts_work_t work;

// The first one, one in the middle of a page, and those that erase: page 1 for the first time, page 0 with old records.
bool paired_set(uint32_t number) {
    return number == 1 || number == 3 || number == SETS_PER_PAGE + 1 || number == 2 * SETS_PER_PAGE + 1;
}

bool paired_fault(uint32_t number) {
    return number == 1 || number == 3 || number == FAULTS_PER_PAGE + 1 || number == 2 * FAULTS_PER_PAGE + 1;
}

TEST(PowerCuts, at_every_operation_of_parameter_writes_lose_and_mix_nothing) {
    power_cuts_t result{};
    cut_writes(&result, &work, WRITE_SET, 2 * SETS_PER_PAGE + 2, paired_set);
    expect_nothing_lost("sets of parameters", result);
    EXPECT_GT(result.cuts, 3u * (2 * SETS_PER_PAGE + 2) * SET_WORDS);
    EXPECT_GT(result.pairs, 4u * 9 * SET_WORDS * SET_WORDS);
}

// [SR-59] [SR-60]
TEST(PowerCuts, at_every_operation_of_log_entries_lose_and_mix_nothing) {
    power_cuts_t result{};
    cut_writes(&result, &work, WRITE_FAULT, 2 * FAULTS_PER_PAGE + 2, paired_fault);
    expect_nothing_lost("faults in the log", result);
    EXPECT_GT(result.cuts, 3u * (2 * FAULTS_PER_PAGE + 2) * FAULT_WORDS);
    EXPECT_GT(result.pairs, 4u * 9 * FAULT_WORDS * FAULT_WORDS);
}

// Full pages, of which the next record needs the other one: page 1 that is erased, and both with older records.
constexpr unsigned FULL_PAGES = 3;

struct Ring {
    write_t write;
    unsigned first_page, records_per_page;
};

class MemoryErrors : public testing::TestWithParam<Ring> {
  protected:
    // Writes records until the page that has the newest one is full.
    void fill(unsigned pages) {
        std::memset(&work.memory, 0, sizeof work.memory);
        nvm_init(&work.memory.hal.nvm);
        work.memory.hal.nvm.random = 1;
        for (unsigned i = 0; i < pages * GetParam().records_per_page; i++) {
            complete(&result, &work.drive, &work.memory, GetParam().write);
        }
    }

    unsigned other_page(unsigned full_pages) const { return GetParam().first_page + full_pages % 2; }

    power_cuts_t result{};
};

INSTANTIATE_TEST_SUITE_P(Rings, MemoryErrors,
                         testing::Values(Ring{WRITE_SET, PARAMETER_PAGE, SETS_PER_PAGE},
                                         Ring{WRITE_FAULT, FAULT_PAGE, FAULTS_PER_PAGE}),
                         [](const auto &ring) { return ring.param.write == WRITE_SET ? "sets" : "faults"; });

TEST_P(MemoryErrors, an_erasure_that_fails_and_a_power_cut_at_every_later_operation_lose_nothing) {
    for (unsigned pages = 1; pages <= FULL_PAGES; pages++) {
        for (uint32_t errors = 1; errors < NVM_RING_ATTEMPTS; errors++) {
            fill(pages);
            work.memory.hal.erase_errors = errors;
            cut_write(&result, &work, GetParam().write, false);
            complete(&result, &work.drive, &work.memory, GetParam().write);
        }
    }
    expect_nothing_lost("an erasure that fails", result);
    EXPECT_GT(result.cuts, FULL_PAGES * 3 * 3 * NVM_RING_OVERHEAD);
}

// The record is not written and says so; each further one fails likewise.
TEST_P(MemoryErrors, a_page_of_bad_words_costs_no_record_of_the_other_page) {
    for (const bool zero : {false, true}) {
        for (unsigned pages = 1; pages <= FULL_PAGES; pages += 2) {
            fill(pages);
            ASSERT_EQ(result.failures, 0u);
            hal_t &hal = work.memory.hal;
            hal.worn_page = other_page(pages);
            hal.worn_zero = zero;
            cut_write(&result, &work, GetParam().write, false);
            EXPECT_GT(result.cuts, 0u);
            EXPECT_EQ(result.failures, result.cuts);
            EXPECT_EQ(result.losses, 0u);
            EXPECT_EQ(result.mixed, 0u);
            result = {};
        }
    }
}

class NvmStore : public testing::Test {
  protected:
    void SetUp() override {
        std::memset(&memory, 0, sizeof memory);
        nvm_init(&memory.hal.nvm);
        start_drive(&drive, &memory);
    }

    void write(write_t kind) {
        write_next(&drive, &memory, kind, 0, NVM_CUT_OLD);
        (kind == WRITE_SET ? memory.sets : memory.faults)++;
        start_drive(&drive, &memory);
    }

    // Word of a stored set, by its place.
    uint64_t *set_word(unsigned set, unsigned word) {
        return &memory.hal.nvm.word[PARAMETER_PAGE][set * SET_WORDS + word];
    }

    memory_t memory;
    started_t drive;
};

// [SR-58]
TEST_F(NvmStore, an_erased_memory_gives_the_defaults_without_inhibiting_the_start) {
    EXPECT_TRUE(has_set(&drive, 0));
    EXPECT_FALSE(drive.store.inhibited);
    EXPECT_EQ(drive.store.start, 1u);
    EXPECT_EQ(nvm_store_newest_fault(&drive.store), 0u);
}

// [SR-58]
TEST_F(NvmStore, every_bit_of_the_newest_set_that_flips_makes_the_drive_use_the_set_before) {
    write(WRITE_SET);
    write(WRITE_SET);
    ASSERT_TRUE(has_set(&drive, 2));
    // In the commit word a flipped bit has no consequence: the checksum is a complete set's.
    for (unsigned word = 0; word + 1 < SET_WORDS; word++) {
        for (unsigned bit = 0; bit < 64; bit++) {
            *set_word(1, word) ^= UINT64_C(1) << bit;
            start_drive(&drive, &memory);
            EXPECT_TRUE(has_set(&drive, 1)) << word << ", " << bit;
            EXPECT_FALSE(drive.store.inhibited);
            *set_word(1, word) ^= UINT64_C(1) << bit;
        }
    }
}

// [SR-58]
TEST_F(NvmStore, sets_that_are_all_damaged_give_the_defaults_and_inhibit_the_start_until_one_is_stored) {
    write(WRITE_SET);
    write(WRITE_SET);
    *set_word(0, 4) ^= 1;
    *set_word(1, 5) ^= 1;
    start_drive(&drive, &memory);
    EXPECT_FALSE(drive.store.loaded);
    EXPECT_TRUE(drive.store.inhibited);
    for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
        EXPECT_EQ(drive.parameters.values[i], parameters_default(&drive.parameters, i));
    }
    parameter_store_save(&drive.store);
    for (unsigned i = 0; i < SET_WORDS; i++) {
        EXPECT_TRUE(drive.store.inhibited);
        nvm_store_step(&drive.store, &memory.hal, &drive.parameters, 1, true);
    }
    EXPECT_FALSE(drive.store.inhibited);
    EXPECT_EQ(drive.store.saving, NVM_STORE_SAVED);
    start_drive(&drive, &memory);
    EXPECT_TRUE(drive.store.loaded);
    EXPECT_FALSE(drive.store.inhibited);
}

// [SR-58]
TEST_F(NvmStore, a_set_of_another_machine_is_not_loaded_and_inhibits_the_start) {
    write(WRITE_SET);
    memory.sets = 1;
    machine_tables.node[7] ^= 1;
    start_drive(&drive, &memory);
    EXPECT_FALSE(drive.store.loaded);
    EXPECT_TRUE(drive.store.inhibited);
    machine_tables.node[7] ^= 1;
    start_drive(&drive, &memory);
    EXPECT_TRUE(has_set(&drive, 1));
    EXPECT_FALSE(drive.store.inhibited);
}

// [SR-58]
TEST_F(NvmStore, the_newest_of_a_thousand_sets_is_loaded_and_the_pages_wear_equally) {
    for (unsigned i = 0; i < 1000; i++) {
        write(WRITE_SET);
        ASSERT_TRUE(has_set(&drive, memory.sets));
    }
    const uint32_t *erasures = memory.hal.nvm.erasures;
    EXPECT_NEAR(erasures[PARAMETER_PAGE], 1000.0 / SETS_PER_PAGE / 2, 1.0);
    EXPECT_NEAR(erasures[PARAMETER_PAGE + 1], 1000.0 / SETS_PER_PAGE / 2, 1.0);
}

// [SR-60]
TEST_F(NvmStore, the_last_16_faults_are_read_and_no_other) {
    for (unsigned i = 0; i < 3 * FAULTS_PER_PAGE; i++) {
        write(WRITE_FAULT);
        const uint32_t newest = i + 1;
        ASSERT_EQ(nvm_store_newest_fault(&drive.store), newest);
        for (uint32_t number = 0; number <= newest + 1; number++) {
            const bool readable = number > 0 && number <= newest && number + NVM_STORE_FAULTS > newest;
            ASSERT_EQ(has_fault(&drive, &memory.hal, number), readable) << number << " of " << newest;
        }
    }
    EXPECT_GE(memory.hal.nvm.erasures[FAULT_PAGE] + memory.hal.nvm.erasures[FAULT_PAGE + 1], 2u);
}

TEST_F(NvmStore, a_step_makes_one_operation_and_none_while_the_memory_must_not_be_written) {
    const fault_record_t record = fault_of(1);
    nvm_store_follow_fault(&drive.store, &record);
    parameter_store_save(&drive.store);
    const nvm_t before = memory.hal.nvm;
    for (unsigned i = 0; i < 100; i++) {
        nvm_store_step(&drive.store, &memory.hal, &drive.parameters, i, false);
    }
    EXPECT_EQ(std::memcmp(&before, &memory.hal.nvm, sizeof before), 0);
    const unsigned operations = FAULT_WORDS + SET_WORDS + NVM_RING_OVERHEAD; // and the number of the start
    for (unsigned i = 1; i <= operations + 10; i++) {
        nvm_store_step(&drive.store, &memory.hal, &drive.parameters, 100 + i, true);
        EXPECT_EQ(memory.hal.nvm.operations, std::min(i, operations));
    }
}

TEST_F(NvmStore, a_parameter_that_changes_while_the_set_is_written_gives_the_new_set_whole) {
    write(WRITE_SET);
    for (unsigned steps = 1; steps < SET_WORDS; steps++) {
        memory_t copy = memory;
        start_drive(&drive, &copy);
        const int32_t before = drive.parameters.values[0];
        parameter_store_save(&drive.store);
        for (unsigned i = 0; i < steps; i++) {
            nvm_store_step(&drive.store, &copy.hal, &drive.parameters, 1, true);
        }
        const int32_t changed = before == parameters_row(0)->minimum ? before + 1 : before - 1;
        parameters_t set = drive.parameters;
        set.values[0] = changed;
        parameters_apply(&drive.parameters, set.values);
        for (unsigned i = 0; i < 2 * SET_WORDS && drive.store.saving == NVM_STORE_SAVING; i++) {
            nvm_store_step(&drive.store, &copy.hal, &drive.parameters, 1, true);
        }
        ASSERT_EQ(drive.store.saving, NVM_STORE_SAVED);
        start_drive(&drive, &copy);
        EXPECT_TRUE(drive.store.loaded);
        EXPECT_EQ(drive.parameters.values[0], changed) << steps;
        for (unsigned i = 1; i < PARAMETER_COUNT; i++) {
            EXPECT_EQ(drive.parameters.values[i], set_value(&drive.parameters, 1, i));
        }
    }
}

TEST_F(NvmStore, each_save_of_one_start_is_stored) {
    for (uint32_t number = 1; number <= 3; number++) {
        parameters_t set = drive.parameters;
        for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
            set.values[i] = set_value(&drive.parameters, number, i);
        }
        parameters_apply(&drive.parameters, set.values);
        parameter_store_save(&drive.store);
        for (unsigned i = 0; i < 2 * SET_WORDS; i++) {
            nvm_store_step(&drive.store, &memory.hal, &drive.parameters, 1, true);
        }
        EXPECT_EQ(drive.store.saving, NVM_STORE_SAVED);
        memory_t copy = memory;
        started_t next;
        start_drive(&next, &copy);
        EXPECT_TRUE(has_set(&next, number)) << number;
    }
}

TEST_F(NvmStore, a_word_that_cannot_be_programmed_is_passed_over) {
    memory.hal.nvm.word[PARAMETER_PAGE][5] = 0; // in the middle of the first place
    memory.hal.nvm.word[PARAMETER_PAGE][SET_WORDS + 5] = 0;
    write(WRITE_SET);
    EXPECT_TRUE(has_set(&drive, 1));
}

TEST_F(NvmStore, failures_that_one_record_has_survived_do_not_count_for_the_next) {
    for (unsigned save = 1; save <= 3 * SETS_PER_PAGE; save++) {
        memory.hal.erase_errors = NVM_RING_ATTEMPTS - 1;
        parameter_store_save(&drive.store);
        while (drive.store.saving == NVM_STORE_SAVING) {
            nvm_store_step(&drive.store, &memory.hal, &drive.parameters, 1, true);
        }
        ASSERT_EQ(drive.store.saving, NVM_STORE_SAVED) << save;
        ASSERT_EQ(drive.store.parameters.sequence, save);
    }
}

TEST_F(NvmStore, a_record_that_was_given_up_leaves_the_next_one_all_its_attempts) {
    const auto save = [this](uint32_t errors) {
        memory.hal.erase_errors = errors;
        parameter_store_save(&drive.store);
        while (drive.store.saving == NVM_STORE_SAVING) {
            nvm_store_step(&drive.store, &memory.hal, &drive.parameters, 1, true);
        }
        return drive.store.saving;
    };
    unsigned given_up = 0;
    for (unsigned saves = 0; saves < 3 * SETS_PER_PAGE; saves++) {
        if (save(NVM_RING_ATTEMPTS) == NVM_STORE_FAILED) {
            given_up++;
            ASSERT_EQ(save(NVM_RING_ATTEMPTS - 1), NVM_STORE_SAVED) << saves;
        }
    }
    EXPECT_GE(given_up, 2u);
}

TEST_F(NvmStore, a_word_that_the_memory_only_says_to_have_programmed_is_read_back_and_passed_over) {
    write(WRITE_SET);
    for (unsigned word = 0; word < SET_WORDS; word++) {
        memory_t copy = memory;
        copy.hal.deaf_word = &copy.hal.nvm.word[PARAMETER_PAGE][SET_WORDS + word];
        write_next(&drive, &copy, WRITE_SET, 0, NVM_CUT_OLD);
        EXPECT_EQ(drive.store.saving, NVM_STORE_SAVED) << word;
        start_drive(&drive, &copy);
        EXPECT_TRUE(has_set(&drive, 1 + copy.sets)) << word << ": what is said to be stored is there";
    }
}

// [SR-58]
TEST_F(NvmStore, a_set_whose_commit_word_is_torn_is_loaded_and_stored_once_more_at_the_start) {
    write(WRITE_SET);
    *set_word(0, SET_WORDS - 1) ^= 1;
    start_drive(&drive, &memory);
    EXPECT_TRUE(has_set(&drive, 1));
    for (unsigned i = 0; i < SET_WORDS; i++) {
        EXPECT_EQ(drive.store.saving, NVM_STORE_SAVING);
        nvm_store_step(&drive.store, &memory.hal, &drive.parameters, 1, true);
    }
    EXPECT_EQ(drive.store.saving, NVM_STORE_SAVED);
    *set_word(0, SET_WORDS - 1) = HAL_NVM_ERASED; // next time the torn word reads as none
    start_drive(&drive, &memory);
    EXPECT_TRUE(has_set(&drive, 1));
    EXPECT_NE(drive.store.saving, NVM_STORE_SAVING) << "the commit word of this one is whole";
}

// Memory after a power cut at the present instant.
bool starts_with_set(const memory_t &memory, uint32_t set) {
    static memory_t copy;
    started_t drive;
    copy = memory;
    start_drive(&drive, &copy);
    return has_set(&drive, set);
}

TEST_F(NvmStore, saves_that_a_page_of_bad_words_does_not_take_fail_and_cost_no_set_of_the_other_page) {
    for (unsigned i = 0; i < SETS_PER_PAGE; i++) {
        write(WRITE_SET);
    }
    for (const bool zero : {false, true}) {
        memory.hal.worn_page = PARAMETER_PAGE + 1;
        memory.hal.worn_zero = zero;
        for (unsigned save = 0; save < 2 * SETS_PER_PAGE; save++) {
            parameter_store_save(&drive.store);
            while (drive.store.saving == NVM_STORE_SAVING) {
                nvm_store_step(&drive.store, &memory.hal, &drive.parameters, 1, true);
                ASSERT_TRUE(starts_with_set(memory, SETS_PER_PAGE)) << save;
            }
            ASSERT_EQ(drive.store.saving, NVM_STORE_FAILED);
        }
    }
    EXPECT_EQ(memory.hal.nvm.erasures[PARAMETER_PAGE], 0u);
}

// Damaged sets are kept like a valid one: without them the drive would start with its defaults. [SR-58]
TEST_F(NvmStore, saves_that_a_page_of_bad_words_does_not_take_leave_the_start_inhibited_by_damaged_sets) {
    for (unsigned i = 0; i < SETS_PER_PAGE; i++) {
        write(WRITE_SET);
        *set_word(i, 4) ^= 1;
    }
    memory.hal.worn_page = PARAMETER_PAGE + 1;
    start_drive(&drive, &memory);
    ASSERT_TRUE(drive.store.inhibited);
    for (unsigned save = 0; save < 2 * SETS_PER_PAGE; save++) {
        parameter_store_save(&drive.store);
        while (drive.store.saving == NVM_STORE_SAVING) {
            nvm_store_step(&drive.store, &memory.hal, &drive.parameters, 1, true);
        }
        ASSERT_EQ(drive.store.saving, NVM_STORE_FAILED);
    }
    start_drive(&drive, &memory);
    EXPECT_TRUE(drive.store.inhibited);
}

TEST_F(NvmStore, sets_that_change_while_they_are_written_cost_no_set_of_the_other_page) {
    for (unsigned i = 0; i < SETS_PER_PAGE; i++) {
        write(WRITE_SET);
    }
    parameter_store_save(&drive.store);
    const int32_t before = drive.parameters.values[0];
    const int32_t step = before == parameters_row(0)->minimum ? 1 : -1;
    for (unsigned change = 1; change <= 2 * SETS_PER_PAGE + 1; change++) {
        parameters_t set = drive.parameters;
        set.values[0] = before + (change % 2 != 0 ? step : 0);
        parameters_apply(&drive.parameters, set.values);
        for (unsigned i = 0; i < 3; i++) { // the erasure, and words of a record
            nvm_store_step(&drive.store, &memory.hal, &drive.parameters, 1, true);
            ASSERT_TRUE(starts_with_set(memory, SETS_PER_PAGE)) << change;
        }
    }
    EXPECT_EQ(memory.hal.nvm.erasures[PARAMETER_PAGE], 0u);
    while (drive.store.saving == NVM_STORE_SAVING) {
        nvm_store_step(&drive.store, &memory.hal, &drive.parameters, 1, true);
    }
    EXPECT_EQ(drive.store.saving, NVM_STORE_SAVED);
    start_drive(&drive, &memory);
    EXPECT_TRUE(drive.store.loaded);
    EXPECT_EQ(drive.parameters.values[0], before + step);
}

// [SR-60]
TEST_F(NvmStore, a_fault_is_logged_once_and_the_same_fault_after_a_clearing_again) {
    fault_record_t record = fault_of(1);
    for (unsigned i = 0; i < 10; i++) {
        nvm_store_follow_fault(&drive.store, &record);
    }
    EXPECT_EQ(drive.store.waiting_count, 1);
    nvm_store_follow_fault(&drive.store, nullptr);
    nvm_store_follow_fault(&drive.store, &record);
    EXPECT_EQ(drive.store.waiting_count, 2);
    nvm_store_follow_fault(&drive.store, nullptr);
    nvm_store_follow_fault(&drive.store, &record); // a third one has no place
    EXPECT_EQ(drive.store.waiting_count, 2);
}

// [SR-60]
TEST_F(NvmStore, a_fault_that_the_memory_does_not_take_is_given_up_after_its_attempts_and_holds_up_nothing) {
    memory.hal.worn_page = FAULT_PAGE;
    const fault_record_t record = fault_of(1);
    nvm_store_follow_fault(&drive.store, &record);
    parameter_store_save(&drive.store);
    for (unsigned attempt = 1; attempt <= NVM_RING_ATTEMPTS; attempt++) {
        EXPECT_EQ(drive.store.waiting_count, 1) << attempt;
        nvm_store_step(&drive.store, &memory.hal, &drive.parameters, record.time_us, true);
    }
    EXPECT_EQ(drive.store.waiting_count, 0);
    EXPECT_EQ(nvm_store_newest_fault(&drive.store), 0u);
    for (unsigned word = 0; word < SET_WORDS; word++) {
        EXPECT_EQ(drive.store.saving, NVM_STORE_SAVING) << word;
        nvm_store_step(&drive.store, &memory.hal, &drive.parameters, record.time_us, true);
    }
    EXPECT_EQ(drive.store.saving, NVM_STORE_SAVED);
}

// [SR-60]
TEST_F(NvmStore, two_faults_that_wait_are_both_logged_in_their_order) {
    for (const uint32_t number : {1u, 2u}) {
        const fault_record_t record = fault_of(number);
        nvm_store_follow_fault(&drive.store, &record);
    }
    for (uint32_t i = 0; i < 2 * FAULT_WORDS; i++) {
        nvm_store_step(&drive.store, &memory.hal, &drive.parameters, fault_of(2).time_us + i, true);
    }
    for (const uint32_t number : {1u, 2u}) {
        nvm_store_fault_t logged;
        ASSERT_TRUE(nvm_store_read_fault(&drive.store, &memory.hal, number, &logged)) << number;
        EXPECT_EQ(logged.time_us, fault_of(number).time_us);
        EXPECT_EQ(logged.speed_q22, fault_of(number).speed_q22);
    }
}

// [SR-60]
TEST_F(NvmStore, the_time_of_a_fault_counts_the_wraps_of_the_clock) {
    nvm_store_step(&drive.store, &memory.hal, &drive.parameters, UINT32_MAX - 100, false);
    nvm_store_step(&drive.store, &memory.hal, &drive.parameters, 10, false);
    nvm_store_step(&drive.store, &memory.hal, &drive.parameters, UINT32_MAX - 10, false);
    fault_record_t record = fault_of(1);
    record.time_us = UINT32_MAX - 5;
    nvm_store_follow_fault(&drive.store, &record);
    record.time_us = 3; // after the last step the clock has wrapped
    nvm_store_follow_fault(&drive.store, &record);
    EXPECT_EQ(drive.store.waiting[0].time_wraps, 1);
    EXPECT_EQ(drive.store.waiting[1].time_wraps, 2);
}

// [SR-60]
TEST_F(NvmStore, a_fault_of_before_the_last_step_has_not_wrapped_and_the_wraps_end_at_their_largest_number) {
    nvm_store_step(&drive.store, &memory.hal, &drive.parameters, 5000, false);
    fault_record_t record = fault_of(1);
    record.time_us = 4000;
    nvm_store_follow_fault(&drive.store, &record);
    EXPECT_EQ(drive.store.waiting[0].time_us, 4000u);
    EXPECT_EQ(drive.store.waiting[0].time_wraps, 0);
    drive.store.time_wraps = UINT16_MAX - 1; // some 9 years
    for (int wrap = 0; wrap < 3; wrap++) {
        nvm_store_step(&drive.store, &memory.hal, &drive.parameters, UINT32_MAX - 10, false);
        nvm_store_step(&drive.store, &memory.hal, &drive.parameters, 10, false);
        EXPECT_EQ(drive.store.time_wraps, UINT16_MAX);
    }
}

// [SR-60]
TEST_F(NvmStore, a_logged_fault_that_has_changed_in_the_memory_is_not_read_and_the_others_are) {
    for (int k = 0; k < 3; k++) {
        write(WRITE_FAULT);
    }
    uint64_t *words = memory.hal.nvm.word[FAULT_PAGE];
    const uint64_t before = words[FAULT_WORDS + 1]; // of the second record
    words[FAULT_WORDS + 1] ^= UINT64_C(1) << 17;
    EXPECT_TRUE(has_fault(&drive, &memory.hal, 1));
    nvm_store_fault_t read{};
    EXPECT_FALSE(nvm_store_read_fault(&drive.store, &memory.hal, 2, &read));
    EXPECT_TRUE(has_fault(&drive, &memory.hal, 3));
    words[FAULT_WORDS + 1] = before;
    EXPECT_TRUE(has_fault(&drive, &memory.hal, 2));
}

} // namespace
