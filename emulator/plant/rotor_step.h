/* A step of the rotor, along whose predicted angle the phases are integrated (phase_steps.h). */
#ifndef PLANT_ROTOR_STEP_H
#define PLANT_ROTOR_STEP_H

#include <stdbool.h>
#include <stdint.h>

typedef struct {
    double angle_rad, speed_rad_s, acceleration_rad_s2, jerk_rad_s3; /* at its start */
    double half_rad_s2, half_rad_s3;                                 /* half of the last two */
    uint32_t start_ns; /* after the start of the control period, modulo 2^32 */
    uint64_t length_ns;
    double length_s;
    double ahead_rad;           /* small angle in the direction of motion, see magnetics_kernel_trapezoid */
    double least_rad, most_rad; /* bounds of the angle within it */
    double voltage_V[3];        /* of link and device drops, by the number of switches that are on */
    bool driven;                /* it is positive with both */
    double trip_current_A, current_step_A;
} rotor_step_t;

/* Predicted angle and speed. */
static inline void rotor_at(const rotor_step_t *rotor, double at_s, double *angle_rad, double *speed_rad_s) {
    const double half_rad_s2 = rotor->half_rad_s3 * at_s;
    *angle_rad =
        rotor->angle_rad + at_s * (rotor->speed_rad_s + at_s * (rotor->half_rad_s2 + (1.0 / 3.0) * half_rad_s2));
    *speed_rad_s = rotor->speed_rad_s + at_s * (rotor->acceleration_rad_s2 + half_rad_s2);
}

#endif
