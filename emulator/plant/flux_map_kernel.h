/* Co-energy of flux_map.h and its derivatives, inlined into the integrator as part of magnetics_kernel.h. Additions and
 * multiplications only: equal bits on every computer. */
#ifndef PLANT_FLUX_MAP_KERNEL_H
#define PLANT_FLUX_MAP_KERNEL_H

#include <math.h>
#include <stdint.h>

#include "plant/magnetics.h"

#define MAGNETICS_INLINE static inline __attribute__((always_inline))

/* Values of the uniform B-splines that are not zero at position t, 0..1, of an interval, by degree. */
typedef struct {
    double linear[2], quadratic[3], cubic[4], quartic[5];
} flux_map_weights_t;

/* De Boor's recursion, with the terms symmetric in t and u written out. */
MAGNETICS_INLINE void flux_map_weights(double t, flux_map_weights_t *weights) {
    const double u = 1.0 - t, tu = t * u;
    double *w2 = weights->quadratic, *w3 = weights->cubic, *w4 = weights->quartic;
    weights->linear[0] = u;
    weights->linear[1] = t;
    w2[0] = 0.5 * (u * u);
    w2[1] = 0.5 + tu;
    w2[2] = 0.5 * (t * t);
    w3[0] = (1.0 / 3.0) * (u * w2[0]);
    w3[1] = 2.0 / 3.0 - w2[2] * (2.0 - t);
    w3[2] = 2.0 / 3.0 - w2[0] * (2.0 - u);
    w3[3] = (1.0 / 3.0) * (t * w2[2]);
    w4[0] = 0.25 * (u * w3[0]);
    w4[1] = 0.25 * ((t + 3.0) * w3[0] + (u + 1.0) * w3[1]);
    w4[2] = 11.0 / 24.0 + tu * (0.5 + 0.25 * tu);
    w4[3] = 0.25 * ((t + 1.0) * w3[2] + (u + 3.0) * w3[3]);
    w4[4] = 0.25 * (t * w3[3]);
}

/* Interval of a position on the grid; positions outside belong to the first or the last one. */
MAGNETICS_INLINE int64_t flux_map_interval(double position, int64_t intervals) {
    const int64_t interval = (int64_t)position;
    return interval < 0 ? 0 : interval >= intervals ? intervals - 1 : interval;
}

MAGNETICS_INLINE double flux_map_value(const flux_map_weights_t *weights, const double c[4]) {
    const double *w = weights->cubic;
    return (w[0] * c[0] + w[1] * c[1]) + (w[2] * c[2] + w[3] * c[3]);
}

MAGNETICS_INLINE double flux_map_gradient(const flux_map_weights_t *weights, const double c[4]) {
    const double *w = weights->quadratic;
    return w[0] * (c[1] - c[0]) + w[1] * (c[2] - c[1]) + w[2] * (c[3] - c[2]);
}

MAGNETICS_INLINE double flux_map_curvature(const flux_map_weights_t *weights, const double c[4]) {
    const double *w = weights->linear;
    return w[0] * ((c[2] - c[1]) - (c[1] - c[0])) + w[1] * ((c[3] - c[2]) - (c[2] - c[1]));
}

/* Operating point and co-energy at an angle within half a pole pitch of the aligned position. Evaluated first along the
 * current, for all four B-splines over the angle, then along the angle. Coefficients are subtracted before they are
 * weighted, because their differences are small compared with the coefficients. */
MAGNETICS_INLINE void flux_map_kernel(const magnetics_model_t *model, double wrapped_rad, double current_A,
                                      magnetics_point_t *point, double *coenergy_J) {
    const double across = fabs(wrapped_rad) * model->map_steps_1_rad;
    const double reached = current_A * model->map_steps_1_A;
    const double along = reached > FLUX_MAP_CURRENT_INTERVALS ? FLUX_MAP_CURRENT_INTERVALS : reached;
    const int64_t column = flux_map_interval(across, FLUX_MAP_ANGLE_INTERVALS);
    const int64_t row = flux_map_interval(along, FLUX_MAP_CURRENT_INTERVALS);
    flux_map_weights_t by_current, by_angle;
    flux_map_weights(along - (double)row, &by_current);
    flux_map_weights(across - (double)column, &by_angle);

    /* Co-energy and its derivatives with respect to the current, per step of the grid. */
    double energy[4], flux[4], inductance[4], slope[4];
    const double *w1 = by_current.linear, *w2 = by_current.quadratic, *w3 = by_current.cubic, *w4 = by_current.quartic;
    for (unsigned k = 0; k < 4; k++) {
        const double(*rows)[FLUX_MAP_ANGLE_INTERVALS + 3] = &model->map->coenergy_J[row];
        const double *c0 = &rows[0][column], *c1 = &rows[1][column], *c2 = &rows[2][column], *c3 = &rows[3][column],
                     *c4 = &rows[4][column];
        const double d0 = c1[k] - c0[k], d1 = c2[k] - c1[k], d2 = c3[k] - c2[k], d3 = c4[k] - c3[k];
        const double e0 = d1 - d0, e1 = d2 - d1, e2 = d3 - d2;
        energy[k] = w4[0] * c0[k] + w4[1] * c1[k] + w4[2] * c2[k] + w4[3] * c3[k] + w4[4] * c4[k];
        flux[k] = w3[0] * d0 + w3[1] * d1 + w3[2] * d2 + w3[3] * d3;
        inductance[k] = w2[0] * e0 + w2[1] * e1 + w2[2] * e2;
        slope[k] = w1[0] * (e1 - e0) + w1[1] * (e2 - e1);
    }
    if (reached > FLUX_MAP_CURRENT_INTERVALS) {
        const double beyond = reached - FLUX_MAP_CURRENT_INTERVALS;
        for (unsigned k = 0; k < 4; k++) {
            energy[k] += beyond * (flux[k] + 0.5 * beyond * inductance[k]);
            flux[k] += beyond * inductance[k];
            slope[k] = 0.0;
        }
    }

    const double a = copysign(model->map_steps_1_rad, wrapped_rad), s = model->map_steps_1_A;
    const double g = model->map_gain, ga = g * a, gs = g * s, gss = gs * s, gsa = gs * a;
    *coenergy_J = g * flux_map_value(&by_angle, energy);
    point->torque_Nm = ga * flux_map_gradient(&by_angle, energy);
    point->torque_gradient_Nm_rad = ga * a * flux_map_curvature(&by_angle, energy);
    point->flux_linkage_Wb = gs * flux_map_value(&by_angle, flux);
    point->flux_gradient_Wb_rad = gsa * flux_map_gradient(&by_angle, flux);
    point->flux_curvature_Wb_rad2 = gsa * a * flux_map_curvature(&by_angle, flux);
    point->incremental_inductance_H = gss * flux_map_value(&by_angle, inductance);
    point->inductance_gradient_H_rad = gsa * s * flux_map_gradient(&by_angle, inductance);
    point->inductance_slope_H_A = gss * s * flux_map_value(&by_angle, slope);
}

#endif
