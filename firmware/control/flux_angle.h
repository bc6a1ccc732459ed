/* Misalignment by flux linkage: the angle that the encoder is off by, from the phases alone, whatever the load does.
 *
 * The flux linkage that the voltage has built up in a phase (flux_residual.h) differs from the tables' at the
 * measured current and angle, psi, by
 *
 *   psi - psi(voltage) = delta D + a psi + b (integral of R i) + c t,   D = psi(angle + s / 2) - psi(angle - s / 2)
 *
 * delta is the misalignment in steps s, relative to the angle at which psi was taken; a, b and c are the errors of the
 * machine's flux linkage, of the resistance and of the voltage, drops of the devices above all, t the time for which
 * the phase has conducted. Over a stroke the four have different courses, so that least squares tell them apart,
 * for each phase by itself; old samples are forgotten. The normal equations are solved by elimination, delta last.
 * Derived here. With flux linkage wrong by 10 percent, resistance by 50 and a drop of 1.7 V the angle is right to 0.05
 * degrees (tests/unit/control/test_flux_angle.cpp); an error of the tables' shape, which none of the courses has, shows
 * as an angle. At low speed, where a conduction lasts longer than its samples are remembered, nothing
 * is told.
 */
#ifndef CONTROL_FLUX_ANGLE_H
#define CONTROL_FLUX_ANGLE_H

#include <stdbool.h>
#include <stdint.h>

#include "control/flux_residual.h"
#include "hal.h"

/* Courses of c, b, a and delta, in the order of elimination, and of the left side. */
#define FLUX_ANGLE_COURSES 5

/* Sums of a phase; all zero at the start. */
typedef struct {
    int64_t sum[FLUX_ANGLE_COURSES][FLUX_ANGLE_COURSES];  /* of products, upper triangle */
    uint32_t samples;                                     /* modulo 2^32 */
    uint32_t conduction_samples, last_conduction_samples; /* samples; the former 0 between two */
    int32_t resistive_q29;                                /* integral of R i since the phase has conducted, Wb, Q2.29 */
    int32_t time_q29;                                     /* 1/256 of the DC-link voltage times that time, Wb, Q2.29 */
} flux_angle_t;

/* A sample of a phase, which counts while the rotor turns and the phase conducts at a known psi(voltage); true when the
 * sums are to be solved. [background] */
bool flux_angle_add(flux_angle_t *flux_angle, const flux_residual_t *residual, unsigned index);

/* Misalignment, 2^-32 electrical rev; 0 when the samples do not tell it from the other errors, or come from a part
 * of a conduction. [background] */
int32_t flux_angle_solve(const flux_angle_t *flux_angle);

#endif
