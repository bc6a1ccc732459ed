/* Breaks: they open the switches without the firmware, which only reads their causes.
 *
 *   over-current  comparators of the phase currents to BRK2 of both timers, filtered; a driver's fault line
 *   not renewed   TIM3 counts the starts of periods since the last renewal; its third compare event requests two DMA
 *                 transfers, which write BG into EGR of both timers: at the start of the period, as the contract has it
 *   STO, faults   one line for both timers' BRK, low unless both STO lines and the drivers' fault line are high; which
 *                 of them fell is kept by the edge detectors of EXTI, however short the pulse
 * [SR-01] [SR-10] [SR-45] */
#include "hal_pwm.h"
#include "stm32g4/board.h"
#include "stm32g4/pins.h"
#include "stm32g4/registers.h"

#define PERIODS_UNRENEWED 3 /* starts after the write: the values have acted in two periods, not in the third */
#define TS_ITR0 0u          /* TIM1_TRGO */
#define SMS_EXTERNAL_CLOCK 7u
#define REQUEST_TIM3_CH1 61u
#define REQUEST_TIM3_CH2 62u
#define WORD 2u
#define PRIORITY_VERY_HIGH 3u
#define DAC_INTERNAL 3u /* to the comparators only, without buffer */
#define DAC_HFSEL_160_MHZ 2u
#define DAC_HFSEL_80_MHZ 1u
#define INM_DAC 4u /* DAC3 channel 1 of comparator 3, channel 2 of 2 and 4, DAC4 channel 1 of 7 */
#define HYSTERESIS_20_MV 2u
#define COMPARATORS_BREAK (TIM_AF2_BK2CMP2E | TIM_AF2_BK2CMP3E | TIM_AF2_BK2CMP4E | TIM_AF2_BK2CMP7E)
#define EXTI_PORT_B 1u
#define EXTI_PORT_C 2u
#define LINE_FAULT BIT(BOARD_PIN_DRIVER_FAULT)
#define LINE_STO_1 BIT(BOARD_PIN_STO_1)
#define LINE_STO_2 BIT(BOARD_PIN_STO_2)
#define LINES (LINE_FAULT | LINE_STO_1 | LINE_STO_2)
#define COMP_CSR (COMP_C2CSR_EN | PUT(COMP_C2CSR_INMSEL, INM_DAC) | PUT(COMP_C2CSR_HYST, HYSTERESIS_20_MV))

static const uint32_t break_word = TIM_EGR_BG;

static void comparators_write(uint32_t word) {
    COMP_C7CSR = word;
    COMP_C4CSR = word;
    COMP_C3CSR = word;
    COMP_C2CSR = word;
}

static void comparators_init(void) {
    const uint32_t mode = PUT(DAC_MCR_MODE1, DAC_INTERNAL) | PUT(DAC_MCR_MODE2, DAC_INTERNAL) |
                          PUT(DAC_MCR_HFSEL, BOARD_CLOCK_MHZ > 160 ? DAC_HFSEL_160_MHZ : DAC_HFSEL_80_MHZ);
    DAC_MCR(DAC3_BASE) = mode;
    DAC_MCR(DAC4_BASE) = mode;
    DAC_DHR12R1(DAC4_BASE) = board_trip_counts;
    DAC_DHR12R2(DAC3_BASE) = board_trip_counts;
    DAC_DHR12R1(DAC3_BASE) = board_trip_counts;
    DAC_CR(DAC3_BASE) = DAC_CR_EN1 | DAC_CR_EN2;
    DAC_CR(DAC4_BASE) = DAC_CR_EN1;
    board_wait_us(10, BOARD_CLOCK_MHZ); /* a DAC settles in 8 us at most, a comparator in 5 us */
    comparators_write(COMP_CSR);
    board_wait_us(10, BOARD_CLOCK_MHZ);
    comparators_write(COMP_CSR | COMP_C2CSR_LOCK);
}

/* One channel per timer: a request of the multiplexer may not serve two channels. */
static void unrenewed_init(void) {
    const uint32_t mode = DMA_CCR1_DIR | DMA_CCR1_CIRC | PUT(DMA_CCR1_PSIZE, WORD) | PUT(DMA_CCR1_MSIZE, WORD) |
                          PUT(DMA_CCR1_PL, PRIORITY_VERY_HIGH);
    DMAMUX_C0CR = PUT(DMAMUX_C0CR_DMAREQ_ID, REQUEST_TIM3_CH1);
    DMAMUX_C1CR = PUT(DMAMUX_C0CR_DMAREQ_ID, REQUEST_TIM3_CH2);
    DMA_CNDTR2 = 1;
    DMA_CNDTR1 = 1;
    DMA_CPAR1 = (uint32_t)(uintptr_t)&TIM_EGR(TIM1_BASE);
    DMA_CPAR2 = (uint32_t)(uintptr_t)&TIM_EGR(TIM8_BASE);
    DMA_CMAR2 = (uint32_t)(uintptr_t)&break_word;
    DMA_CMAR1 = (uint32_t)(uintptr_t)&break_word;
    DMA_CCR1 = mode | DMA_CCR1_EN;
    DMA_CCR2 = mode | DMA_CCR1_EN;
    TIM_SMCR(TIM3_BASE) = PUT(TIM_SMCR_TS, TS_ITR0); /* while no mode uses it */
    TIM_SMCR(TIM3_BASE) = PUT(TIM_SMCR_TS, TS_ITR0) | PUT(TIM_SMCR_SMS, SMS_EXTERNAL_CLOCK);
    TIM_CCR2(TIM3_BASE) = PERIODS_UNRENEWED;
    TIM_CCR1(TIM3_BASE) = PERIODS_UNRENEWED;
    TIM_SR(TIM3_BASE) = 0;
    TIM_DIER(TIM3_BASE) = TIM_DIER_CC1DE | TIM_DIER_CC2DE;
}

static uint32_t lines_high(void) {
    return (GPIO_IDR(GPIOB_BASE) & (LINE_STO_1 | LINE_STO_2)) | (GPIO_IDR(GPIOC_BASE) & LINE_FAULT);
}

static void lines_init(void) {
    SYSCFG_EXTICR3 = PUT(SYSCFG_EXTICR3_EXTI10, EXTI_PORT_C);
    SYSCFG_EXTICR4 = PUT(SYSCFG_EXTICR4_EXTI12, EXTI_PORT_B) | PUT(SYSCFG_EXTICR4_EXTI13, EXTI_PORT_B);
    EXTI_FTSR1 |= LINES;
    EXTI_IMR1 |= LINES;                  /* the latch; no interrupt of the NVIC is enabled for it */
    EXTI_SWIER1 = LINES & ~lines_high(); /* one that fell before the reset is a cause also when it has risen again */
    SYSCFG_CFGR2 |= SYSCFG_CFGR2_CLL;    /* a lock-up of the processor is a break, too */
}

void break_init(void) {
    comparators_init();
    lines_init();
    unrenewed_init();
    TIM_AF1(TIM8_BASE) = TIM_AF1_BKINE;
    TIM_AF1(TIM1_BASE) = TIM_AF1_BKINE;
    TIM_AF2(TIM8_BASE) = COMPARATORS_BREAK;
    TIM_AF2(TIM1_BASE) = COMPARATORS_BREAK;
}

void break_renew(void) {
    TIM_CNT(TIM3_BASE) = 0;
}

uint32_t break_causes(void) {
    const uint32_t flags = TIM_SR(TIM1_BASE) | TIM_SR(TIM8_BASE);
    const uint32_t fallen = EXTI_PR1;
    const uint32_t high = GPIO_IDR(GPIOB_BASE);
    uint32_t causes = 0;
    if ((fallen & LINE_STO_1) || !(high & LINE_STO_1)) {
        causes |= HAL_PWM_BREAK_STO_1;
    }
    if ((fallen & LINE_STO_2) || !(high & LINE_STO_2)) {
        causes |= HAL_PWM_BREAK_STO_2;
    }
    if ((TIM_SR(TIM3_BASE) & TIM_SR_CC1IF) != 0) {
        causes |= HAL_PWM_BREAK_NOT_RENEWED;
    }
    if ((flags & TIM_SR_B2IF) || (fallen & LINE_FAULT)) {
        causes |= HAL_PWM_BREAK_OVER_CURRENT;
    }
    /* A break without a cause that can be named, as one of the clock security system, is not to be cleared silently. */
    if (causes == 0 && (flags & (TIM_SR_BIF | TIM_SR_SBIF))) {
        causes = HAL_PWM_BREAK_OVER_CURRENT;
    }
    return causes;
}

/* A cause that is still there sets its flag again; the edge of a line that is still low would not come again. */
void break_clear(void) {
    TIM_CNT(TIM3_BASE) = 0;
    TIM_SR(TIM3_BASE) = ~(TIM_SR_CC1IF | TIM_SR_CC2IF);
    EXTI_PR1 = lines_high();
    TIM_SR(TIM1_BASE) = ~(TIM_SR_BIF | TIM_SR_B2IF | TIM_SR_SBIF);
    TIM_SR(TIM8_BASE) = ~(TIM_SR_BIF | TIM_SR_B2IF | TIM_SR_SBIF);
}
