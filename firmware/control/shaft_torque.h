/* Torque of a free shaft by its acceleration: the factor by which the torque differs from the tables', from
 * changes of the torque in torque mode, which follow no load.
 *
 * inertia.h has the variance of the torque T and its covariance with A = J0 dw/dt, both less their means over some
 * milliseconds, so that a load that stays the same does not count. In units of the tables, T / s with the scale s in
 * effect, sums over the windows of strong changes give
 *
 *   q = sum of s cov(T, A) / sum of var(T) = s' J0 / J
 *
 * with the true scale s' of the torque. By the energy of the phases the scale is g s' (table_scale.h), g the gain of
 * the current sensors, so that
 *
 *   m = q / (g s') = J0 / (J g)
 *
 * is the factor that is missing, when the inertia is known. It is taken for the sensors' from 1/80, which the
 * sums are right to, up to 1/12 from 1; what differs more is another inertia, and the factor is 1. Derived here. On a
 * dynamometer, which holds the speed, there is no acceleration, and the gain is not observable. */
#ifndef CONTROL_SHAFT_TORQUE_H
#define CONTROL_SHAFT_TORQUE_H

#include <stdbool.h>
#include <stdint.h>

#include "control/inertia.h"

typedef struct {
    uint32_t window;              /* last one that was seen */
    int64_t variance, covariance; /* sums, in units of the tables, (N m)^2, Q14 */
    int32_t factor_q30;           /* m, Q1.30 */
} shaft_torque_t;

typedef struct {
    uint32_t window;                                                        /* number of the last whole one */
    int32_t torque_variance_q14, acceleration_variance_q14, covariance_q14; /* of inertia_t */
    bool counts;           /* the torque follows no load, and the inertia is not known to be another one */
    int32_t in_effect_q30; /* factor of the torque, s m, Q1.30 */
    int32_t scale_q30;     /* by the energy, Q1.30 */
} shaft_torque_sample_t;

/* One sample; the factor is 1 at the start. [background] */
void shaft_torque_step(const inertia_parameters_t *parameters, shaft_torque_t *shaft,
                       const shaft_torque_sample_t *sample);

#endif
