/* Encoder mode 3 of TIM2 at PA0 and PA1, wired to PB0 and PB1; capture by TIM1's trigger; index at PA5's ETR. */
#include "part.h"

static unsigned state;

static void step(int direction) {
    static const uint32_t levels[4] = {0, 1, 3, 2}; /* A leads B */
    state = (state + (unsigned)direction) & 3;
    BSRR(B) = levels[state] | (~levels[state] & 3) << 16;
}

int test(void) {
    APB1ENR1 |= BIT(0);
    APB2ENR |= BIT(11);
    pin_mode(B, 0, 1, 0);
    pin_mode(B, 1, 1, 0);
    pin_mode(B, 2, 1, 0);
    pin_mode(A, 0, 2, 1);
    pin_mode(A, 1, 2, 1);
    pin_mode(A, 5, 2, 2); /* TIM2_ETR */
    ARR(TIM2) = 1023;
    CCMR(TIM2, 1) = 1u | 1u << 8;
    CCMR(TIM2, 2) = 3u; /* channel 3: TRC */
    SMCR(TIM2) = 3;     /* TS = 0: ITR0, TIM1 */
    CCER(TIM2) = BIT(8);
    EGR(TIM2) = 1;
    CR1(TIM2) = 1;
    for (unsigned i = 0; i < 10; ++i) {
        step(1);
    }
    CHECK(CNT(TIM2) == 10 && !(CR1(TIM2) & BIT(4)));
    for (unsigned i = 0; i < 13; ++i) {
        step(-1);
    }
    CHECK(CNT(TIM2) == 1021 && CR1(TIM2) & BIT(4));
    /* TIM1's update is its TRGO: the count is captured. */
    CR2(TIM1) = 2u << 4;
    EGR(TIM1) = 1;
    CHECK(SR(TIM2) & BIT(3) && CCR(TIM2, 3) == 1021);
    step(1);
    CHECK(!(SR(TIM2) & BIT(3)) && CCR(TIM2, 3) == 1021); /* the read has cleared it */
    /* Index: resets at the state A = B = 0. */
    ECR(TIM2) = 1;
    step(1);
    while (state != 3) {
        step(1);
    }
    BSRR(B) = BIT(2);
    step(1);
    CHECK(CNT(TIM2) == 0);
    BSRR(B) = BIT(2 + 16);
    step(1);
    CHECK(CNT(TIM2) == 1);
    return 0;
}
