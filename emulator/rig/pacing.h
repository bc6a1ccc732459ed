/* Relation of virtual time to the wall clock. No other part of the emulator reads the wall clock. */
#ifndef RIG_PACING_H
#define RIG_PACING_H

#include <stdbool.h>
#include <stdint.h>

#define PACING_FACTOR_MIN 0.01
#define PACING_FACTOR_MAX 1000.0

typedef enum {
    PACING_LOCKSTEP, /* time advances on RIG_RUN_UNTIL only */
    PACING_TIMED,    /* `factor` virtual seconds per wall-clock second */
    PACING_FREE,     /* as fast as possible */
} pacing_kind_t;

typedef struct {
    pacing_kind_t kind;
    double factor; /* of PACING_TIMED; 1 is real time */

    /* Private to pacing.c. */
    bool anchored;
    uint64_t anchor_virtual_ns, anchor_wall_ns;
} pacing_t;

/* Parses lockstep, realtime, free or xN (N from PACING_FACTOR_MIN to PACING_FACTOR_MAX); false for any other text. */
bool pacing_parse(pacing_t *pacing, const char *text);

/* PACING_TIMED: sleeps until the wall clock has reached virtual_ns. When it is late by more than 100 ms (a debugger
 * stopped the program, the computer is too slow), pacing restarts from the present time instead of catching up. */
void pacing_wait(pacing_t *pacing, uint64_t virtual_ns);

#endif
