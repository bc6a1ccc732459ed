/* Checks by the background: outputs, breaks, samples, interrupts. */
#define CHECK_BASE 2000
#include "check.h"

#include "hal_adc.h"
#include "hal_can.h"
#include "hal_interrupt.h"
#include "hal_memory.h"
#include "hal_pwm.h"

#define BREAK_CYCLES 40u /* without a clock or within 8 samples; the reading of the pins */

static void halt(void) {
    masked = true;
    __asm__ volatile("cpsid i" ::: "memory");
}

static void resume(void) {
    __asm__ volatile("cpsie i\n isb" ::: "memory");
    masked = false;
}

static const uint8_t currents[] = {PIN(PORT_A, 0), PIN(PORT_A, 7), PIN(PORT_B, 0), PIN(PORT_B, 14)};
static const uint8_t first_codes[] = {101, 102, 103, 104};
#define TRIP 3001u

static void wait_cycles(uint32_t cycles) {
    for (const uint32_t from = CYCLES; CYCLES - from < cycles;) {
    }
}

static void closed(uint32_t ticks) {
    wanted = ticks;
    mode = FIXED;
    wait_periods(3);
    if (ticks >= PERIOD_TICKS) {
        CHECK(GATES_NOW == GATES);
    }
}

/* Every compare value at many instants of the period; the edges are compared by the test. Then two halves: open at
 * once, and no value of this period afterwards. */
void check_pwm(hal_t *hal) {
    CHECK(GATES_NOW == 0);
    mode = SWEEP;
    while (!sweep_done) {
        wait_periods(1);
    }
    wait_periods(3);
    CHECK(GATES_NOW == 0);
    closed(PERIOD_TICKS);
    halt();
    wait_cycles(PERIOD_CYCLES / 4u);
    hal_pwm_open_all(hal);
    CHECK(GATES_NOW == 0 && !((WORD(0x40012C44u) | WORD(0x40013444u)) & 0x8000u)); /* MOE */
    const hal_pwm_compare_t all = {{UINT16_MAX, UINT16_MAX, UINT16_MAX, UINT16_MAX},
                                   {UINT16_MAX, UINT16_MAX, UINT16_MAX, UINT16_MAX}};
    const uint32_t ends = written_start + PERIOD_CYCLES;
    if ((int32_t)(ends - CYCLES) > 200) {
        hal_pwm_write(hal, &all);
        CHECK(GATES_NOW == 0);
    }
    resume();
    wait_periods(2);
    CHECK(GATES_NOW == GATES && hal_pwm_break(hal) == 0);
    mode = IDLE;
    wait_periods(2);
    CHECK(GATES_NOW == 0);
    CHECK(hal_registers_intact(hal));
}

/* --- Breaks --- */

/* The switches stay open whatever is written, and the cause stays until it has gone and is cleared. */
static void stays_open(hal_t *hal, uint32_t causes, void (*end)(void)) {
    CHECK(hal_pwm_break(hal) == causes);
    resume();
    wait_periods(3);
    CHECK(GATES_NOW == 0 && hal_pwm_break(hal) == causes);
    mode = IDLE;
    wait_periods(1);
    mode = FIXED;
    wait_periods(3);
    CHECK(GATES_NOW == 0 && hal_pwm_break(hal) == causes);
    mode = IDLE;
    wait_periods(1);
    hal_pwm_open_all(hal);
    if (end) {
        hal_pwm_clear_break(hal);
        CHECK(hal_pwm_break(hal) == causes); /* still there */
        mode = FIXED;
        wait_periods(2);
        CHECK(GATES_NOW == 0);
        mode = IDLE;
        wait_periods(1);
        end();
    }
    CHECK(hal_pwm_break(hal) == causes); /* latched */
    hal_pwm_clear_break(hal);
    CHECK(hal_pwm_break(hal) == 0);
    closed(PERIOD_TICKS);
    mode = IDLE;
    wait_periods(2);
}

static unsigned input;

static void current_falls(void) {
    bench_code(currents[input], first_codes[input]);
}

static void check_over_current(hal_t *hal) {
    for (input = 0; input < sizeof currents; input++) {
        closed(PERIOD_TICKS);
        bench_code(currents[input], TRIP - 2u);
        wait_periods(2);
        CHECK(GATES_NOW == GATES && hal_pwm_break(hal) == 0);
        halt();
        bench_code(currents[input], TRIP + 2u);
        wait_cycles(BREAK_CYCLES);
        CHECK(GATES_NOW == 0);
        stays_open(hal, HAL_PWM_BREAK_OVER_CURRENT, current_falls);
    }
}

/* The AND gate outside of the board. */
static void line(uint32_t pin, uint32_t level) {
    bench_level(pin, level);
    bench_level(PIN(PORT_B, 10), level);
    bench_level(PIN(PORT_B, 7), level);
}

static uint32_t pin_of_line;

static void line_returns(void) {
    line(pin_of_line, 1);
}

static void check_lines(hal_t *hal) {
    static const struct {
        uint8_t pin;
        uint8_t cause;
    } lines[] = {{PIN(PORT_B, 12), HAL_PWM_BREAK_STO_1},
                 {PIN(PORT_B, 13), HAL_PWM_BREAK_STO_2},
                 {PIN(PORT_C, 10), HAL_PWM_BREAK_OVER_CURRENT}};
    for (unsigned i = 0; i < sizeof lines / sizeof lines[0]; i++) {
        for (unsigned pulse = 0; pulse < 2; pulse++) {
            pin_of_line = lines[i].pin;
            closed(PERIOD_TICKS);
            halt();
            line(pin_of_line, 0);
            if (pulse) {
                line(pin_of_line, 1);
            }
            wait_cycles(BREAK_CYCLES);
            CHECK(GATES_NOW == 0);
            stays_open(hal, lines[i].cause, pulse ? 0 : line_returns);
        }
    }
    /* Each break input opens its own timer; a break that no line explains is not cleared silently. */
    static const struct {
        uint8_t pin;
        uint16_t open;
    } breaks[] = {{PIN(PORT_B, 10), GATES_1}, {PIN(PORT_B, 7), GATES_2}};
    for (unsigned i = 0; i < 2; i++) {
        closed(PERIOD_TICKS);
        halt();
        bench_level(breaks[i].pin, 0);
        wait_cycles(BREAK_CYCLES);
        CHECK((GATES_NOW & breaks[i].open) == 0);
        bench_level(breaks[i].pin, 1);
        CHECK(hal_pwm_break(hal) == HAL_PWM_BREAK_OVER_CURRENT);
        resume();
        mode = IDLE;
        wait_periods(2);
        hal_pwm_open_all(hal);
        hal_pwm_clear_break(hal);
        CHECK(hal_pwm_break(hal) == 0);
    }
}

/* Written in period k, the values act in k + 1 and again in k + 2, not in k + 3; nothing else of the firmware runs. */
static void check_not_renewed(hal_t *hal) {
    closed(PERIOD_TICKS);
    halt();
    const uint32_t from = written_start;
    uint32_t passed;
    do {
        passed = CYCLES - from;
        CHECK(passed < 5u * PERIOD_CYCLES);
    } while (GATES_NOW != 0);
    CHECK(passed >= 3u * PERIOD_CYCLES - 20u && passed <= 3u * PERIOD_CYCLES + 60u);
    CHECK(hal_pwm_break(hal) == HAL_PWM_BREAK_NOT_RENEWED);
    stays_open(hal, HAL_PWM_BREAK_NOT_RENEWED, 0);
    /* Open_all renews: no break while it alone is called. */
    mode = IDLE;
    wait_periods(6);
    CHECK(hal_pwm_break(hal) == 0);
}

void check_breaks(hal_t *hal) {
    for (input = 0; input < sizeof currents; input++) {
        current_falls();
    }
    check_over_current(hal);
    check_lines(hal);
    check_not_renewed(hal);
    CHECK(hal_registers_intact(hal));
}

/* --- Samples --- */

static const uint8_t inputs[] = {PIN(PORT_A, 0),  PIN(PORT_A, 7), PIN(PORT_B, 0),
                                 PIN(PORT_B, 14), PIN(PORT_A, 8), PIN(PORT_A, 9)};

static uint32_t counts_of(const hal_adc_sample_t *sample, unsigned i) {
    return i < 4 ? sample->phase_current_counts[i] : i == 4 ? sample->bus_voltage_counts : sample->load_torque_counts;
}

/* An input changes some cycles after the trigger. */
static uint32_t changed_at(hal_t *hal, unsigned i, uint32_t cycles) {
    mode = FIXED;
    wanted = 0;
    bench_code(inputs[i], 500);
    wait_periods(2);
    halt();
    const uint32_t at = written_start + PERIOD_CYCLES + cycles;
    while ((int32_t)(CYCLES - at) < 0) {
    }
    bench_code(inputs[i], 600);
    wait_cycles(300);
    hal_adc_sample_t sample;
    hal_adc_read(hal, &sample);
    resume();
    return counts_of(&sample, i);
}

/* A sampling time of 12.5 clocks of the converter, 50 of the timer; the torque's begins after a conversion of 25. The
 * change comes some ten cycles later than asked for. */
static void check_sampling(hal_t *hal) {
    for (unsigned i = 0; i < sizeof inputs; i++) {
        const uint32_t begins = i == 5 ? 100 : 0;

        CHECK(changed_at(hal, i, begins + 44u) == 600);
        CHECK(changed_at(hal, i, begins + 82u) == 500);
    }
    mode = IDLE;
}

void check_samples(hal_t *hal) {
    static const uint16_t codes[] = {1111, 1222, 1333, 1444, 1555, 1666, 1777, 1888};
    wait_periods(10);
    for (unsigned i = 0; i < 4; i++) {
        CHECK(hal_adc_temperature(hal, HAL_ADC_WINDING + i) == codes[i] << 4);
        CHECK(hal_adc_temperature(hal, HAL_ADC_INVERTER + i) == codes[4 + i] << 4);
    }
    CHECK(hal_adc_bits(hal) == 12);
    mode = SAMPLE;
    while (mode == SAMPLE) {
        wait_periods(1);
    }
    check_sampling(hal);
    mode = TEMPERATURES;
    wait_periods(12);
    mode = IDLE;
    for (unsigned i = 0; i < 4; i++) {
        CHECK(hal_adc_temperature(hal, HAL_ADC_WINDING + i) == (2000u + 100u * i) << 4);
        CHECK(hal_adc_temperature(hal, HAL_ADC_INVERTER + i) == (2400u + 100u * i) << 4);
    }
}

/* --- Interrupts --- */

#define LATE_MISSED 40u

void check_interrupts(hal_t *hal) {
    hal_pwm_open_all(hal);
    hal_pwm_clear_break(hal);
    mode = LATE;
    wait_periods(6);
    CHECK(missed == LATE_MISSED && resumed >= 2);
    mode = IDLE;
    wait_periods(2);
    hal_pwm_clear_break(hal);
}
