/* The dynamometer: holds the shaft at held_speed_rpm (rig.dbc), whatever the torques, and takes what the machine gives.
 *
 * It accelerates the shaft to a new speed by DYNAMOMETER_RPM_S from the present one; EVENT_DYNAMOMETER ends that. While
 * the shaft is free there are no events, and the plant is advanced as if this file did not exist.
 */
#ifndef RIG_DYNAMOMETER_H
#define RIG_DYNAMOMETER_H

#include <stdint.h>

#include "rig/rig.h"

#define DYNAMOMETER_RPM_S 10000.0

/* The bench variable of this name, from the present time on. */
void dynamometer_set_speed(rig_t *rig, double speed_rpm);

/* A free shaft that is not locked. */
void dynamometer_init(rig_t *rig);

/* Locks the shaft at once, or unlocks it: then held_speed_rpm is as it was last set. */
void dynamometer_lock(rig_t *rig, bool locked);

/* Handler of EVENT_DYNAMOMETER; context is the rig. */
void dynamometer_event(void *context, uint64_t now_ns);

#endif
