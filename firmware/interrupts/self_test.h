/* Checks of the drive itself, in slices in the background:
 *
 *   limits       each limit of protection.h against its complement, in every call
 *   constants    all constants of the control laws and monitors against the sum that they had when they were
 *                configured, in 20 calls
 *   fault latch  number, mask and state of the latched fault, which contradict each other when one has changed, and
 *                duties outside of a run, which a changed state has ended, in every call
 *   parameters   the parameters in effect against their sum, each SELF_TEST_STEP_US
 *   stack        the guard word at its end, in every call; how much of it has never been used, in a second
 *   registers    the port's, each SELF_TEST_STEP_US
 *   code         the CRC of the program, as a whole at the start and then four words each SELF_TEST_STEP_US
 *   clock        time against the second clock over SELF_TEST_CLOCK_US, within 5 %
 *
 * What has failed stays so until a reset, but for the clock. What a port does not have (hal_memory.h) is not checked.
 */
#ifndef INTERRUPTS_SELF_TEST_H
#define INTERRUPTS_SELF_TEST_H

#include <stdint.h>

#include "hal_memory.h"
#include "interrupts/control_step.h"
#include "interrupts/state_machine.h"
#include "monitors/protection.h"
#include "storage/parameters.h"

#define SELF_TEST_STEP_US 1000u
#define SELF_TEST_CLOCK_US 10000u

/* Checks: bits of DRIVE_SELF_TEST, from SELF_TEST_TELEMETRY_BIT on. */
#define SELF_TEST_LIMITS 1u
#define SELF_TEST_CONSTANTS 2u
#define SELF_TEST_FAULT_LATCH 4u
#define SELF_TEST_STACK 8u
#define SELF_TEST_REGISTERS 16u
#define SELF_TEST_CODE 32u
#define SELF_TEST_CLOCK 64u
#define SELF_TEST_PARAMETERS 128u
#define SELF_TEST_TELEMETRY_BIT 8

#define SELF_TEST_LIMIT_WORDS (sizeof(protection_parameters_t) / sizeof(uint32_t))

typedef struct {
    uint32_t failed; /* SELF_TEST_* */
    uint32_t limit_complement[SELF_TEST_LIMIT_WORDS];
    uint32_t constants_sum;
    uint32_t sum, sum_word; /* of the present pass over the constants */
    uint32_t step_us;
    uint32_t crc, crc_word;                /* of the present pass over the code */
    uint32_t code_passes;                  /* complete ones */
    uint32_t stack_word;                   /* of the present pass over the stack */
    uint32_t stack_unused;                 /* words, by the last complete pass */
    uint32_t clock_us, clock_reference_us; /* start of the present interval */
} self_test_t;

/* Checks the code as a whole. [background, at the start] */
void self_test_init(self_test_t *test, const hal_t *hal, uint32_t time_us);

/* Takes the copies of new constants. [background] */
void self_test_configured(self_test_t *test, const control_parameters_t *parameters);

/* False when number, mask and state of the latched fault contradict each other, a state other than run the duties, or
 * when the state has no name.
 * [background, in a critical section] */
bool self_test_latch_intact(const control_state_t *control);

/* The checks that are due; masks the interrupts while it reads both clocks. [background] */
void self_test_step(self_test_t *test, hal_t *hal, const control_parameters_t *constants,
                    const parameters_t *parameters, uint32_t time_us);

/* Fault mask. */
uint32_t self_test_faults(const self_test_t *test);

#endif
