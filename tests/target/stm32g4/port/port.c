/* The port on the part, without the drive: every function of the HAL against its contract, with time for instructions,
 * conversions and memory. The processor checks itself and ends at the first check that fails, with its line.
 *
 * Runs of the program, each ended by a reset: one while a word of the memory is programmed, which tears it; the
 * watchdog's after a double error in the program has halted it; one by software; the watchdog's after its last kick.
 */
#include "../stimulus.h"
#include "check.h"
#include "hal_adc.h"
#include "hal_encoder.h"
#include "hal_interrupt.h"
#include "hal_memory.h"
#include "hal_nvm.h"
#include "hal_pwm.h"
#include "hal_random.h"
#include "hal_time.h"
#include "hal_watchdog.h"

#define MAGIC 0x5A17E57u
#define TORN_PAGE 4
#define TORN_WORD 9

enum { FIRST, TORN, HALTED_BY_ERROR, BY_SOFTWARE, LAST };

static const volatile uint64_t torn_constant[1] = {1};

const uint16_t board_trip_counts = 3001;
const uint8_t board_encoder_bits = 12;
const uint32_t board_control_rate_hz = 40000;

volatile mode_t mode;
volatile uint32_t periods, wanted, written_start, missed, resumed;
volatile uint32_t deferred_calls, pre_empted, can_pre_empted;
volatile bool sweep_done, masked;

void leave(int code) {
    if (code) {
        stimulus_number((uint32_t)code); /* a process has but 8 bits for it */
        code = 1;
    }
    register int result __asm__("r0") = code;
    __asm__ volatile("cpsid i\n bkpt 0" ::"r"(result));
    for (;;) {
    }
}

extern hal_t board;

void wait_periods(uint32_t count) {
    for (const uint32_t from = periods; periods - from < count;) {
        hal_watchdog_kick(&board);
        __asm__ volatile("wfi");
    }
}

static void first_inputs(void) {
    /* Codes of the inputs: currents, DC link, torque, temperatures of windings and switches, each another one. */
    static const struct {
        uint8_t pin;
        uint16_t code;
    } inputs[] = {
        {PIN(PORT_A, 0), 101},  {PIN(PORT_A, 7), 202},  {PIN(PORT_B, 0), 303},   {PIN(PORT_B, 14), 404},
        {PIN(PORT_A, 8), 2505}, {PIN(PORT_A, 9), 2048}, {PIN(PORT_A, 1), 1111},  {PIN(PORT_A, 4), 1222},
        {PIN(PORT_A, 6), 1333}, {PIN(PORT_B, 2), 1444}, {PIN(PORT_B, 11), 1555}, {PIN(PORT_B, 15), 1666},
        {PIN(PORT_C, 4), 1777}, {PIN(PORT_C, 5), 1888},
    };
    for (unsigned i = 0; i < sizeof inputs / sizeof inputs[0]; i++) {
        bench_code(inputs[i].pin, inputs[i].code);
    }
    const uint8_t high[] = {PIN(PORT_B, 12), PIN(PORT_B, 13), PIN(PORT_C, 10), PIN(PORT_B, 10), PIN(PORT_B, 7)};
    for (unsigned i = 0; i < sizeof high; i++) {
        bench_level(high[i], 1);
    }
}

bool drive_init(drive_t *drive, hal_t *hal, const drive_config_t *config) {
    (void)drive;
    WORD(0xE000EDFCu) = 1u << 24; /* the cycle counter */
    WORD(0xE0001000u) = 1;
    first_inputs();
    CHECK(config->control_rate_hz == board_control_rate_hz);
    CHECK(hal_pwm_clock_hz(hal) == BOARD_CLOCK_MHZ * 1000000u);
    CHECK(GATES_NOW == 0);
    if (KEPT->magic != MAGIC) {
        KEPT->magic = MAGIC;
        KEPT->stage = FIRST;
    }
    const bool by_watchdog = KEPT->stage == HALTED_BY_ERROR || KEPT->stage == LAST;
    CHECK(hal_reset_cause(hal) == (by_watchdog ? HAL_RESET_WATCHDOG : HAL_RESET_POWER));
    if (KEPT->stage == TORN) { /* the word that the reset has torn: the read returns, whatever it reads */
        (void)hal_nvm_read(hal, TORN_PAGE, TORN_WORD);
        CHECK(WORD(0x40022018u) >> 31 == 0); /* FLASH_ECCR: the next one is seen, too */
        CHECK(hal_nvm_read(hal, TORN_PAGE, TORN_WORD + 1u) == HAL_NVM_ERASED);
        CHECK(hal_nvm_erase(hal, TORN_PAGE));
        CHECK(hal_nvm_read(hal, TORN_PAGE, TORN_WORD) == HAL_NVM_ERASED);
    }
    if (KEPT->stage == HALTED_BY_ERROR) {
        KEPT->stage = BY_SOFTWARE;
        WORD(0xE000ED0Cu) = 0x05FA0004u;
        for (;;) {
        }
    }
    if (KEPT->stage == LAST) {
        CHECK(KEPT->since_kick_us > 16700 && KEPT->since_kick_us < 19600);
        leave(0);
    }
    hal_watchdog_start(hal);
    hal_pwm_start(hal, (uint16_t)PERIOD_TICKS);
    for (const uint32_t from = CYCLES; CYCLES - from < PERIOD_CYCLES * 3u / 2u;) { /* a trigger comes meanwhile */
        CHECK(GATES_NOW == 0);
    }
    return true;
}

/* A word is being programmed when the control interrupt comes. */
static void tear(hal_t *hal) {
    mode = TEAR;
    KEPT->stage = TORN;
    hal_watchdog_kick(hal);
    for (unsigned word = TORN_WORD; word < HAL_NVM_PAGE_WORDS; word++) {
        (void)hal_nvm_program(hal, TORN_PAGE, word, UINT64_C(0x0123456789ABCDEF));
    }
    CHECK(false);
}

/* A word of the program is torn: the switches open, and the watchdog resets. */
static void double_error(hal_t *hal) {
    wanted = PERIOD_TICKS;
    mode = FIXED;
    wait_periods(4);
    CHECK(GATES_NOW == GATES);
    hal_watchdog_kick(hal);
    KEPT->stage = HALTED_BY_ERROR;
    bench_tear((uint32_t)(uintptr_t)torn_constant);
    mode = CLOSED_NO_MORE;
    (void)torn_constant[0];
    CHECK(false);
}

/* Words of the memory are no kick. */
static void last_kick(hal_t *hal) {
    KEPT->stage = LAST;
    hal_watchdog_kick(hal);
    const uint32_t from_us = hal_time_us(hal);
    for (unsigned word = 0;; word++) {
        CHECK(word >= HAL_NVM_PAGE_WORDS || hal_nvm_program(hal, TORN_PAGE, word, word));
        KEPT->since_kick_us = hal_time_us(hal) - from_us;
        CHECK(KEPT->since_kick_us < 40000);
    }
}

void drive_background(drive_t *drive, hal_t *hal) {
    (void)drive;
    hal_memory_t memory;
    hal_memory(hal, &memory);
    CHECK(memory.code_words > 500 && memory.stack_words > 1000);
    CHECK(hal_random_u32(hal) != hal_random_u32(hal));
    bench_seed_error();
    CHECK(hal_random_u32(hal) != STALE_WORD);
    hal_watchdog_kick(hal);
    if (KEPT->stage == FIRST) {
        check_pwm(hal);
        hal_watchdog_kick(hal);
        check_samples(hal);
        hal_watchdog_kick(hal);
        check_interrupts(hal);
        hal_watchdog_kick(hal);
        check_bus(hal);
        hal_watchdog_kick(hal);
        check_breaks(hal);
        hal_watchdog_kick(hal);
        mode = IDLE;
        check_memory(hal);
        check_clocks(hal);
        tear(hal);
    }
    if (KEPT->stage == TORN) {
        double_error(hal);
    }
    last_kick(hal);
}
