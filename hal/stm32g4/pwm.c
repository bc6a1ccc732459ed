/* PWM: TIM1 has phases a and b, TIM8 has c and d; of each phase an odd channel for the lower switch and an even one for
 * the upper switch.
 *
 * Centre-aligned, 2 * ARR ticks a period, which begins at the underflow. Lower: PWM mode 1, on while the counter is
 * below CCR, around the underflow. Upper: PWM mode 2 with CCR = ARR - compare, on while the counter is not below it,
 * around the overflow. 0 and ARR are off and on for the whole period in both.
 *
 * Both timers are in trigger mode on TIM3's enable, and start in the same cycle. Their own update is the trigger of
 * ADC, encoder and counters only: with it as the start, UG, which loads the repetition counter, would start TIM8 ahead
 * of TIM1.
 */
#include "hal_memory.h"
#include "hal_pwm.h"
#include "stm32g4/board.h"
#include "stm32g4/registers.h"

#define CENTRE_ALIGNED 1u
#define PWM_MODE_1 6u
#define PWM_MODE_2 7u
#define MMS_UPDATE 2u
#define TS_ITR2 2u /* TIM3_TRGO, in all timers */
#define SMS_TRIGGER 6u
#define MMS_ENABLE 1u
#define BK2_FILTER 3u /* 8 samples of the timer's clock, 47 ns at 170 MHz */

#define CCMR1_MODES (PUT(TIM_CCMR1_OC1M, PWM_MODE_1) | PUT(TIM_CCMR1_OC2M, PWM_MODE_2))
#define CCMR2_MODES (PUT(TIM_CCMR2_OC3M, PWM_MODE_1) | PUT(TIM_CCMR2_OC4M, PWM_MODE_2))
#define CCMR1_PRELOADED (CCMR1_MODES | TIM_CCMR1_OC1PE | TIM_CCMR1_OC2PE)
#define CCMR2_PRELOADED (CCMR2_MODES | TIM_CCMR2_OC3PE | TIM_CCMR2_OC4PE)
#define CCER_OUTPUTS (TIM_CCER_CC1E | TIM_CCER_CC2E | TIM_CCER_CC3E | TIM_CCER_CC4E)
/* BRK: line of STO and driver faults, active low, without a filter and so without a clock. BRK2: comparators, active
 * high. Without MOE the outputs are driven low. */
#define BDTR_CLOSED                                                                                                    \
    (TIM_BDTR_OSSI | TIM_BDTR_OSSR | TIM_BDTR_BKE | TIM_BDTR_BK2E | TIM_BDTR_BK2P | PUT(TIM_BDTR_BK2F, BK2_FILTER))

static const uint32_t timers[] = {TIM1_BASE, TIM8_BASE};
#define TIMERS (sizeof timers / sizeof timers[0])

void pwm_init(void) {
    for (unsigned i = 0; i < TIMERS; i++) {
        const uint32_t tim = timers[i];
        TIM_CR1(tim) = PUT(TIM_CR1_CMS, CENTRE_ALIGNED);
        TIM_CCMR1(tim) = CCMR1_PRELOADED;
        TIM_CCMR2(tim) = CCMR2_PRELOADED;
        TIM_RCR(tim) = 1; /* before the start: updates at the underflow only */
        TIM_BDTR(tim) = BDTR_CLOSED;
        TIM_CCER(tim) = CCER_OUTPUTS;
        TIM_SMCR(tim) = PUT(TIM_SMCR_TS, TS_ITR2); /* while no mode uses it */
        TIM_SMCR(tim) = PUT(TIM_SMCR_TS, TS_ITR2) | PUT(TIM_SMCR_SMS, SMS_TRIGGER);
        /* Loads the repetition counter. UG also leaves as TRGO and TRGO2: here, before anything is armed that they
         * trigger (adc_init, hal_pwm_start). */
        TIM_EGR(tim) = TIM_EGR_UG;
        TIM_SR(tim) = 0;
    }
    TIM_CR2(TIM1_BASE) = PUT(TIM_CR2_MMS, MMS_UPDATE) | PUT(TIM_CR2_MMS2, MMS_UPDATE);
}

uint32_t hal_pwm_clock_hz(const hal_t *hal) {
    (void)hal;
    return BOARD_CLOCK_HZ;
}

void hal_pwm_start(hal_t *hal, uint16_t period_ticks) {
    hal->period_ticks = period_ticks;
    for (unsigned i = 0; i < TIMERS; i++) {
        TIM_ARR(timers[i]) = period_ticks;
    }
    hal_pwm_open_all(hal);
    trigger_start();
    break_clear();
    TIM_CR2(TIM3_BASE) = PUT(TIM_CR2_MMS, MMS_ENABLE);
    TIM_CR1(TIM3_BASE) = TIM_CR1_CEN;
}

static uint32_t limited(uint16_t compare, uint32_t period_ticks) {
    return compare < period_ticks ? compare : period_ticks;
}

/* Compare values of two phases. */
static void write_pair(uint32_t tim, const hal_pwm_compare_t *compare, unsigned phase, uint32_t period_ticks) {
    TIM_CCR1(tim) = limited(compare->lower[phase], period_ticks);
    TIM_CCR2(tim) = period_ticks - limited(compare->upper[phase], period_ticks);
    TIM_CCR3(tim) = limited(compare->lower[phase + 1], period_ticks);
    TIM_CCR4(tim) = period_ticks - limited(compare->upper[phase + 1], period_ticks);
}

/* Enables the outputs, unless there is a break: one that comes between its reading and the store is found after. */
static void close_gates(hal_t *hal) {
    if (break_causes() != 0 || !encoder_is_absolute()) {
        return;
    }
    TIM_BDTR(TIM1_BASE) = BDTR_CLOSED | TIM_BDTR_MOE;
    TIM_BDTR(TIM8_BASE) = BDTR_CLOSED | TIM_BDTR_MOE;
    hal->gates_open = false;
    if (break_causes() != 0) {
        hal_pwm_open_all(hal);
    }
}

void hal_pwm_write(hal_t *hal, const hal_pwm_compare_t *compare) {
    write_pair(TIM1_BASE, compare, 0, hal->period_ticks);
    write_pair(TIM8_BASE, compare, 2, hal->period_ticks);
    break_renew();
    if (hal->gates_open) {
        close_gates(hal);
    }
}

/* Compare values that are off, in the registers that act as well: without preload a write passes through. Else values
 * of this period would come back with the outputs when hal_pwm_write follows within it. */
void hal_pwm_open_all(hal_t *hal) {
    TIM_BDTR(TIM1_BASE) = BDTR_CLOSED;
    TIM_BDTR(TIM8_BASE) = BDTR_CLOSED;
    hal->gates_open = true;
    for (unsigned i = 0; i < TIMERS; i++) {
        const uint32_t tim = timers[i];
        TIM_CCMR1(tim) = CCMR1_MODES;
        TIM_CCMR2(tim) = CCMR2_MODES;
        TIM_CCR3(tim) = 0;
        TIM_CCR1(tim) = 0;
        TIM_CCR4(tim) = hal->period_ticks;
        TIM_CCR2(tim) = hal->period_ticks;
        TIM_CCMR1(tim) = CCMR1_PRELOADED;
        TIM_CCMR2(tim) = CCMR2_PRELOADED;
    }
    break_renew();
}

uint32_t hal_pwm_break(const hal_t *hal) {
    (void)hal;
    return break_causes();
}

void hal_pwm_clear_break(hal_t *hal) {
    (void)hal;
    break_clear();
}

noreturn void board_halt(void) {
    __asm__ volatile("cpsid i" ::: "memory");
    TIM_EGR(TIM1_BASE) = TIM_EGR_BG;
    TIM_EGR(TIM8_BASE) = TIM_EGR_BG;
    for (;;) {
    }
}

/* Registers that decide when a switch is on and who opens it. */
bool hal_registers_intact(const hal_t *hal) {
    bool intact = TIM_AF2(TIM1_BASE) == TIM_AF2(TIM8_BASE) && TIM_AF2(TIM1_BASE) != 0;
    for (unsigned i = 0; i < TIMERS; i++) {
        const uint32_t tim = timers[i];
        intact = intact && TIM_ARR(tim) == hal->period_ticks && TIM_RCR(tim) == 1 &&
                 (TIM_CR1(tim) & ~TIM_CR1_DIR) == (PUT(TIM_CR1_CMS, CENTRE_ALIGNED) | TIM_CR1_CEN) &&
                 TIM_CCMR1(tim) == CCMR1_PRELOADED && TIM_CCMR2(tim) == CCMR2_PRELOADED &&
                 TIM_CCER(tim) == CCER_OUTPUTS && (TIM_BDTR(tim) & ~TIM_BDTR_MOE) == BDTR_CLOSED &&
                 TIM_AF1(tim) == TIM_AF1_BKINE && TIM_PSC(tim) == 0;
    }
    return intact;
}
