/* Every fault at every control tick: the process is forked before a control interrupt, and the fault begins in the
 * child. A branch lasts 1.5 times the longest time that the drive has taken so far to react to that fault, and until
 * 1 ms after the reaction, or 1 s without one. A fault to which it has once reacted after more than 100 ms, or not
 * at all, begins from then on at the places only whose number from the first is a multiple of 50 ticks or of 10
 * positions.
 */
#ifndef CAMPAIGN_BRANCH_H
#define CAMPAIGN_BRANCH_H

#include "campaign/run.h"

#define BRANCH_ARGUMENTS 6

typedef struct {
    unsigned controller; /* 0..2 */
    double
        speed_rpm; /* 0: starts to 150 r/min from `ticks` positions a degree apart; the fault begins with state run */
    double load_Nm;
    unsigned first, ticks, every; /* every `every`-th tick of `ticks`, from the first on */
} branch_setting_t;

/* Reads BRANCH_ARGUMENTS words. */
bool branch_parse(branch_setting_t *setting, char *const words[]);

/* Runs all branches of the first machine, prints a JSON line for each fault and place, returns the exit code. */
int branch_all(const branch_setting_t *setting, run_t *run, world_t *world, const world_machine_t *machines,
               const run_drive_t *drive);

#endif
