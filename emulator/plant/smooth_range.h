/* Angles of the rotor between two corners of the magnetics, at which a step has to end. */
#ifndef PLANT_SMOOTH_RANGE_H
#define PLANT_SMOOTH_RANGE_H

#include <math.h>
#include <stdbool.h>

#include "plant/magnetics.h"

/* From corner to corner; empty until the first step finds it. */
typedef struct {
    double from_rad, to_rad;
} smooth_range_t;

#define SMOOTH_RANGE_EMPTY                                                                                             \
    (smooth_range_t) {                                                                                                 \
        INFINITY, -INFINITY                                                                                            \
    }

/* The angle is within, and not at a corner. */
static inline bool smooth_range_has(const smooth_range_t *range, double angle_rad) {
    return !(angle_rad < range->from_rad + MAGNETICS_SMOOTH_TOLERANCE_RAD ||
             angle_rad > range->to_rad - MAGNETICS_SMOOTH_TOLERANCE_RAD);
}

/* The corner ahead. From standstill the acceleration alone moves the rotor there. */
static inline double smooth_range_ahead_rad(const smooth_range_t *range, double speed_rad_s,
                                            double acceleration_rad_s2) {
    const bool forward = speed_rad_s > 0.0 || (speed_rad_s == 0.0 && acceleration_rad_s2 > 0.0);
    return forward ? range->to_rad : range->from_rad;
}

/* Shortens a step that passes the corner ahead, at constant acceleration, so that it ends there; true if it does. */
static inline bool smooth_range_shorten(double angle_rad, double speed_rad_s, double acceleration_rad_s2,
                                        double corner_rad, double *step_s) {
    const bool forward = corner_rad > angle_rad;
    const double distance_rad = fabs(corner_rad - angle_rad), along_rad_s = fabs(speed_rad_s);
    const double along_rad_s2 = forward ? acceleration_rad_s2 : -acceleration_rad_s2;
    if (*step_s * (along_rad_s + 0.5 * along_rad_s2 * *step_s) <= distance_rad) {
        return false;
    }
    *step_s = 2.0 * distance_rad / (along_rad_s + sqrt(along_rad_s * along_rad_s + 2.0 * along_rad_s2 * distance_rad));
    return true;
}

#endif
