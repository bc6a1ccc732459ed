/* Decides when the watchdog (hal_watchdog.h) may be kicked: when control interrupt, deferred interrupt and background
 * have all advanced since the last kick, in the order in which they have to. */
#ifndef MONITORS_WATCHDOG_MONITOR_H
#define MONITORS_WATCHDOG_MONITOR_H

#include <stdbool.h>
#include <stdint.h>

/* Least time between two kicks: not fewer than 20 control periods. */
#define WATCHDOG_KICK_US 1000u

/* Parts of a call of the background, in their order. */
typedef enum {
    WATCHDOG_CHECKED = 1, /* the slow checks are evaluated */
    WATCHDOG_STORED,      /* the memory is kept */
    WATCHDOG_SERVED,      /* frames are received and sent */
} watchdog_part_t;

/* Digits of the sequence of passed parts: of more than 16 parts the last ones, none of which is 0. */
#define WATCHDOG_PART_BITS 2

typedef struct {
    uint32_t periods;   /* control interrupts at the last kick, modulo 2^32 */
    uint32_t completed; /* deferred steps likewise */
    uint32_t kicked_us;
    uint32_t passed; /* parts of the present call of the background, the last in the lowest bits */
    bool disordered; /* for ever: a part came before its turn */
} watchdog_monitor_t;

/* A part of the background's call has ended. [background] */
static inline void watchdog_monitor_pass(watchdog_monitor_t *monitor, watchdog_part_t part) {
    monitor->passed = monitor->passed << WATCHDOG_PART_BITS | (uint32_t)part;
}

/* End of a call of the background: true when the watchdog is to be kicked. periods, requests, completed: control
 * interrupts, and deferred steps requested and completed, since start, modulo 2^32. [background] */
bool watchdog_monitor_kick(watchdog_monitor_t *monitor, uint32_t periods, uint32_t requests, uint32_t completed,
                           uint32_t time_us);

#endif
