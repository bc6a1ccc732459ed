/* Clocks: TIM5 counts microseconds of the crystal HSE, LPTIM1 counts the second crystal, LSE. Watchdog: IWDG, with the
 * oscillator LSI. */
#include "hal_time.h"
#include "hal_watchdog.h"
#include "stm32g4/board.h"
#include "stm32g4/registers.h"

/* 1 s / 32768 Hz = 15625 / 512 us */
#define REFERENCE_US 15625u
#define REFERENCE_TICKS 512u
#define REFERENCE_MAX 0xFFFFu
#define LSE_START_MS 3000u /* of the crystal, at most 2 s by the data sheet */

#define IWDG_START 0xCCCCu
#define IWDG_UNLOCK 0x5555u
#define IWDG_RELOAD 0xAAAAu
#define LSI_HZ 32000u
#define IWDG_PRESCALER 4u /* code 0 of PR */
#define IWDG_COUNTS (HAL_WATCHDOG_TIMEOUT_US / 1000u * LSI_HZ / IWDG_PRESCALER / 1000u)

/* Without the crystal LSE the second clock stands still, and the self-test of the drive reports it. */
void time_init(void) {
    for (uint32_t ms = 0; ms < LSE_START_MS && !(RCC_BDCR & RCC_BDCR_LSERDY); ms++) {
        board_wait_us(1000, BOARD_CLOCK_MHZ);
    }
    TIM_CR1(TIM5_BASE) = TIM_CR1_URS;
    TIM_PSC(TIM5_BASE) = BOARD_CLOCK_MHZ - 1u;
    TIM_ARR(TIM5_BASE) = UINT32_MAX;
    TIM_EGR(TIM5_BASE) = TIM_EGR_UG; /* loads the prescaler */
    TIM_CR1(TIM5_BASE) = TIM_CR1_URS | TIM_CR1_CEN;
    LPTIM_CR = LPTIM_CR_ENABLE;
    LPTIM_ARR = REFERENCE_MAX;
    for (uint32_t us = 0; us < 1000u && !(LPTIM_ISR & LPTIM_ISR_ARROK); us++) { /* a few cycles of LSE */
        board_wait_us(1, BOARD_CLOCK_MHZ);
    }
    LPTIM_CR = LPTIM_CR_ENABLE | LPTIM_CR_CNTSTRT;
}

uint32_t hal_time_us(const hal_t *hal) {
    (void)hal;
    return TIM_CNT(TIM5_BASE);
}

/* Two equal readings of a counter in another clock domain are right (RM0440, LPTIM: counter register). */
static uint16_t reference_count(void) {
    uint32_t count = LPTIM_CNT;
    for (;;) {
        const uint32_t again = LPTIM_CNT;
        if (again == count) {
            return (uint16_t)count;
        }
        count = again;
    }
}

/* The self-test asks every 10 ms, the counter wraps after 2 s. `hal` is the port's own structure. */
uint32_t hal_time_reference_us(const hal_t *hal) {
    (void)hal;
    const uint16_t count = reference_count();
    board.reference_ticks += (uint16_t)(count - board.reference_low);
    board.reference_low = count;
    return (uint32_t)(board.reference_ticks * REFERENCE_US / REFERENCE_TICKS);
}

hal_reset_cause_t hal_reset_cause(const hal_t *hal) {
    return hal->watchdog_reset ? HAL_RESET_WATCHDOG : HAL_RESET_POWER;
}

/* LSI may be 8 % fast or slow: 16.7 to 19.6 ms. */
void hal_watchdog_start(hal_t *hal) {
    IWDG_KR = IWDG_START;
    IWDG_KR = IWDG_UNLOCK;
    IWDG_PR = 0;
    IWDG_RLR = IWDG_COUNTS - 1u;
    while ((IWDG_SR & (IWDG_SR_PVU | IWDG_SR_RVU)) != 0) {
    }
    hal_watchdog_kick(hal);
}

void hal_watchdog_kick(hal_t *hal) {
    (void)hal;
    IWDG_KR = IWDG_RELOAD;
}
