#include "rig/dynamometer.h"

#include <math.h>

#include "rig_codec.h"

#define RAD_S_PER_RPM (3.14159265358979323846 / 30.0)
#define S_PER_NS 1e-9

static bool is_free(double speed_rpm) {
    return speed_rpm == rig_set_held_speed_rpm_decode(RIG_SET_HELD_SPEED_RPM_FREE_CHOICE);
}

void dynamometer_init(rig_t *rig) {
    rig->held_speed_rpm = rig_set_held_speed_rpm_decode(RIG_SET_HELD_SPEED_RPM_FREE_CHOICE);
    rig->shaft_locked = false;
}

void dynamometer_lock(rig_t *rig, bool locked) {
    plant_advance(&rig->plant, rig->board.time_ns);
    if (locked && !rig->shaft_locked) {
        plant_lock(&rig->plant);
        rig->scheduler.due_ns[EVENT_DYNAMOMETER] = SCHEDULER_NEVER;
    }
    const bool unlocks = rig->shaft_locked && !locked;
    rig->shaft_locked = locked;
    if (unlocks) {
        dynamometer_set_speed(rig, rig->held_speed_rpm);
    }
}

void dynamometer_set_speed(rig_t *rig, double speed_rpm) {
    rig->held_speed_rpm = speed_rpm;
    if (rig->shaft_locked) {
        return;
    }
    plant_t *plant = &rig->plant;
    uint64_t *due_ns = &rig->scheduler.due_ns[EVENT_DYNAMOMETER];
    plant_advance(plant, rig->board.time_ns);
    *due_ns = SCHEDULER_NEVER;
    if (is_free(speed_rpm)) {
        plant_release(plant);
        return;
    }
    rig->held_speed_rad_s = speed_rpm * RAD_S_PER_RPM;
    const double way_rad_s = rig->held_speed_rad_s - plant->speed_rad_s;
    const double duration_ns = ceil(fabs(way_rad_s) / (DYNAMOMETER_RPM_S * RAD_S_PER_RPM * S_PER_NS));
    if (duration_ns == 0.0) {
        plant_hold(plant, rig->held_speed_rad_s, 0.0);
        return;
    }
    plant_hold(plant, plant->speed_rad_s, way_rad_s / (duration_ns * S_PER_NS));
    *due_ns = rig->board.time_ns + (uint64_t)duration_ns;
}

void dynamometer_event(void *context, uint64_t now_ns) {
    rig_t *rig = context;
    plant_advance(&rig->plant, now_ns);
    plant_hold(&rig->plant, rig->held_speed_rad_s, 0.0); /* exactly, without the rounding of the acceleration */
    rig->scheduler.due_ns[EVENT_DYNAMOMETER] = SCHEDULER_NEVER;
}
