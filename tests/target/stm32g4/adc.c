/* Converter 1: start-up, injected sequence of two started by TIM1's TRGO2 at its update, flags and times. PA0: 1234,
 * PA1: 3000. */
#include "part.h"

#define ADC1 0x50000000u
#define ISR REG(ADC1 + 0x00)
#define CR REG(ADC1 + 0x08)

static volatile unsigned calls, data[2], cycles;

static void converted(void) {
    cycles = CYCLES;
    ++calls;
    data[0] = REG(ADC1 + 0x80);
    data[1] = REG(ADC1 + 0x84);
    ISR = BIT(6); /* JEOS, write one to clear */
    (void)ISR;
}

int test(void) {
    fast_clock();
    AHB2ENR |= BIT(13);
    APB2ENR |= BIT(11);
    pin_mode(A, 0, 3, 0);
    pin_mode(A, 1, 3, 0);
    REG(0x50000308u) = 3u << 16; /* HCLK / 4 = 42.5 MHz */
    CR = 0;
    CR = BIT(28);
    wait(170 * 21);
    CR |= BIT(31);
    while (CR & BIT(31)) {
    }
    wait(100);
    CR |= 1;
    while (!(ISR & 1)) {
    }
    REG(ADC1 + 0x14) = 1u << 3 | 1u << 6;                           /* channels 1, 2: 6.5 clocks */
    REG(ADC1 + 0x4C) = 1u | 8u << 2 | 1u << 7 | 1u << 9 | 2u << 15; /* two, TIM1_TRGO2 rising */
    REG(ADC1 + 0x04) = BIT(6);
    vectors[16 + 18] = converted;
    NVIC_ENABLE(18);
    CR |= BIT(3);
    ARR(TIM1) = 8499;
    CR2(TIM1) = 2u << 20;
    CHECK(calls == 0);
    CR1(TIM1) = 1;
    while (!(SR(TIM1) & 1)) {
    }
    const uint32_t from = CYCLES;
    while (calls == 0) {
    }
    CHECK(data[0] == 1234 && data[1] == 3000);
    /* Two conversions of 6.5 + 12.5 clocks of 4 cycles: 152 cycles, and the entry of the interrupt. */
    CHECK(cycles - from > 100 && cycles - from < 250);
    CHECK(!(ISR & BIT(6)));
    SR(TIM1) = 0;
    while (calls == 1) {
    }
    CHECK(calls == 2);
    return 0;
}
