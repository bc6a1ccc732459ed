/* Independent watchdog, with a clock of its own: opens every switch and resets the drive when it is not kicked in time.
 */
#ifndef HAL_WATCHDOG_H
#define HAL_WATCHDOG_H

#include "hal.h"

/* Longest time between two kicks. hal_nvm_erase is one, because an erasure may take longer. */
#define HAL_WATCHDOG_TIMEOUT_US 18000u

typedef enum {
    HAL_RESET_POWER, /* power, or the reset line */
    HAL_RESET_WATCHDOG,
} hal_reset_cause_t;

/* Cause of the last reset; constant. [background] */
hal_reset_cause_t hal_reset_cause(const hal_t *hal);

/* Starts the watchdog, which nothing but a reset stops. Called once. [background] */
void hal_watchdog_start(hal_t *hal);

/* Begins the time anew. [background] */
void hal_watchdog_kick(hal_t *hal);

#endif
