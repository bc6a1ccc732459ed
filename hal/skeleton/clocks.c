/* Clocks and watchdog. */
#include "hal_time.h"
#include "hal_watchdog.h"
#include "skeleton/board.h"

/* FILL IN: a free-running timer of 32 bits, 1 MHz. */
uint32_t hal_time_us(const hal_t *hal) {
    (void)hal;
    return 0;
}

/* FILL IN: the same time by another oscillator, within 5 %. */
uint32_t hal_time_reference_us(const hal_t *hal) {
    (void)hal;
    return 0;
}

/* FILL IN: reset flags, read before they are cleared. Here: the watchdog, so that the drive starts in a fault. */
hal_reset_cause_t hal_reset_cause(const hal_t *hal) {
    (void)hal;
    return HAL_RESET_WATCHDOG;
}

/* FILL IN: an independent watchdog of HAL_WATCHDOG_TIMEOUT_US. */
void hal_watchdog_start(hal_t *hal) {
    (void)hal;
}

/* FILL IN */
void hal_watchdog_kick(hal_t *hal) {
    (void)hal;
}
