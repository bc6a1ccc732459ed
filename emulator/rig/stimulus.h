/* Bench variables (rig.dbc): changes them on RIG_SET, now or at a virtual time. */
#ifndef RIG_STIMULUS_H
#define RIG_STIMULUS_H

#include <stdint.h>

#include "rig/rig_state.h"

/* Fields of RIG_SET_REPLY. */
typedef struct {
    uint8_t variable; /* multiplex number as received */
    uint8_t status;   /* RIG_SET_REPLY_STATUS_*_CHOICE */
    uint32_t at_us;   /* as received */
} stimulus_reply_t;

/* Takes the data of a RIG_SET: changes the variable when its time is 0 or the present, else schedules the change. */
stimulus_reply_t stimulus_receive(rig_t *rig, const uint8_t *data);

/* Handler of EVENT_BENCH_VARIABLE; context is the rig. */
void stimulus_event(void *context, uint64_t now_ns);

#endif
