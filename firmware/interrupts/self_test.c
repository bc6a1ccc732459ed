#include "interrupts/self_test.h"

#include <assert.h>
#include <stdbool.h>

#include "control/modulator.h"
#include "fixed/compiler.h"
#include "fixed/crc32.h"
#include "hal_time.h"
#include "storage/fault.h"

#define CONSTANTS_WORDS (sizeof(control_parameters_t) / sizeof(uint32_t))
#define CONSTANTS_SLICE 16u
#define CODE_SLICE 4u
#define STACK_SLICE 8u
#define CLOCK_TOLERANCE 20u /* a part of the interval: 5 % */

static_assert(sizeof(protection_parameters_t) % sizeof(uint32_t) == 0, "whole words");
static_assert(sizeof(control_parameters_t) % sizeof(uint32_t) == 0, "whole words");

/* A word of an object of any type. */
typedef uint32_t MAY_ALIAS any_word_t;

/* Different after a change of any one word. */
static uint32_t add(uint32_t sum, uint32_t word) {
    return (sum << 1 | sum >> 31) + word;
}

static inline uint32_t word(const void *object, unsigned index) {
    return ((const any_word_t *)object)[index];
}

/* [SR-53] */
COLD void self_test_init(self_test_t *test, const hal_t *hal, uint32_t time_us) {
    *test = (self_test_t){
        .step_us = time_us,
        .clock_us = time_us,
        .clock_reference_us = hal_time_reference_us(hal),
    };
    hal_memory_t memory;
    hal_memory(hal, &memory);
    if (crc32_continue(0, memory.code, memory.code_words * sizeof(uint32_t)) != memory.code_crc) {
        test->failed = SELF_TEST_CODE;
    }
}

COLD void self_test_configured(self_test_t *test, const control_parameters_t *parameters) {
    uint32_t sum = 0;
    for (unsigned i = 0; i < CONSTANTS_WORDS; i++) {
        sum = add(sum, word(parameters, i));
    }
    test->constants_sum = sum;
    test->sum = test->sum_word = 0;
    for (unsigned i = 0; i < SELF_TEST_LIMIT_WORDS; i++) {
        test->limit_complement[i] = ~word(&parameters->protection, i);
    }
}

/* A run that ends takes its duties back in the same interrupt. [SR-51] */
static bool has_duties(const control_state_t *control) {
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        if (control->duty_q15[phase] != -MODULATOR_DUTY_ONE_Q15) {
            return true;
        }
    }
    return false;
}

/* [SR-51] */
COLD bool self_test_latch_intact(const control_state_t *control) {
    const drive_state_t state = control->state_machine.state;
    const fault_record_t *record = &control->state_machine.record;
    return record->fault == state_machine_first_fault(record->fault_mask) &&
           (record->fault != FAULT_NONE) == (state == DRIVE_STATE_FAULT) && state < DRIVE_STATE_COUNT &&
           (state == DRIVE_STATE_RUN || !has_duties(control));
}

/* [SR-50] */
static void check_constants(self_test_t *test, const control_parameters_t *parameters) {
    for (unsigned i = 0; i < CONSTANTS_SLICE && test->sum_word < CONSTANTS_WORDS; i++) {
        test->sum = add(test->sum, word(parameters, test->sum_word++));
    }
    if (test->sum_word >= CONSTANTS_WORDS) {
        test->failed |= test->sum != test->constants_sum ? SELF_TEST_CONSTANTS : 0u;
        test->sum = test->sum_word = 0;
    }
}

/* No pass comes to a word beyond the last one, as below to one beyond the stack: its number has changed in memory.
 * [SR-53] */
static void check_code(self_test_t *test, const hal_memory_t *memory) {
    for (unsigned i = 0; i < CODE_SLICE && test->crc_word < memory->code_words; i++) {
        test->crc = crc32_continue(test->crc, &memory->code[test->crc_word++], sizeof(uint32_t));
    }
    if (memory->code_words > 0 && test->crc_word >= memory->code_words) {
        test->failed |= test->crc != memory->code_crc ? SELF_TEST_CODE : 0u;
        test->code_passes++;
        test->crc = test->crc_word = 0;
    }
}

/* The first used word ends a pass. [SR-54] */
static void follow_stack(self_test_t *test, const hal_memory_t *memory) {
    for (unsigned i = 0; i < STACK_SLICE; i++) {
        if (test->stack_word >= memory->stack_words || memory->stack[test->stack_word] != HAL_STACK_UNUSED) {
            test->stack_unused = test->stack_word;
            test->stack_word = 0;
            return;
        }
        test->stack_word++;
    }
}

/* Both clocks at one instant: interrupts may have held this pass of the background for longer than the tolerance.
 * [SR-55] */
static void check_clock(self_test_t *test, hal_t *hal, uint32_t pass_us) {
    if (pass_us - test->clock_us < SELF_TEST_CLOCK_US) {
        return;
    }
    hal_critical_enter(hal);
    const uint32_t time_us = hal_time_us(hal);
    const uint32_t reference_us = hal_time_reference_us(hal);
    hal_critical_leave(hal);
    const uint32_t passed_us = time_us - test->clock_us;
    const uint32_t tolerance_us = passed_us / CLOCK_TOLERANCE;
    const uint32_t ahead_us = reference_us - test->clock_reference_us - passed_us; /* modulo 2^32 */
    const bool right = ahead_us + tolerance_us <= 2u * tolerance_us;
    test->failed = right ? test->failed & ~SELF_TEST_CLOCK : test->failed | SELF_TEST_CLOCK;
    test->clock_us = time_us;
    test->clock_reference_us = reference_us;
}

/* [SR-49] [SR-50] [SR-53] [SR-54] [SR-55] [SR-57] */
COLD void self_test_step(self_test_t *test, hal_t *hal, const control_parameters_t *constants,
                         const parameters_t *parameters, uint32_t time_us) {
    for (unsigned i = 0; i < SELF_TEST_LIMIT_WORDS; i++) {
        test->failed |= word(&constants->protection, i) != ~test->limit_complement[i] ? SELF_TEST_LIMITS : 0u;
    }
    check_constants(test, constants);
    hal_memory_t memory;
    hal_memory(hal, &memory);
    if (memory.stack_words > 0 && memory.stack[0] != HAL_STACK_UNUSED) {
        test->failed |= SELF_TEST_STACK;
    }
    if (time_us - test->step_us < SELF_TEST_STEP_US) {
        return;
    }
    test->step_us = time_us;
    if (!parameters_intact(parameters)) {
        test->failed |= SELF_TEST_PARAMETERS;
    }
    if (!hal_registers_intact(hal)) {
        test->failed |= SELF_TEST_REGISTERS;
    }
    check_code(test, &memory);
    follow_stack(test, &memory);
    check_clock(test, hal, time_us);
}

/* [SR-49] [SR-50] [SR-53] [SR-54] [SR-55] */
COLD uint32_t self_test_faults(const self_test_t *test) {
    const uint32_t memory = SELF_TEST_LIMITS | SELF_TEST_CONSTANTS | SELF_TEST_FAULT_LATCH | SELF_TEST_STACK |
                            SELF_TEST_REGISTERS | SELF_TEST_PARAMETERS;
    return ((test->failed & memory) != 0 ? (uint32_t)FAULT_BIT(FAULT_MEMORY) : 0) |
           ((test->failed & SELF_TEST_CODE) != 0 ? (uint32_t)FAULT_BIT(FAULT_CODE) : 0) |
           ((test->failed & SELF_TEST_CLOCK) != 0 ? (uint32_t)FAULT_BIT(FAULT_CLOCK) : 0);
}
