/* The dynamometer: holds the shaft at held_speed_rpm (rig.dbc), whatever the torques, and takes what the machine gives.
 *
 * It accelerates the shaft to a new speed by DYNAMOMETER_RPM_S from the present one; EVENT_DYNAMOMETER ends that. While
 * the shaft is free there are no events, and the plant is advanced as if this file did not exist.
 */
#ifndef RIG_DYNAMOMETER_H
#define RIG_DYNAMOMETER_H

#include <stdbool.h>

#include "plant/plant.h"
#include "rig/scheduler.h"

#define DYNAMOMETER_RPM_S 10000.0

typedef struct {
    plant_t *plant;
    scheduler_t *scheduler; /* with EVENT_DYNAMOMETER */
    double speed_rpm;       /* held_speed_rpm as set */
    double speed_rad_s;     /* where its acceleration ends */
    bool locked;
} dynamometer_t;

/* A free shaft that is not locked. Keeps plant and scheduler. */
void dynamometer_init(dynamometer_t *dynamometer, plant_t *plant, scheduler_t *scheduler);

/* The bench variable held_speed_rpm, from the present time on. */
void dynamometer_set_speed(dynamometer_t *dynamometer, double speed_rpm);

/* Locks the shaft at once, or unlocks it: then held_speed_rpm is as it was last set. */
void dynamometer_lock(dynamometer_t *dynamometer, bool locked);

/* EVENT_DYNAMOMETER: the shaft has the speed at which it is held. */
void dynamometer_end_acceleration(dynamometer_t *dynamometer);

#endif
