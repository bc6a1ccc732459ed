#include "monitors/watchdog_monitor.h"

#include "fixed/compiler.h"

#define IN_ORDER                                                                                                       \
    (((uint32_t)WATCHDOG_CHECKED << WATCHDOG_PART_BITS | WATCHDOG_STORED) << WATCHDOG_PART_BITS | WATCHDOG_SERVED)

/* [SR-47] */
COLD bool watchdog_monitor_kick(watchdog_monitor_t *monitor, uint32_t periods, uint32_t requests, uint32_t completed,
                                uint32_t time_us) {
    const uint32_t passed = monitor->passed;
    monitor->passed = 0;
    monitor->disordered = monitor->disordered || passed != IN_ORDER;
    if (monitor->disordered || time_us - monitor->kicked_us < WATCHDOG_KICK_US || periods == monitor->periods ||
        completed == monitor->completed || requests - completed > 1u) {
        return false;
    }
    monitor->periods = periods;
    monitor->completed = completed;
    monitor->kicked_us = time_us;
    return true;
}
