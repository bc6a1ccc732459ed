/* Magnetics from a flux-linkage map, computed by finite elements or measured on a test bench;
 * tools/src/salient/machine/flux_map.py computes the coefficients from the points of the map.
 *
 * Model: one function, the co-energy W(theta, i), a tensor product of uniform B-splines (C. de Boor, "A Practical Guide
 * to Splines", 1978), cubic in the angle from aligned to unaligned, quartic in the current from 0 to the maximum of the
 * map. Flux linkage dW/di, torque dW/dtheta and all other derivatives are taken from this function: the model conserves
 * energy, and only the integrator's own error remains. W is even about the aligned and about the unaligned position,
 * twice continuously differentiable in the angle and three times in the current; the second derivative of the torque
 * with respect to the angle jumps between intervals, slightly where the map is smooth.
 *
 * Beyond the maximum current the flux linkage is extrapolated linearly with its last slope, in W as well: the
 * incremental inductance is continuous, its slope drops to 0. Slightly negative currents continue the polynomial of the
 * first interval; results at large negative currents are meaningless.
 *
 * Limits of the model: the points of the map are approximated within the resolution of the grid, not interpolated
 * exactly, and not smoothed, so that noise of the map appears in the torque, amplified by the differentiation.
 * Asymmetry of the poles, coupling between phases, hysteresis and temperature are not modelled. */
#ifndef PLANT_FLUX_MAP_H
#define PLANT_FLUX_MAP_H

/* Equal steps over half a pole pitch, and from 0 to the maximum current. */
#define FLUX_MAP_ANGLE_INTERVALS 96
#define FLUX_MAP_CURRENT_INTERVALS 64

typedef struct {
    double current_max_A;
    double inductance_min_H; /* smallest incremental inductance, > 0 */
    double current_scale_A;  /* scale on which the inductance changes, at most four current steps; limits integration
                                steps */
    /* Coefficients of W: entry [j][k] belongs to the product of the B-splines that start at current step j - 4 and
     * angle step k - 3. */
    double coenergy_J[FLUX_MAP_CURRENT_INTERVALS + 4][FLUX_MAP_ANGLE_INTERVALS + 3];
} flux_map_t;

#endif
