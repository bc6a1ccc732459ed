/* How virtual time relates to the wall clock. The only place of the emulator that looks at the wall clock. */
#ifndef RIG_PACING_H
#define RIG_PACING_H

#include <stdbool.h>
#include <stdint.h>

#define PACING_FACTOR_MIN 0.01
#define PACING_FACTOR_MAX 1000.0

typedef enum {
    PACING_LOCKSTEP, /* time moves only as RIG_RUN_UNTIL says */
    PACING_TIMED,    /* `factor` virtual seconds a wall second */
    PACING_FREE,     /* as fast as it goes */
} pacing_kind_t;

typedef struct {
    pacing_kind_t kind;
    double factor; /* of PACING_TIMED; 1 is real time */

    /* The rest is pacing.c's. */
    bool anchored;
    uint64_t anchor_virtual_ns, anchor_wall_ns;
} pacing_t;

/* Reads lockstep, realtime, free or xN (N from PACING_FACTOR_MIN to PACING_FACTOR_MAX); false when it is none. */
bool pacing_parse(pacing_t *pacing, const char *text);

/* PACING_TIMED: sleeps until the wall clock has reached virtual_ns. When it was passed by more than 100 ms (a debugger
 * stopped the program, the machine is too slow), virtual time continues from here instead of racing after it. */
void pacing_wait(pacing_t *pacing, uint64_t virtual_ns);

#endif
