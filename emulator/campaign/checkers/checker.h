/* A checker judges one property of a run, from one read-only observation and a state of its own. The observation is up
 * to date when it is called. */
#ifndef CAMPAIGN_CHECKER_H
#define CAMPAIGN_CHECKER_H

#include <stddef.h>

#include "campaign/facts.h"
#include "campaign/observation.h"

/* A frame of the drive, of eight bytes. */
typedef struct {
    unsigned identifier;
    const uint8_t *data;
} checker_frame_t;

/* PDO of a world's drive with its position. */
#define CHECKER_PLACED (0x280u + MASTER_NODE)

typedef struct checker_report checker_report_t;

/* The property is violated now: remembered once for each number, which distinguishes ways to violate it. */
void checker_violated(checker_report_t *report, unsigned number, double value);

/* An event that some run of a campaign must contain has happened. */
void checker_reached(checker_report_t *report, unsigned number);

/* state: of state_size bytes, zeros before the run. Functions may be NULL. */
typedef struct {
    const char *name; /* of the rule, and of the file */
    size_t state_size;
    void (*on_interrupt)(const observation_t *seen, void *state,
                         checker_report_t *report);                                    /* after a control interrupt */
    void (*on_look)(const observation_t *seen, void *state, checker_report_t *report); /* each OBSERVATION_LOOK_NS */
    void (*on_millisecond)(const observation_t *seen, void *state, checker_report_t *report);
    void (*on_frame)(const observation_t *seen, void *state, checker_report_t *report, const checker_frame_t *frame);
    void (*on_fault)(const observation_t *seen, void *state, checker_report_t *report, unsigned kind); /* it begins */
    void (*at_end)(const observation_t *seen, void *state, checker_report_t *report);
} checker_t;

#endif
