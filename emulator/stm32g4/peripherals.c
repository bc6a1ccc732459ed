/* SPDX-License-Identifier: GPL-2.0-or-later */
#include "stm32g4/peripherals.h"

#include "stm32g4/flash.h"
#include "stm32g4/nvic.h"

void peripherals_attach(void) {
    rcc_attach();
    flash_attach();
    gpio_attach();
    timer_attach();
    adc_attach();
    analog_attach();
    dma_attach();
    fdcan_attach();
    apart_attach();
}

void peripherals_reset(uint32_t cause) {
    rcc_reset(cause);
    flash_reset();
    timer_reset();
    analog_reset();
    adc_reset();
    dma_reset();
    fdcan_reset();
    apart_reset();
    gpio_reset();
}

void peripherals_event(soc_event_t event) {
    switch (event) {
    case EVENT_FLASH:
        flash_event();
        break;
    case EVENT_FDCAN:
        fdcan_event();
        break;
    case EVENT_IWDG:
        apart_watchdog_event();
        break;
    case EVENT_SYSTICK:
        nvic_systick_event();
        break;
    default:
        break;
    }
}
