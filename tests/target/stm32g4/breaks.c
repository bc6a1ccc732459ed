/* A low level at the break input PB12 opens TIM1's outputs without a handler: the processor sleeps. PB12 is wired to
 * PB0, which TIM6's DMA request sets low. Then not renewed: TIM7's overflow by DMA into TIM8_EGR.BG. */
#include "part.h"

static volatile uint32_t low, generate;

int test(void) {
    APB1ENR1 |= BIT(4) | BIT(5);
    APB2ENR |= BIT(11) | BIT(13);
    AHB1ENR |= BIT(0) | BIT(2);
    low = BIT(16);
    generate = BIT(7);
    pin_mode(B, 0, 1, 0);
    BSRR(B) = BIT(0);
    pin_mode(B, 12, 2, 6);
    pin_mode(C, 0, 2, 2);
    pin_mode(C, 6, 2, 4);
    /* Both timers at 100 %. */
    const uint32_t timers[2] = {TIM1, TIM8};
    for (unsigned i = 0; i < 2; ++i) {
        ARR(timers[i]) = 999;
        CCMR(timers[i], 1) = 6u << 4 | BIT(3);
        CCR(timers[i], 1) = 1000;
        CCER(timers[i]) = 1;
        EGR(timers[i]) = 1;
    }
    SR(TIM1) = 0;
    BDTR(TIM1) = BIT(12); /* BKE, active low: AF1.BKINE is set after reset */
    BDTR(TIM8) = 0;
    CHECK(!(SR(TIM1) & BIT(7)));
    BDTR(TIM1) |= BIT(15);
    BDTR(TIM8) |= BIT(15);
    CR1(TIM1) = CR1(TIM8) = 1;
    CHECK(IDR(C) & BIT(0) && IDR(C) & BIT(6));
    /* DMA1 channel 1: TIM6_UP (8) to GPIOB_BSRR; channel 2: TIM7_UP (9) to TIM8_EGR. */
    REG(0x40020800u) = 8;
    REG(0x40020804u) = 9;
    const uint32_t from[2] = {(uint32_t)&low, (uint32_t)&generate}, to[2] = {0x48000418u, TIM8 + 0x14};
    for (unsigned i = 0; i < 2; ++i) {
        const uint32_t channel = 0x40020008u + 20 * i;
        REG(channel + 4) = 1;
        REG(channel + 8) = to[i];
        REG(channel + 12) = from[i];
        REG(channel) = 2u << 10 | 2u << 8 | BIT(5) | BIT(4) | 1; /* words, circular, from memory */
    }
    ARR(TIM6) = 2000;
    ARR(TIM7) = 4000;
    EGR(TIM6) = EGR(TIM7) = 1;
    SR(TIM6) = SR(TIM7) = 0;
    DIER(TIM6) = DIER(TIM7) = BIT(8);
    CR1(TIM6) = CR1(TIM7) = BIT(3) | 1;
    const uint32_t start = (REG(0xE0001000u) = 1, CYCLES);
    while (SR(TIM1) == 0 || !(SR(TIM1) & BIT(7))) {
    }
    CHECK(CYCLES - start < 2300);
    CHECK(!(IDR(C) & BIT(0)) && IDR(C) & BIT(6));
    CHECK(!(BDTR(TIM1) & BIT(15)));
    /* The flag cannot be cleared, nor MOE set, while the input is active. */
    SR(TIM1) = 0;
    BDTR(TIM1) |= BIT(15);
    CHECK(SR(TIM1) & BIT(7) && !(BDTR(TIM1) & BIT(15)));
    BSRR(B) = BIT(0);
    SR(TIM1) = 0;
    CHECK(!(SR(TIM1) & BIT(7)) && !(IDR(C) & BIT(0)));
    BDTR(TIM1) |= BIT(15);
    CHECK(IDR(C) & BIT(0));
    while (!(SR(TIM8) & BIT(7))) {
    }
    CHECK(!(IDR(C) & BIT(6)) && IDR(C) & BIT(0));
    return 0;
}
