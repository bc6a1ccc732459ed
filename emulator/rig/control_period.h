/* The control period: sample instants, the control interrupt and the background after it. */
#ifndef RIG_CONTROL_PERIOD_H
#define RIG_CONTROL_PERIOD_H

#include <stdint.h>

#include "rig/rig.h"

/* Schedules the first period, one period from now, when the firmware has started the timer, and the watchdog. */
void control_period_begin(rig_t *rig);

/* Takes the length of the periods after the present one from the timer's register. */
void control_period_set_length(rig_t *rig);

/* Schedules EVENT_CURRENT_HOLD for the next period's sample, ahead of it by the current sensors' delay, limited to one
 * period. Without a delay, or when that instant has passed, the currents at the sample itself will be converted. */
void control_period_schedule_hold(rig_t *rig);

/* Handlers of EVENT_CURRENT_HOLD, EVENT_CONTROL, EVENT_BACKGROUND and EVENT_WATCHDOG; context is the rig. */
void control_period_hold_event(void *context, uint64_t now_ns);
void control_period_start_event(void *context, uint64_t now_ns);
void control_period_background_event(void *context, uint64_t now_ns);
void control_period_watchdog_event(void *context, uint64_t now_ns);

#endif
