// Checks that the drive makes of itself: every one passes, and every change of what it looks at makes it fail in time.
// [SR-50]
#include <algorithm>
#include <array>
#include <cstring>
#include <numeric>
#include <random>
#include <vector>

#include <gtest/gtest.h>

extern "C" {
#include "fixed/crc32.h"
#include "hal_time.h"
#include "interrupts/self_test.h"
#include "storage/fault.h"
}

#include "support/flipped_bits.h"

struct hal {
    hal_memory_t memory{};
    bool registers_intact = true;
    uint32_t time_us = 0;
    uint32_t reference_us = 77;
    uint32_t interrupted_us = 0; // by interrupts, before the next critical section
    bool masked = false;
};

extern "C" {
void hal_memory(const hal_t *hal, hal_memory_t *memory) {
    *memory = hal->memory;
}
bool hal_registers_intact(const hal_t *hal) {
    return hal->registers_intact;
}
uint32_t hal_time_reference_us(const hal_t *hal) {
    return hal->reference_us;
}
uint32_t hal_time_us(const hal_t *hal) {
    EXPECT_TRUE(hal->masked);
    return hal->time_us;
}
void hal_critical_enter(hal_t *hal) {
    hal->masked = true;
    hal->time_us += hal->interrupted_us;
    hal->reference_us += hal->interrupted_us;
    hal->interrupted_us = 0;
}
void hal_critical_leave(hal_t *hal) {
    hal->masked = false;
}
}

namespace {

constexpr uint32_t PERIOD_US = 25;

class SelfTest : public testing::Test {
  protected:
    void SetUp() override {
        std::mt19937 random(1);
        for (uint32_t &word : code) {
            word = random();
        }
        stack.fill(HAL_STACK_UNUSED);
        std::fill(stack.begin() + 700, stack.end(), 5u);
        hal.memory = {.code = code.data(),
                      .code_words = uint32_t(code.size()),
                      .code_crc = crc32_continue(0, code.data(), sizeof code),
                      .stack = stack.data(),
                      .stack_words = uint32_t(stack.size())};
        std::vector<uint32_t> words(sizeof constants / 4);
        for (uint32_t &word : words) {
            word = random();
        }
        std::memcpy(static_cast<void *>(&constants), words.data(), sizeof constants);
        begin();
    }

    void begin() {
        parameters_init(&parameters);
        self_test_init(&test, &hal, time_us);
        self_test_configured(&test, &constants);
    }

    void step() {
        hal.time_us = time_us;
        self_test_step(&test, &hal, &constants, &parameters, time_us);
    }

    // Calls until a check fails, `limit_us` at most; the time of the last one since the first.
    uint32_t run(uint32_t limit_us, double reference_rate = 1.0) {
        const uint32_t begin_us = time_us, reference_us = hal.reference_us;
        while (test.failed == 0 && time_us - begin_us < limit_us) {
            time_us += PERIOD_US;
            hal.reference_us = reference_us + uint32_t((time_us - begin_us) * reference_rate);
            step();
        }
        return time_us - begin_us;
    }

    hal_t hal;
    std::array<uint32_t, 3001> code{};
    std::array<uint32_t, 1000> stack{};
    control_parameters_t constants{};
    parameters_t parameters{};
    self_test_t test{};
    uint32_t time_us = UINT32_MAX - 1000000; // the clock wraps meanwhile
};

// [SR-54]
TEST_F(SelfTest, passes_and_counts_its_passes_over_the_code_and_the_words_of_stack_that_were_never_used) {
    run(4000000);
    EXPECT_EQ(test.failed, 0u);
    EXPECT_EQ(self_test_faults(&test), 0u);
    EXPECT_EQ(test.code_passes, 5u); // 3001 words, four in a millisecond
    EXPECT_EQ(test.stack_unused, 700u);
}

// [SR-49]
TEST_F(SelfTest, every_bit_of_every_limit_fails_in_the_next_call) {
    auto *bytes = reinterpret_cast<uint8_t *>(&constants.protection);
    for (unsigned bit = 0; bit < 8 * sizeof constants.protection; bit++) {
        begin();
        bytes[bit / 8] ^= uint8_t(1u << bit % 8);
        EXPECT_EQ(run(1000000), PERIOD_US);
        EXPECT_EQ(test.failed & SELF_TEST_LIMITS, SELF_TEST_LIMITS) << bit;
        EXPECT_EQ(self_test_faults(&test), FAULT_BIT(FAULT_MEMORY));
        bytes[bit / 8] ^= uint8_t(1u << bit % 8);
    }
}

TEST_F(SelfTest, every_bit_of_the_constants_fails_within_two_passes) {
    auto *bytes = reinterpret_cast<uint8_t *>(&constants);
    const uint32_t pass_us = PERIOD_US * uint32_t(sizeof constants / 4 / 16 + 1);
    for (unsigned bit = 0; bit < 8 * sizeof constants; bit++) {
        begin();
        run((bit % 7) * PERIOD_US);
        bytes[bit / 8] ^= uint8_t(1u << bit % 8);
        EXPECT_LE(run(1000000), 2 * pass_us) << bit;
        EXPECT_NE(test.failed & (SELF_TEST_CONSTANTS | SELF_TEST_LIMITS), 0u) << bit;
        bytes[bit / 8] ^= uint8_t(1u << bit % 8);
    }
    EXPECT_LT(2 * pass_us, 2000u);
}

// [SR-57]
TEST_F(SelfTest, every_bit_of_the_parameters_fails_within_a_millisecond) {
    begin();
    const parameters_t right = parameters;
    with_each_bit_flipped(right, [&](const parameters_t &flipped) {
        if (flipped.revision != right.revision) {
            return; // configures the drive once more, from the same values
        }
        begin();
        parameters = flipped;
        EXPECT_LE(run(1000000), SELF_TEST_STEP_US);
        EXPECT_EQ(test.failed, SELF_TEST_PARAMETERS);
        EXPECT_EQ(self_test_faults(&test), FAULT_BIT(FAULT_MEMORY));
    });
}

TEST_F(SelfTest, new_constants_in_the_middle_of_a_pass_are_no_change) {
    for (unsigned k = 0; k < 200; k++) {
        run(PERIOD_US * (k % 13));
        constants.encoder_shift++;
        constants.protection.current_trip_q9++;
        self_test_configured(&test, &constants);
    }
    EXPECT_EQ(test.failed, 0u);
}

// [SR-53]
TEST_F(SelfTest, a_bit_of_the_code_fails_within_two_passes_and_at_the_start_at_once) {
    std::mt19937 random(2);
    for (unsigned k = 0; k < 20; k++) {
        const unsigned word = k == 0 ? 0 : k == 1 ? 3000 : random() % 3001;
        begin();
        run(1000 * (random() % 750));
        code[word] ^= 1u << random() % 32;
        const uint32_t found_us = run(10000000);
        EXPECT_LE(found_us, 1504000u);
        EXPECT_EQ(test.failed, SELF_TEST_CODE);
        EXPECT_EQ(self_test_faults(&test), FAULT_BIT(FAULT_CODE));
        begin();
        EXPECT_EQ(test.failed, SELF_TEST_CODE);
        hal.memory.code_crc = crc32_continue(0, code.data(), sizeof code);
    }
}

// [SR-53]
TEST_F(SelfTest, a_place_beyond_the_last_word_ends_the_pass) {
    for (unsigned bit = 12; bit < 32; bit++) {
        for (const bool code_word : {false, true}) {
            begin();
            run(100000);
            (code_word ? test.crc_word : test.sum_word) ^= UINT32_C(1) << bit;
            EXPECT_LE(run(1000000), 2000u) << bit;
            EXPECT_EQ(test.failed, code_word ? SELF_TEST_CODE : SELF_TEST_CONSTANTS) << bit;
        }
        begin();
        test.stack_word ^= UINT32_C(1) << bit;
        run(2000000);
        EXPECT_EQ(test.stack_unused, 700u) << bit;
        EXPECT_EQ(test.failed, 0u) << bit;
    }
}

// [SR-54]
TEST_F(SelfTest, a_used_guard_word_fails_in_the_next_call) {
    stack[0] = 0;
    EXPECT_EQ(run(1000000), PERIOD_US);
    EXPECT_EQ(test.failed, SELF_TEST_STACK);
    EXPECT_EQ(self_test_faults(&test), FAULT_BIT(FAULT_MEMORY));
}

// [SR-54]
TEST_F(SelfTest, a_changed_register_fails_within_a_millisecond_and_stays_failed) {
    hal.registers_intact = false;
    EXPECT_LE(run(1000000), SELF_TEST_STEP_US);
    EXPECT_EQ(test.failed, SELF_TEST_REGISTERS);
    hal.registers_intact = true;
    time_us += 2000;
    step();
    EXPECT_EQ(self_test_faults(&test), FAULT_BIT(FAULT_MEMORY));
}

// [SR-55]
TEST_F(SelfTest, clocks_that_differ_by_more_than_5_percent_fail_within_two_intervals_and_others_do_not) {
    for (const double rate : {0.0, 0.5, 0.93, 0.945, 1.055, 1.07, 2.0}) {
        begin();
        EXPECT_LE(run(1000000, rate), 2 * (SELF_TEST_CLOCK_US + SELF_TEST_STEP_US)) << rate;
        EXPECT_EQ(test.failed, SELF_TEST_CLOCK) << rate;
        EXPECT_EQ(self_test_faults(&test), FAULT_BIT(FAULT_CLOCK));
    }
    for (const double rate : {0.955, 0.99, 1.01, 1.045}) {
        begin();
        EXPECT_EQ(run(1000000, rate), 1000000u) << rate;
    }
}

// [SR-55]
TEST_F(SelfTest, the_clocks_may_differ_by_exactly_5_percent_of_the_interval_and_by_no_microsecond_more) {
    const uint32_t tolerance_us = SELF_TEST_CLOCK_US / 20;
    const struct {
        int32_t ahead_us;
        bool right;
    } cases[] = {
        {0, true},
        {int32_t(tolerance_us), true},
        {int32_t(tolerance_us) + 1, false},
        {-int32_t(tolerance_us), true},
        {-int32_t(tolerance_us) - 1, false},
    };
    for (const auto &each : cases) {
        begin();
        time_us += SELF_TEST_CLOCK_US;
        hal.reference_us += SELF_TEST_CLOCK_US + uint32_t(each.ahead_us);
        step();
        EXPECT_EQ(test.failed, each.right ? 0u : SELF_TEST_CLOCK) << each.ahead_us;
    }
}

// [SR-55]
TEST_F(SelfTest, the_clock_passes_again_when_it_is_right) {
    begin();
    run(1000000, 1.1);
    ASSERT_EQ(test.failed, SELF_TEST_CLOCK);
    for (unsigned k = 0; k < 1000; k++) {
        hal.reference_us += PERIOD_US;
        time_us += PERIOD_US;
        step();
    }
    EXPECT_EQ(test.failed, 0u);
}

// [SR-55]
TEST_F(SelfTest, the_clock_passes_when_interrupts_hold_the_background_between_the_pass_and_its_reading) {
    begin();
    for (unsigned k = 0; k < 10000; k++) {
        time_us += PERIOD_US;
        hal.reference_us += PERIOD_US;
        hal.interrupted_us = k % 3 == 0 ? 3000 : 0;
        const uint32_t held_us = hal.interrupted_us;
        step();
        time_us += held_us - hal.interrupted_us;
        EXPECT_EQ(test.failed, 0u);
    }
}

// [SR-53]
TEST_F(SelfTest, a_port_without_code_and_stack_passes) {
    hal.memory = {};
    begin();
    run(1000000);
    EXPECT_EQ(test.failed, 0u);
    EXPECT_EQ(test.code_passes, 0u);
}

// [SR-51]
TEST_F(SelfTest, a_latch_is_intact_only_when_number_mask_and_state_agree) {
    control_state_t control{};
    state_machine_t &machine = control.state_machine;
    state_machine_reset(&machine);
    std::fill_n(control.duty_q15, HAL_PHASES_MAX, -32768);
    EXPECT_TRUE(self_test_latch_intact(&control));
    for (const drive_state_t state : {DRIVE_STATE_READY, DRIVE_STATE_RUN}) {
        machine.state = state;
        EXPECT_TRUE(self_test_latch_intact(&control));
    }
    machine.state = DRIVE_STATE_FAULT;
    EXPECT_FALSE(self_test_latch_intact(&control));
    machine.state = DRIVE_STATE_READY;
    state_machine_start_in_fault(&machine, FAULT_BIT(FAULT_ENCODER) | FAULT_BIT(FAULT_STALL));
    EXPECT_TRUE(self_test_latch_intact(&control));
    for (unsigned bit = 0; bit < 5; bit++) {
        machine.record.fault = fault_t(unsigned(machine.record.fault) ^ 1u << bit);
        EXPECT_FALSE(self_test_latch_intact(&control)) << bit;
        machine.record.fault = FAULT_ENCODER;
    }
    for (const drive_state_t state : {DRIVE_STATE_INITIALISE, DRIVE_STATE_READY, DRIVE_STATE_RUN}) {
        machine.state = state;
        EXPECT_FALSE(self_test_latch_intact(&control));
    }
}

// [SR-51]
TEST_F(SelfTest, duties_outside_of_a_run_are_those_of_a_changed_state) {
    control_state_t control{};
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        for (const int32_t duty_q15 : {-32767, 0, 32768}) {
            state_machine_reset(&control.state_machine);
            std::fill_n(control.duty_q15, HAL_PHASES_MAX, -32768);
            control.duty_q15[phase] = duty_q15;
            for (const drive_state_t state : {DRIVE_STATE_INITIALISE, DRIVE_STATE_READY}) {
                control.state_machine.state = state;
                EXPECT_FALSE(self_test_latch_intact(&control)) << phase;
            }
            control.state_machine.state = DRIVE_STATE_RUN;
            EXPECT_TRUE(self_test_latch_intact(&control)) << phase;
            state_machine_start_in_fault(&control.state_machine, FAULT_BIT(FAULT_ENCODER));
            EXPECT_FALSE(self_test_latch_intact(&control)) << phase;
        }
    }
}

} // namespace
