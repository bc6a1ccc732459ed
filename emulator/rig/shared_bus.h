/* The CAN bus that the drives of a list of rigs share, on the clock of the first rig. */
#ifndef RIG_SHARED_BUS_H
#define RIG_SHARED_BUS_H

#include "rig/can_bus.h"
#include "rig/scheduler.h"

typedef struct {
    can_bus_t *bus;
    scheduler_t *scheduler; /* which has EVENT_CAN */
} shared_bus_t;

/* Starts the bus when a frame was queued while it was idle. Required, before time runs on, after everything that may
 * queue frames. */
static inline void shared_bus_start(const shared_bus_t *shared) {
    if (shared->bus->start_requested) {
        can_bus_start(shared->bus, *shared->scheduler->clock_ns);
        shared->scheduler->due_ns[EVENT_CAN] = shared->bus->next_event_ns;
    }
}

#endif
