/* The judge of a run: all checkers of the table, what they observe, and what they have found. */
#ifndef CAMPAIGN_CHECKERS_H
#define CAMPAIGN_CHECKERS_H

#include <stddef.h>

#include "campaign/observation.h"

#define CHECKERS_VIOLATIONS_MAX 32
#define CHECKERS_STATE_BYTES 2048
#define CHECKERS_SECTORS 6
#define CHECKERS_STATES 4
#define CHECKERS_CELLS (OBSERVATION_KINDS_MAX * CHECKERS_STATES * CHECKERS_SECTORS)

typedef struct {
    const char *rule; /* name of the checker */
    uint64_t time_us;
    unsigned number; /* way to violate it, cause or phase */
    double value;
} checkers_violation_t;

typedef struct {
    observation_t seen;
    unsigned violations;
    checkers_violation_t violation[CHECKERS_VIOLATIONS_MAX];
    uint8_t cell[CHECKERS_CELLS / 8]; /* reached: (fault, state of the drive, sector of phase a) */
    uint64_t millisecond_ns;          /* last call of on_millisecond */
    max_align_t state[CHECKERS_STATE_BYTES / sizeof(max_align_t)];
} checkers_t;

/* False when the states of the checkers have no room. */
bool checkers_start(checkers_t *checkers, const world_t *world, const plant_t *plant, uint64_t period_ns);

/* Events of the run, as of observation.h. */
void checkers_on_look(checkers_t *checkers);
void checkers_on_interrupt(checkers_t *checkers, observation_drive_t drive);
void checkers_on_reset(checkers_t *checkers, uint64_t time_ns, observation_drive_t drive);
void checkers_on_command(checkers_t *checkers, uint64_t time_ns, const sender_meaning_t *meaning);
void checkers_on_frame(checkers_t *checkers, uint64_t time_ns, unsigned identifier, const uint8_t data[8]);
void checkers_on_fault(checkers_t *checkers, unsigned kind, bool begins);
void checkers_at_end(checkers_t *checkers, observation_heat_t heat);

#endif
