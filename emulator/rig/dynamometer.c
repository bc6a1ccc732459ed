#include "rig/dynamometer.h"

#include <math.h>

#include "plant/units.h"
#include "rig_codec.h"

static bool is_free(double speed_rpm) {
    return speed_rpm == rig_set_held_speed_rpm_decode(RIG_SET_HELD_SPEED_RPM_FREE_CHOICE);
}

void dynamometer_init(dynamometer_t *dynamometer, plant_t *plant, scheduler_t *scheduler) {
    *dynamometer = (dynamometer_t){.plant = plant,
                                   .scheduler = scheduler,
                                   .speed_rpm = rig_set_held_speed_rpm_decode(RIG_SET_HELD_SPEED_RPM_FREE_CHOICE)};
}

static uint64_t now_ns(const dynamometer_t *dynamometer) {
    return *dynamometer->scheduler->clock_ns;
}

void dynamometer_lock(dynamometer_t *dynamometer, bool locked) {
    plant_advance(dynamometer->plant, now_ns(dynamometer));
    if (locked && !dynamometer->locked) {
        plant_lock(dynamometer->plant);
        dynamometer->scheduler->due_ns[EVENT_DYNAMOMETER] = SCHEDULER_NEVER;
    }
    const bool unlocks = dynamometer->locked && !locked;
    dynamometer->locked = locked;
    if (unlocks) {
        dynamometer_set_speed(dynamometer, dynamometer->speed_rpm);
    }
}

void dynamometer_set_speed(dynamometer_t *dynamometer, double speed_rpm) {
    dynamometer->speed_rpm = speed_rpm;
    if (dynamometer->locked) {
        return;
    }
    plant_t *plant = dynamometer->plant;
    uint64_t *due_ns = &dynamometer->scheduler->due_ns[EVENT_DYNAMOMETER];
    plant_advance(plant, now_ns(dynamometer));
    *due_ns = SCHEDULER_NEVER;
    if (is_free(speed_rpm)) {
        plant_release(plant);
        return;
    }
    dynamometer->speed_rad_s = speed_rpm * RAD_S_PER_RPM;
    const double way_rad_s = dynamometer->speed_rad_s - plant->speed_rad_s;
    const double duration_ns = ceil(fabs(way_rad_s) / (DYNAMOMETER_RPM_S * RAD_S_PER_RPM * S_PER_NS));
    if (duration_ns == 0.0) {
        plant_hold(plant, dynamometer->speed_rad_s, 0.0);
        return;
    }
    plant_hold(plant, plant->speed_rad_s, way_rad_s / (duration_ns * S_PER_NS));
    *due_ns = now_ns(dynamometer) + (uint64_t)duration_ns;
}

void dynamometer_end_acceleration(dynamometer_t *dynamometer) {
    plant_advance(dynamometer->plant, now_ns(dynamometer));
    /* Exactly, without the rounding of the acceleration. */
    plant_hold(dynamometer->plant, dynamometer->speed_rad_s, 0.0);
    dynamometer->scheduler->due_ns[EVENT_DYNAMOMETER] = SCHEDULER_NEVER;
}
