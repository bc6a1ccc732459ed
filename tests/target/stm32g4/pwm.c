/* Waveforms of TIM1 for compare values 0, STEP, 2 STEP, ... ARR in all the modes; the test compares the edges.
 * MODE: OCxM; ALIGNMENT: CMS; PERIOD: ARR. Channel 1 at PC0. */
#include "part.h"

int test(void) {
    fast_clock();
    APB2ENR |= BIT(11);
    pin_mode(C, 0, 2, 2);
    CR1(TIM1) = (uint32_t)ALIGNMENT << 5 | BIT(7);
    ARR(TIM1) = PERIOD;
    RCR(TIM1) = ALIGNMENT ? 1 : 0;
    CCMR(TIM1, 1) = MODE << 4 | BIT(3);
    CCR(TIM1, 1) = 0;
    CCER(TIM1) = BIT(0);
    EGR(TIM1) = 1;
    BDTR(TIM1) = BIT(15);
    SR(TIM1) = 0;
    CR1(TIM1) |= 1;
    for (uint32_t compare = 0; compare <= PERIOD; ++compare) {
        CCR(TIM1, 1) = compare; /* preloaded: from the next update on */
        while (!(SR(TIM1) & 1)) {
        }
        SR(TIM1) = 0;
    }
    while (!(SR(TIM1) & 1)) {
    }
    return 0;
}
