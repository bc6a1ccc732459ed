/* Which first causes the faults of a world explain. */
#ifndef CAMPAIGN_EXPLANATION_H
#define CAMPAIGN_EXPLANATION_H

#include "campaign/observation.h"

typedef struct {
    bool explained; /* the drive's first cause: by the faults, or true of the plant and not the drive's own work */
    bool any;       /* there is a fault of the bench, the bus or a client */
} explanation_t;

/* In the control interrupt that has latched a fault. */
explanation_t explanation_of_fault(const observation_t *seen);

#endif
