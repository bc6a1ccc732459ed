/* Course of the counts: the angle that the speed reference has gone through, so that the mean speed is the
 * counts'.
 *
 * While counts are slow, the estimate of the speed lives on the model for most of the time, and each error of the
 * torque, which adds up twice between two edges, makes it wrong. The estimate of the angle does not: it is within the
 * count. So the speed law follows an angle,
 *
 *   reference = w* + l e,   e = integral(w* dt) - angle,   |e| <= 1 count,
 *
 * the integral sliding surface of a position (V. Utkin, J. Guldner, J. Shi, "Sliding Mode Control in Electro-Mechanical
 * Systems", 2nd ed., CRC, 2009). A rotor that stays within e has the mean speed of its counts by construction. Its
 * error decays in the time of a count, l = |w*| / count, which keeps w* + l e between 0 and 2 w*: a course that is
 * ahead or behind neither turns the rotor round nor makes it faster than twice the reference. l is at least 4 / s,
 * which holds a rotor at a reference of 0, and at most 10 / s: what a load step has cost is not made up for by a swing.
 * Beyond a count the course waits for the rotor, as after a load step or at the torque limit.
 */
#ifndef CONTROL_COUNT_COURSE_H
#define CONTROL_COUNT_COURSE_H

#include <stdint.h>

typedef struct {
    int32_t angle_step_q32; /* of load_observer_model_t */
    int32_t least_q22;      /* speed of 4 counts in a second, rad/s, Q9.22 */
    int32_t most_q22;       /* of 10 counts */
    int32_t count;          /* 2^-32 rev */
    uint32_t to_q30;        /* shift of an angle from 2^-32 rev to counts, Q1.30 */
} count_course_parameters_t;

typedef struct {
    uint64_t angle_q64; /* 2^-64 rev, wraps */
} count_course_t;

/* Encoders of 8 to 30 bits; angle_step_q32: of load_observer_model_t. */
count_course_parameters_t count_course_configure(int32_t angle_step_q32, unsigned encoder_bits);

/* Begins at the estimated angle, 2^-32 rev. */
static inline void count_course_begin(count_course_t *course, uint32_t angle) {
    course->angle_q64 = (uint64_t)angle << 32;
}

/* One step of some periods: l e in rad/s, Q9.22, rounded to 4 LSB, from the speed reference in rad/s, Q9.22, and the
 * estimated angle in 2^-32 rev. */
int32_t count_course_step(const count_course_parameters_t *parameters, count_course_t *course, int32_t reference_q22,
                          uint32_t angle, uint32_t periods);

#endif
