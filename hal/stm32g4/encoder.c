/* Encoder: TIM2 counts the quadrature signals, wraps once a turn, and captures its count at TIM1's update. The index,
 * at the count 0, corrects it. No edges are captured: the only other timer of 32 bits is the clock, and an edge between
 * the latch and its reading would hide the last one before it. */
#include "hal_encoder.h"
#include "stm32g4/board.h"
#include "stm32g4/registers.h"

#define TS_ITR0 0u /* TIM1_TRGO */
#define SMS_ENCODER_BOTH 3u
#define CCS_TI 1u
#define CCS_TRC 3u
#define FILTER_4 2u /* samples of the timer's clock, 24 ns at 170 MHz */

/* Before everything that takes long, as the crystal LSE does: an encoder that counts to its absolute position does so
 * after its own start, and the edges that nothing counts are lost. */
void encoder_init(void) {
    TIM_SMCR(TIM2_BASE) = PUT(TIM_SMCR_TS, TS_ITR0); /* while no mode uses it */
    TIM_SMCR(TIM2_BASE) = PUT(TIM_SMCR_TS, TS_ITR0) | PUT(TIM_SMCR_SMS, SMS_ENCODER_BOTH);
    TIM_CCMR1(TIM2_BASE) = PUT(TIM_CCMR1_CC1S, CCS_TI) | PUT(TIM_CCMR1_IC1F, FILTER_4) | PUT(TIM_CCMR1_CC2S, CCS_TI) |
                           PUT(TIM_CCMR1_IC2F, FILTER_4);
    TIM_CCMR2(TIM2_BASE) = PUT(TIM_CCMR2_CC3S, CCS_TRC);
    TIM_CCER(TIM2_BASE) = TIM_CCER_CC3E;
    TIM_ARR(TIM2_BASE) = (UINT32_C(1) << board_encoder_bits) - 1u;
    TIM_ECR(TIM2_BASE) = TIM_ECR_IE;
    TIM_CR1(TIM2_BASE) = TIM_CR1_CEN;
}

bool encoder_is_absolute(void) {
#if BOARD_ENCODER_INDEX
    return (TIM_SR(TIM2_BASE) & TIM_SR_IDXF) != 0; /* nothing clears it */
#else
    return true;
#endif
}

unsigned hal_encoder_bits(const hal_t *hal) {
    (void)hal;
    return board_encoder_bits;
}

void hal_encoder_read(const hal_t *hal, hal_encoder_sample_t *sample) {
    (void)hal;
    *sample = (hal_encoder_sample_t){.counts = TIM_CCR3(TIM2_BASE)};
}
