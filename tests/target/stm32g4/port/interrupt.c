/* The control interrupt and the deferred interrupt of the program, by mode. */
#define CHECK_BASE 1000
#include "check.h"

#include "hal_adc.h"
#include "hal_can.h"
#include "hal_encoder.h"
#include "hal_interrupt.h"
#include "hal_pwm.h"

#define SWITCHES 8u
#define VALUES (PERIOD_TICKS + 2u) /* 0 to one above the largest */
#define FLASH_BUSY (WORD(0x40022010u) & 0x10000u)
#define RESET_REQUEST 0x05FA0004u
#define CAN_FIFO_LEVEL (WORD(0x40006490u) & 0x7Fu)
#define DEFERRED_PERIODS 6u
/* The interrupt comes with the second result of ADC5: two conversions of 25 clocks of the converter, which has a
 * quarter of the timer's clock; then the entry, and the functions before the question. */
#define LATENCY_MIN 230u
#define LATENCY_MAX 400u

/* Coprime with both numbers of values, so that each switch has every value once. */
static const uint32_t step[SWITCHES] = {1, 5, 7, 11, 13, 617, 1009, 1201};
static uint32_t swept;

static void wait_until(const hal_t *hal, uint32_t ticks) {
    while (hal_interrupt_elapsed_ticks(hal) < ticks) {
    }
}

/* tests/target/test_board_port.py has the same sequence. */
static void sweep(hal_t *hal) {
    hal_pwm_compare_t compare = {{0}, {0}};
    for (unsigned i = 0; i < 4; i++) {
        compare.lower[i] = (uint16_t)(swept * step[i] % VALUES);
        compare.upper[i] = (uint16_t)(swept * step[i + 4] % VALUES);
    }
    wait_until(hal, 320u + swept * 101u % 97u * ((PERIOD_CYCLES - 800u) / 97u));
    hal_pwm_write(hal, &compare);
    if (++swept == VALUES + 3u) {
        mode = IDLE;
        sweep_done = true;
    }
}

static void fixed(hal_t *hal, uint32_t now, uint32_t elapsed) {
    hal_pwm_compare_t compare;
    for (unsigned i = 0; i < 4; i++) {
        compare.lower[i] = compare.upper[i] = (uint16_t)wanted;
    }
    hal_pwm_write(hal, &compare);
    written_start = now - elapsed;
}

/* --- Samples --- */

static const uint8_t inputs[] = {PIN(PORT_A, 0),  PIN(PORT_A, 7), PIN(PORT_B, 0),
                                 PIN(PORT_B, 14), PIN(PORT_A, 8), PIN(PORT_A, 9)};
#define INPUTS (sizeof inputs)
static const uint8_t sensors[] = {PIN(PORT_A, 1),  PIN(PORT_A, 4),  PIN(PORT_A, 6), PIN(PORT_B, 2),
                                  PIN(PORT_B, 11), PIN(PORT_B, 15), PIN(PORT_C, 4), PIN(PORT_C, 5)};

static uint32_t code(uint32_t period, unsigned input) {
    return (period * 37u + input * 411u) % 2900u;
}

/* The shaft: A leads B forwards, the index is high around its mark. Both signals are pulled up at the start: position 2
 * of 4, where the counter has 0. */
static uint32_t shaft = 2, origin = 2, mark = 0x10000;

static void turn(uint32_t to) {
    while (shaft != to) {
        shaft = (int32_t)(to - shaft) > 0 ? shaft + 1u : shaft - 1u;
        const bool near = shaft + 1u - mark <= 2u;
        if (near) {
            bench_level(PIN(PORT_A, 5), 1);
        }
        bench_level(PIN(PORT_A, 15), (shaft & 3u) == 1u || (shaft & 3u) == 2u);
        bench_level(PIN(PORT_B, 3), (shaft & 3u) >= 2u);
        if (!near) {
            bench_level(PIN(PORT_A, 5), 0);
        }
    }
}

static uint32_t samples, latched;

/* Codes that were set in the last period are sampled in this one; the encoder, which has moved since its latch, is read
 * as latched. */
static void sample(hal_t *hal) {
    hal_adc_sample_t made;
    hal_encoder_sample_t encoder;
    hal_adc_read(hal, &made);
    const uint32_t forwards = samples < 40u || samples > 90u ? 5u : 0u - 7u;
    turn(shaft + forwards);
    hal_encoder_read(hal, &encoder);
    if (samples > 0) {
        for (unsigned i = 0; i < 4; i++) {
            CHECK(made.phase_current_counts[i] == code(samples, i));
        }
        CHECK(made.bus_voltage_counts == code(samples, 4));
        CHECK(made.load_torque_counts == code(samples, 5));
        CHECK(encoder.counts == ((latched - origin) & 0xFFFu));
    }
    latched = shaft;
    if (samples == 80u) { /* the index is passed at a position within the turn: the count follows it */
        mark = (shaft + 12u) & ~3u;
        turn(mark + 6u);
        origin = mark;
        mark = 0x10000; /* the next turn wraps without it */
        latched = shaft;
    } else if (samples > 120u) {
        mode = IDLE;
    }
    samples++;
    for (unsigned i = 0; i < INPUTS; i++) {
        bench_code(inputs[i], code(samples, i));
    }
}

/* Temperatures change twice: first within the sampling time of 370 ticks, which begins at about 250, then after it. */
static void late_temperatures(const hal_t *hal) {
    wait_until(hal, 400);
    for (unsigned i = 0; i < sizeof sensors; i++) {
        bench_code(sensors[i], 2000u + 100u * i);
    }
    wait_until(hal, 700);
    for (unsigned i = 0; i < sizeof sensors; i++) {
        bench_code(sensors[i], 1000u);
    }
}

/* --- Interrupts --- */

#define LATE_PERIODS 40u /* so that some readings meet an update */

static uint32_t interrupts_late;

static void late(hal_t *hal) {
    interrupts_late++;
    if (interrupts_late == 1) {
        (void)hal_interrupt_missed_triggers(hal);
    } else if (interrupts_late == 2) {
        CHECK(hal_interrupt_missed_triggers(hal) == 0);
        uint32_t last = 0;
        for (uint32_t ticks = 0; ticks < PERIOD_CYCLES * LATE_PERIODS + PERIOD_CYCLES / 3u;
             ticks = hal_interrupt_elapsed_ticks(hal)) {
            CHECK(ticks >= last && ticks - last < 200u + LATENCY_MAX);
            last = ticks;
        }
    } else if (interrupts_late == 3) {
        missed = hal_interrupt_missed_triggers(hal);
    } else {
        CHECK(hal_interrupt_missed_triggers(hal) == 0);
        resumed++;
    }
}

static volatile bool in_deferred;

void drive_control_interrupt(drive_t *drive, hal_t *hal) {
    (void)drive;
    const uint32_t now = CYCLES, elapsed = hal_interrupt_elapsed_ticks(hal);
    CHECK(masked || (elapsed >= LATENCY_MIN && elapsed <= LATENCY_MAX));
    CHECK(periods > 0 || hal_interrupt_missed_triggers(hal) == 0); /* of before the interrupts */
    periods++;
    pre_empted += in_deferred;
    switch (mode) {
    case FIXED:
        fixed(hal, now, elapsed);
        break;
    case SWEEP:
        sweep(hal);
        break;
    case SAMPLE:
        sample(hal);
        break;
    case LATE:
        late(hal);
        break;
    case TEAR:
        if (FLASH_BUSY) {
            WORD(0xE000ED0Cu) = RESET_REQUEST;
        }
        break;
    case DEFERRED:
        mode = IDLE;
        hal_interrupt_request_deferred(hal);
        hal_interrupt_request_deferred(hal);
        break;
    case CLOSED_NO_MORE:
        CHECK(false);
        break;
    case TEMPERATURES:
        late_temperatures(hal);
        break;
    default:
        hal_pwm_open_all(hal);
    }
}

/* Lasts for some control interrupts, which come all the same, and for a frame of the bus, which has to wait. */
void drive_deferred_interrupt(drive_t *drive, hal_t *hal) {
    (void)drive;
    CHECK(!in_deferred);
    in_deferred = true;
    deferred_calls++;
    hal_can_frame_t frame = {.identifier = 0x123, .length = 8, .data = {1, 2, 3, 4, 5, 6, 7, 8}};
    CHECK(hal_can_transmit(hal, &frame));
    for (const uint32_t from = periods; periods - from < DEFERRED_PERIODS;) {
    }
    CHECK(CAN_FIFO_LEVEL == 1);
    can_pre_empted += hal_can_receive(hal, &frame);
    in_deferred = false;
}
