/* Phase map: torque and flux linkage of one phase from angle and current, and the inverse.
 *
 *   T = i value_T(angle, i),   psi = i value_psi(angle, i)
 *
 * with the values interpolated in the tables of T / i and psi / i, quadratically over the angle and linearly over the
 * current; machine_tables.h has the formula. Derived here. The error of the interpolation is within three LSBs of a
 * table node; the error of the tables against the machine is stated by tests/unit/control/test_phase_map.cpp. */
#ifndef CONTROL_PHASE_MAP_H
#define CONTROL_PHASE_MAP_H

#include <stdbool.h>
#include <stdint.h>

#include "control/machine_tables.h"
#include "fixed/compiler.h"

/* Largest current of the map, A, Q7.9: 1 LSB below 80 A, so that there is always a column above. */
#define PHASE_MAP_CURRENT_MAX_Q9 (((MACHINE_COLUMNS - 1) << MACHINE_COLUMN_BITS) - 1)

/* Interpolation weights of an angle, for any number of evaluations at that angle. */
typedef struct {
    const machine_tables_t *tables;
    uint32_t row;         /* row that begins at or before the angle */
    uint32_t weights_q14; /* of this row's nodes and the next row's, sum 2^14: a dual16_pack() */
    int32_t torque_curvature_q14, flux_curvature_q14; /* u (1 - u) 2^curvature_shift */
    bool mirrored;                                    /* angle below 2^31, where the torque is negative */
} phase_map_lookup_t;

/* Looks up an angle of the phase: 2^-32 electrical rev, 0 aligned, 2^31 unaligned. `tables` must outlive the lookup. */
phase_map_lookup_t phase_map_lookup(const machine_tables_t *tables, uint32_t phase_angle);

/* Torque in N m, Q7.24: positive from unaligned to aligned, negative in the other half by mirror symmetry. Current in
 * A, Q7.9, clamped to 0..PHASE_MAP_CURRENT_MAX_Q9. The product with the current is rounded to nearest at 28 bits; the
 * result saturates. */
int32_t phase_map_torque_q24(const phase_map_lookup_t *lookup, int32_t current_q9);

/* Torque as above, in one call, for a current of 0..PHASE_MAP_CURRENT_MAX_Q9. Kept out of line: see fixed/compiler.h.
 */
NOINLINE int32_t phase_map_torque_at_q24(const machine_tables_t *tables, uint32_t phase_angle, int32_t current_q9);

/* Flux linkage in Wb, Q2.29, equal in both halves. Current, rounding and saturation as for the torque. */
int32_t phase_map_flux_q29(const phase_map_lookup_t *lookup, int32_t current_q9);

/* Slope of the torque at an angle, as the change over `angle_step` (2^-32 electrical rev, below 2^27): N m, Q7.24.
 * Current and saturation as for the torque. */
int32_t phase_map_torque_slope_q24(const machine_tables_t *tables, uint32_t phase_angle, int32_t current_q9,
                                   uint32_t angle_step);

/* Operating point of a phase. */
typedef struct {
    uint32_t column;    /* column at or below its current, 0..MACHINE_COLUMNS - 2 */
    int32_t flux_q29;   /* Wb, Q2.29 */
    int32_t torque_q24; /* N m, Q7.24 */
} phase_map_operating_point_t;

/* Constraints on an operating point, by descending priority: flux_min, flux_max, current limit. */
typedef struct {
    int32_t flux_min_q29;     /* Wb, Q2.29, >= 0 */
    int32_t flux_max_q29;     /* Wb, Q2.29, >= flux_min */
    int32_t current_limit_q9; /* A, Q7.9, 0..PHASE_MAP_CURRENT_MAX_Q9 */
} phase_map_constraints_t;

/* Operating point for a torque (N m, Q7.24; negative ones count as 0) at an angle from 2^31, unaligned, to 2^32, or the
 * nearest point within the constraints; true when the torque is reached. At a flux constraint the flux linkage is
 * exactly the constraint; a torque of 0 gives flux_min. Torque and flux linkage of a point agree within 2 mN m.
 *
 * The search starts at the column of *point. Where torque and flux linkage increase with the current the result does
 * not depend on it; the search is short when the current has changed little. */
bool phase_map_solve(const machine_tables_t *tables, uint32_t phase_angle, int32_t torque_q24,
                     const phase_map_constraints_t *constraints, phase_map_operating_point_t *point);

#endif
