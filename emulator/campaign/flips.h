/* Every bit of the drive's memory, flipped: the drive of the first machine is brought into a state, the process is
 * forked there for each bit, the bit flips in the child between two control periods, and the child goes on with the
 * usual stimuli of that state, judged by the checkers. To them nothing is disturbed, so that every rule holds.
 */
#ifndef CAMPAIGN_FLIPS_H
#define CAMPAIGN_FLIPS_H

#include <stddef.h>

#include "campaign/run.h"

#define FLIPS_ARGUMENTS 5

typedef enum {
    FLIPS_READY, /* not armed, after the start; then a set of parameters, arming, a run, off */
    FLIPS_ARMED, /* for a run, at standstill; then likewise, armed as it is */
    FLIPS_RUN,   /* at a speed, under load; then off */
    FLIPS_FAULT, /* whose cause has gone, with the request to run still there; then off, clear, arming, a run */
    FLIPS_STATES
} flips_state_t;

typedef struct {
    unsigned controller; /* 0..2 */
    flips_state_t state;
    uint32_t first, count, step; /* bits first, first + step, ..., `count` of them, those beyond the end left out;
                                    counted from the lowest bit of the first byte on */
} flips_setting_t;

/* Reads FLIPS_ARGUMENTS words. */
bool flips_parse(flips_setting_t *setting, char *const words[]);

/* Flips the bits of memory, the drive's, of a number of bytes; prints a JSON line of the course without a flip and one
 * for each flip that changes the course, and returns the exit code. */
int flips_all(const flips_setting_t *setting, run_t *run, world_t *world, const world_machine_t *machine,
              const run_drive_t *drive, void *memory, size_t bytes);

#endif
