/* The emulated CAN bus on the rig's clock, and frames on their way to board and clients. */
#ifndef RIG_BUS_EVENTS_H
#define RIG_BUS_EVENTS_H

#include <stdint.h>

#include "rig/rig_state.h"

/* Handlers of EVENT_CAN, of the first rig, and EVENT_TRUTH; context is the rig. */
void bus_event(void *context, uint64_t now_ns);
void truth_event(void *context, uint64_t now_ns);

#endif
