/* The program around race.c: when interrupts come, and where the counts go. */
#ifndef RACE_H
#define RACE_H

#include <stdbool.h>
#include <stdint.h>

#include "hal.h"

/* True where a timer triggers the control interrupt at any instruction; else it comes when it is requested. */
bool race_is_timed(void);
void race_request(void);

/* A round of the background begins: waits for a random time, so that the interrupt comes at all points of one. */
void race_round(void);

/* Counts since the start: interrupts, torn parameters, torn commands, torn snapshots; control interrupts during a
 * deferred step, torn inputs, torn results, periods skipped. */
#define RACE_COUNTS 8
void race_report(hal_t *hal, const uint16_t counts[RACE_COUNTS]);

/* A sequence of pseudorandom numbers, 0..511. */
static inline uint32_t race_random(uint32_t *sequence) {
    *sequence = *sequence * UINT32_C(1664525) + UINT32_C(1013904223);
    return *sequence >> 23;
}

static inline void race_delay(uint32_t rounds) {
    for (uint32_t i = rounds; i > 0; i--) {
        __asm__ volatile("");
    }
}

#endif
