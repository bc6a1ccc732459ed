/* Triggers: TIM4 counts the starts of periods, TIM1's updates. Control interrupt: end of the conversions of ADC5, which
 * has the last one. Deferred interrupt: PendSV. */
#include "hal_interrupt.h"
#include "hal_pwm.h"
#include "hal_time.h"
#include "stm32g4/board.h"
#include "stm32g4/core.h"
#include "stm32g4/registers.h"

#define TS_ITR0 0u /* TIM1_TRGO, in all timers */
#define SMS_EXTERNAL_CLOCK 7u

#define PRIORITY_CONTROL 0x00
#define PRIORITY_DEFERRED 0x80
#define PRIORITY_CAN 0xC0 /* it shares nothing with them; a FIFO of 3 frames waits 141 us at 1 Mbit/s */

uint16_t trigger_count(void) {
    return (uint16_t)TIM_CNT(TIM4_BASE);
}

void trigger_start(void) {
    TIM_SMCR(TIM4_BASE) = PUT(TIM_SMCR_TS, TS_ITR0); /* while no mode uses it */
    TIM_SMCR(TIM4_BASE) = PUT(TIM_SMCR_TS, TS_ITR0) | PUT(TIM_SMCR_SMS, SMS_EXTERNAL_CLOCK);
    TIM_CNT(TIM4_BASE) = 0;
    TIM_CR1(TIM4_BASE) = TIM_CR1_CEN;
}

void board_interrupts_enable(hal_t *hal) {
    NVIC_IPR(ADC5_IRQ) = PRIORITY_CONTROL;
    SCB_SHPR3_PENDSV = PRIORITY_DEFERRED;
    NVIC_IPR(FDCAN1_IT0_IRQ) = PRIORITY_CAN;
    if (hal->period_ticks > 0) { /* the drive has started */
        ADC_ISR(ADC5_BASE) = ADC_ISR_JEOC | ADC_ISR_JEOS;
        NVIC_ICPR(ADC5_IRQ) = NVIC_MASK(ADC5_IRQ);
        hal->trigger = hal->trigger_at_end = hal->trigger_reported = trigger_count();
        break_renew();
        NVIC_ISER(ADC5_IRQ) = NVIC_MASK(ADC5_IRQ);
        NVIC_ISER(FDCAN1_IT0_IRQ) = NVIC_MASK(FDCAN1_IT0_IRQ);
    }
    __asm__ volatile("cpsie i" ::: "memory");
}

/* The NVIC keeps a trigger that comes while the interrupt runs; the contract does not make up for it. */
bool control_begin(hal_t *hal) {
    ADC_ISR(ADC5_BASE) = ADC_ISR_JEOC | ADC_ISR_JEOS;
    const uint16_t trigger = trigger_count();
    if (trigger == hal->trigger_at_end) {
        return false;
    }
    hal->trigger = trigger;
    adc_convert_temperature(hal); /* now: at the next trigger it has ended, and delays no sample */
    return true;
}

void control_end(hal_t *hal) {
    hal->trigger_at_end = trigger_count();
}

uint32_t hal_interrupt_missed_triggers(hal_t *hal) {
    const uint16_t passed = (uint16_t)(hal->trigger - hal->trigger_reported);
    hal->trigger_reported = hal->trigger;
    return passed > 0 ? passed - 1u : 0;
}

/* Counter, direction and number of the period belong together when the number and the direction are the same after. */
uint32_t hal_interrupt_elapsed_ticks(const hal_t *hal) {
    uint32_t direction, count;
    uint16_t trigger;
    do {
        trigger = trigger_count();
        direction = TIM_CR1(TIM1_BASE) & TIM_CR1_DIR;
        count = TIM_CNT(TIM1_BASE);
    } while (trigger != trigger_count() || direction != (TIM_CR1(TIM1_BASE) & TIM_CR1_DIR));
    const uint32_t turn = 2u * hal->period_ticks;
    return (uint16_t)(trigger - hal->trigger) * turn + (direction ? turn - count : count);
}

void hal_interrupt_request_deferred(hal_t *hal) {
    (void)hal;
    SCB_ICSR = SCB_ICSR_PENDSVSET;
}

void hal_critical_enter(hal_t *hal) {
    (void)hal;
    __asm__ volatile("cpsid i" ::: "memory");
}

void hal_critical_leave(hal_t *hal) {
    (void)hal;
    __asm__ volatile("cpsie i" ::: "memory");
}
