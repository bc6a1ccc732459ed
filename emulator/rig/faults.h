/* Faults by place (RIG_FAULT in rig.dbc): begins and ends them, now or at a virtual time.
 *
 * A fault of one kind at one place (phase, leg) exists once. Faults of different kinds act together; two that hold the
 * same quantity do not contradict: a shorted switch conducts even when it is also open, and of two that set the count
 * of one input the last in rig.dbc wins. */
#ifndef RIG_FAULTS_H
#define RIG_FAULTS_H

#include <stdint.h>

#include "rig/rig_state.h"

/* No faults. */
void faults_init(rig_t *rig);

/* Takes the data of a RIG_FAULT: changes the fault when its time is 0 or the present, else schedules the change. The
 * answer is RIG_FAULT_REPLY_STATUS_*_CHOICE. */
uint8_t faults_receive(rig_t *rig, const uint8_t *data);

/* Handler of EVENT_FAULT; context is the rig. */
void faults_event(void *context, uint64_t now_ns);

#endif
