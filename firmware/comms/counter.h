/* Event counters that saturate instead of wrapping to zero. */
#ifndef COMMS_COUNTER_H
#define COMMS_COUNTER_H

#include <stdint.h>

#include "fixed/fixed.h"

/* Adds events; saturates at 65535. */
static inline void counter_add(uint16_t *counter, unsigned events) {
    const unsigned room = (unsigned)UINT16_MAX - *counter;
    *counter = (uint16_t)(*counter + fixed_min_u32(events, room));
}

#endif
