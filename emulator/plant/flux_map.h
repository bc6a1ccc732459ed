/* Magnetics by a flux-linkage map of finite elements or of a bench (tools/src/salient/flux_map.py makes it from the
 * points).
 *
 * What the model is: one function, the co-energy W(theta, i), a tensor product of uniform B-splines (C. de Boor, "A
 * Practical Guide to Splines", 1978), cubic in the angle from aligned to unaligned, quartic in the current from 0 to
 * the map's greatest. Flux linkage dW/di, torque dW/dtheta and every other derivative are those of this function, so an
 * integrator finds no energy in it but what it makes itself. W is even about the aligned and about the unaligned
 * position and twice continuously differentiable, in the current three times; the second derivative of the torque by
 * the angle jumps from interval to interval, by little where the map is smooth.
 *
 * Beyond the greatest current the flux linkage goes on straight with its last slope, in W too: the incremental
 * inductance stays continuous, its slope drops to 0. Slightly negative currents continue the first interval's
 * polynomial; large negative ones mean nothing.
 *
 * What it is not: it meets the map's points as far as the steps of the grid allow, not exactly; it does not smooth
 * them, so noise of the map is in the torque, enlarged as a derivative does; it knows no asymmetry of the poles, no
 * coupling between phases, no hysteresis, no temperature. */
#ifndef PLANT_FLUX_MAP_H
#define PLANT_FLUX_MAP_H

/* Equal steps over half a pitch, and from 0 to the greatest current. */
#define FLUX_MAP_ANGLE_INTERVALS 96
#define FLUX_MAP_CURRENT_INTERVALS 64

typedef struct {
    double current_max_A;
    double inductance_min_H; /* of the incremental ones, > 0 */
    double current_scale_A;  /* over which the inductance changes, at most four steps: limits an integrator's */
    /* Coefficients of W: entry [j][k] belongs to the product of the B-splines that start at current step j - 4 and at
     * angle step k - 3. */
    double coenergy_J[FLUX_MAP_CURRENT_INTERVALS + 4][FLUX_MAP_ANGLE_INTERVALS + 3];
} flux_map_t;

#endif
