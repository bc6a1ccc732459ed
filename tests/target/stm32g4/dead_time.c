/* Complementary outputs PC0 and PC13 of TIM1, whose rising edges come later by the dead time DTG. */
#include "part.h"

int test(void) {
    APB2ENR |= BIT(11);
    pin_mode(C, 0, 2, 2);
    pin_mode(C, 13, 2, 4);
    ARR(TIM1) = 9999;
    CCMR(TIM1, 1) = 6u << 4;
    CCR(TIM1, 1) = 5000;
    CCER(TIM1) = BIT(0) | BIT(2);
    EGR(TIM1) = 1;
    BDTR(TIM1) = BIT(15) | DTG;
    CR1(TIM1) = 1 | BIT(5); /* centre-aligned: no edge at the update, where the model has no dead time */
    wait(45000);
    return 0;
}
