/* Checks by the background: bus, memory, clocks, settings. */
#define CHECK_BASE 3000
#include "check.h"

#include <string.h>

#include "hal_can.h"
#include "hal_memory.h"
#include "hal_nvm.h"
#include "hal_pwm.h"
#include "hal_time.h"
#include "hal_watchdog.h"

#define CAN 0x40006400u
#define FLASH_CR WORD(0x40022014u)

/* --- Bus, in internal loop-back --- */

static void loop_back(void) {
    WORD(CAN + 0x18) = 1;
    WORD(CAN + 0x18) = 3;
    WORD(CAN + 0x18) = 0x83;
    WORD(CAN + 0x10) = 0x10;
    WORD(CAN + 0x18) = 0x80;
}

static hal_can_frame_t frame_of(uint32_t number, uint32_t identifier) {
    hal_can_frame_t frame = {.identifier = identifier, .length = 8};
    for (unsigned i = 0; i < 8; i++) {
        frame.data[i] = (uint8_t)(number * 29u + i);
    }
    return frame;
}

static bool same(const hal_can_frame_t *a, const hal_can_frame_t *b) {
    return a->identifier == b->identifier && a->extended == b->extended && a->remote == b->remote &&
           a->length == b->length && (a->remote || memcmp(a->data, b->data, a->length) == 0);
}

static bool transmitting(const hal_t *hal) {
    hal_can_status_t status;
    hal_can_status(hal, &status);
    CHECK(status.state == HAL_CAN_ERROR_ACTIVE && status.transmit_errors == 0 && status.receive_errors == 0);
    return status.transmitting;
}

static void sent(hal_t *hal) {
    while (transmitting(hal)) {
        hal_watchdog_kick(hal);
    }
}

static void expect(hal_t *hal, const hal_can_frame_t *frame) {
    hal_can_frame_t got;
    CHECK(hal_can_receive(hal, &got));
    CHECK(same(&got, frame));
}

static void check_frames(hal_t *hal) {
    hal_can_frame_t got;
    const uint32_t from_us = hal_time_us(hal);
    hal_can_frame_t frame = frame_of(0, 0x7AB);
    CHECK(hal_can_transmit(hal, &frame));
    CHECK(transmitting(hal));
    sent(hal);
    const uint32_t took_us = hal_time_us(hal) - from_us;
    CHECK(took_us >= 105 && took_us <= 125); /* 111 bits at 1 Mbit/s */
    expect(hal, &frame);
    CHECK(!hal_can_receive(hal, &got));
    const hal_can_frame_t kinds[] = {
        {.identifier = 0x1ABCDEF5, .extended = true, .length = 3, .data = {9, 8, 7}},
        {.identifier = 0x012, .remote = true, .length = 5},
        {.identifier = 0x00000012, .extended = true, .length = 0},
    };
    for (unsigned i = 0; i < 3; i++) {
        CHECK(hal_can_transmit(hal, &kinds[i]));
        sent(hal);
        expect(hal, &kinds[i]);
    }
    /* Three mailboxes; while the first leaves, the lowest identifier waits in the last. */
    const hal_can_frame_t three[] = {frame_of(1, 0x300), frame_of(2, 0x200), frame_of(3, 0x100)};
    for (unsigned i = 0; i < 3; i++) {
        CHECK(hal_can_transmit(hal, &three[i]));
    }
    CHECK(!hal_can_transmit(hal, &frame));
    sent(hal);
    expect(hal, &three[0]);
    expect(hal, &three[2]);
    expect(hal, &three[1]);
    /* Frames of one identifier keep their order, whichever mailbox is free: the first one is. */
    frame = frame_of(0, 0x154);
    CHECK(hal_can_transmit(hal, &frame));
    for (uint32_t number = 0; number < 12u;) {
        const hal_can_frame_t next = frame_of(number, 0x155);
        number += hal_can_transmit(hal, &next) ? 1u : 0u;
    }
    sent(hal);
    expect(hal, &frame);
    for (uint32_t number = 0; number < 12u; number++) {
        const hal_can_frame_t next = frame_of(number, 0x155);
        expect(hal, &next);
    }
}

static void put(hal_t *hal, uint32_t first, uint32_t count) {
    for (uint32_t i = first; i < first + count; i++) {
        const hal_can_frame_t frame = frame_of(i, 0x100 + i);
        while (!hal_can_transmit(hal, &frame)) {
            hal_watchdog_kick(hal);
        }
        sent(hal);
    }
}

/* Counters and states; in bus-off the frames of the buffers are lost, and nothing but a request ends it. */
static void check_errors(hal_t *hal) {
    hal_can_status_t status;
    hal_can_frame_t frame = frame_of(1, 0x111), got;
    bench_errors(100, 20, false);
    hal_can_status(hal, &status);
    CHECK(status.state == HAL_CAN_ERROR_ACTIVE && status.transmit_errors == 100 && status.receive_errors == 20);
    bench_errors(130, 0, false);
    hal_can_status(hal, &status);
    CHECK(status.state == HAL_CAN_ERROR_PASSIVE && status.transmit_errors == 130);
    bench_errors(0, 128, false);
    hal_can_status(hal, &status);
    CHECK(status.state == HAL_CAN_ERROR_PASSIVE && status.receive_errors == 128);
    bench_errors(0, 0, false);
    hal_can_rejoin(hal); /* no effect */
    CHECK(hal_can_transmit(hal, &frame) && transmitting(hal));
    bench_errors(248, 0, true);
    for (unsigned i = 0; i < 20; i++) {
        hal_can_status(hal, &status);
        CHECK(status.state == HAL_CAN_BUS_OFF && status.transmit_errors == 256 && !status.transmitting);
        CHECK(!hal_can_transmit(hal, &frame) && !hal_can_receive(hal, &got));
        wait_periods(1);
    }
    hal_can_rejoin(hal);
    CHECK(!transmitting(hal));
    wait_periods(10);
    CHECK(!hal_can_receive(hal, &got));
    loop_back(); /* the rejoin has left it */
    CHECK(hal_can_transmit(hal, &frame));
    sent(hal);
    expect(hal, &frame);
}

void check_bus(hal_t *hal) {
    hal_can_frame_t got;
    CHECK(!(WORD(CAN + 0x18) & 1u)); /* it takes part in the bus */
    loop_back();
    mode = DEFERRED;
    wait_periods(12);
    CHECK(deferred_calls == 1 && pre_empted >= 5 && can_pre_empted == 0);
    CHECK(hal_can_receive(hal, &got) && got.identifier == 0x123);
    check_frames(hal);
    /* The queue keeps the first 64 frames and counts the others. */
    CHECK(hal_can_receive_overflows(hal) == 0);
    put(hal, 0, HAL_CAN_RECEIVE_QUEUE + 4u);
    CHECK(hal_can_receive_overflows(hal) == 4);
    for (uint32_t i = 0; i < HAL_CAN_RECEIVE_QUEUE; i++) {
        const hal_can_frame_t frame = frame_of(i, 0x100 + i);
        expect(hal, &frame);
    }
    CHECK(!hal_can_receive(hal, &got));
    /* Without the interrupt the part keeps the first three. */
    mode = FIXED;
    wanted = 0;
    WORD(0xE000E180u) = 1u << 21;
    put(hal, 0, 5);
    WORD(0xE000E100u) = 1u << 21;
    wait_periods(1);
    CHECK(hal_can_receive_overflows(hal) == 5);
    for (uint32_t i = 0; i < 3; i++) {
        const hal_can_frame_t frame = frame_of(i, 0x100 + i);
        expect(hal, &frame);
    }
    CHECK(!hal_can_receive(hal, &got));
    mode = IDLE;
    check_errors(hal);
}

/* --- Memory --- */

static uint64_t word_of(unsigned page, unsigned word) {
    return UINT64_C(0x0102030405060708) * (page * 11u + word + 1u);
}

static const uint8_t words[] = {0, 1, 7, 128, 255};
#define WORDS (sizeof words)

/* In bank 2, where nothing of the program is. */
static uint64_t in_bank_2(unsigned page, unsigned word) {
    const uint32_t at = 0x08040000u + 2048u * page + 8u * word;
    return (uint64_t)WORD(at + 4u) << 32 | WORD(at);
}

static void check_words(const hal_t *hal, unsigned erased_page) {
    for (unsigned page = 0; page < HAL_NVM_PAGES; page++) {
        for (unsigned i = 0; i < WORDS; i++) {
            const uint64_t expected = page == erased_page ? HAL_NVM_ERASED : word_of(page, words[i]);
            CHECK(hal_nvm_read(hal, page, words[i]) == expected && in_bank_2(page, words[i]) == expected);
        }
    }
}

void check_memory(hal_t *hal) {
    for (unsigned page = 0; page < HAL_NVM_PAGES; page++) {
        for (unsigned i = 0; i < WORDS; i++) {
            CHECK(hal_nvm_read(hal, page, words[i]) == HAL_NVM_ERASED);
            CHECK(hal_nvm_program(hal, page, words[i], word_of(page, words[i])));
        }
    }
    check_words(hal, HAL_NVM_PAGES);
    CHECK(FLASH_CR >> 31);
    CHECK(!hal_nvm_program(hal, 2, words[1], 0x55) && !hal_nvm_program(hal, 2, words[1], 0));
    WORD(0x08040000u + 2048u * 5u + 8u * 33u) = 1; /* an error of the sequence, of before */
    const uint32_t from = periods, from_us = hal_time_us(hal);
    CHECK(hal_nvm_erase(hal, 3));
    CHECK(hal_time_us(hal) - from_us > 18000);              /* longer than the watchdog allows */
    CHECK(periods - from > 700 && hal_pwm_break(hal) == 0); /* the interrupts went on */
    check_words(hal, 3);
    CHECK(hal_nvm_program(hal, 3, 0, word_of(3, 0)));
    CHECK(FLASH_CR >> 31);
}

/* --- Clocks and settings --- */

void check_clocks(hal_t *hal) {
    const uint32_t from_us = hal_time_us(hal), reference_us = hal_time_reference_us(hal), cycles = CYCLES;
    const uint32_t from = periods;
    while (hal_time_us(hal) - from_us < 50000) {
        hal_watchdog_kick(hal);
    }
    const uint32_t passed_us = hal_time_us(hal) - from_us;
    const int32_t by_cycles_us = (int32_t)((CYCLES - cycles) / BOARD_CLOCK_MHZ - passed_us);
    const int32_t by_reference_us = (int32_t)(hal_time_reference_us(hal) - reference_us - passed_us);
    CHECK(by_cycles_us >= -5 && by_cycles_us <= 5);
    CHECK(by_reference_us >= -80 && by_reference_us <= 80); /* two counts of 30.5 us */
    CHECK(periods - from >= 1999 && periods - from <= 2001);
    CHECK((WORD(0x40012C44u) & WORD(0x40013444u) & 0x0C00u) == 0x0C00u); /* OSSI, OSSR: driven low without MOE */
    /* Settings that no run of the model shows. */
    static const struct {
        uint32_t at, mask, value;
    } settings[] = {
        {0x40021000u, 1u << 19, 1u << 19},       /* RCC_CR: clock security system of the crystal */
        {0x4001001Cu, 1, 1},                     /* SYSCFG_CFGR2: a lock-up of the processor is a break */
        {0x40012C44u, 0xFF0300FFu, 0x03000000u}, /* TIM1_BDTR: no dead time, BK2E and BK2P, no lock */
        {0x40012C44u, 0x00FF0000u, 0x00300000u}, /* its filters: BRK none, BRK2 of 8 samples */
        {0x40013444u, 0x00FF0000u, 0x00300000u}, /* TIM8_BDTR */
        {0x48000808u, 0x000FF0FFu, 0x000AA0AAu}, /* GPIOC_OSPEEDR: gates at high speed */
        {0x40022000u, 0x00000700u, 0x00000700u}, /* FLASH_ACR: prefetch and caches */
        {0x40000018u, 0x0000F0F0u, 0x00002020u}, /* TIM2_CCMR1: filters of the encoder, four samples */
        {0x5000103Cu, 0x0000C007u, BOARD_CLOCK_MHZ > 160 ? 0x8003u : 0x4003u}, /* DAC3_MCR: to the comparators */
        {0x5000143Cu, 0x0000C007u, BOARD_CLOCK_MHZ > 160 ? 0x8003u : 0x4003u}, /* DAC4_MCR */
        {0x40010204u, 0x80070000u, 0x80020000u}, /* COMP_C2CSR: hysteresis of 20 mV, locked */
        {0x40010208u, 0x80070000u, 0x80020000u}, /* COMP_C3CSR */
        {0x4001020Cu, 0x80070000u, 0x80020000u}, /* COMP_C4CSR */
        {0x40010218u, 0x80070000u, 0x80020000u}, /* COMP_C7CSR */
        {CAN + 0x1C, 0xFFFFFFFFu, 0x02000601u | (BOARD_CLOCK_MHZ / 10u - 1u) << 16}, /* FDCAN_NBTP: 80 %, jump of 2 */
        {0xE000E414u, 0x0000FF00u, 0x0000C000u}, /* the bus below the deferred interrupt, as */
        {0xE000ED20u, 0x00FF0000u, 0x00800000u}, /* PendSV, this below the control interrupt */
    };
    for (unsigned i = 0; i < sizeof settings / sizeof settings[0]; i++) {
        if ((WORD(settings[i].at) & settings[i].mask) != settings[i].value) {
            leave(4000 + (int)i);
        }
    }
}
