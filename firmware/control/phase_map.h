/* Magnetics of one phase: torque and flux linkage from angle and current, and back.
 *
 * Of the machine's tables of T / i and psi / i (control/machine_tables.h): quadratic over the angle between rows,
 * linear over the current between columns, times the current. Within three units of the last place that the tables
 * hold; what the tables leave out of a machine is stated by the tests. */
#ifndef CONTROL_PHASE_MAP_H
#define CONTROL_PHASE_MAP_H

#include <stdbool.h>
#include <stdint.h>

#include "control/machine_tables.h"
#include "fixed/compiler.h"

/* Largest current of the map, in Q7.9: the last before 80 A, so that there is always a column above. */
#define PHASE_MAP_CURRENT_MAX_Q9 (((MACHINE_COLUMNS - 1) << MACHINE_COLUMN_BITS) - 1)

/* An angle found in the tables: one search and one multiplication for all that is asked there. */
typedef struct {
    const machine_tables_t *tables;
    uint32_t row;                           /* at or before the angle */
    uint32_t weights_q14;                   /* of this row's nodes and the next row's, which make 2^14: a fixed_pair */
    int32_t torque_bend_q14, flux_bend_q14; /* of the bends: product of the weights */
    bool mirrored;                          /* between aligned and unaligned, where torque is negative */
} phase_map_place_t;

/* Angle of the phase: 2^-32 rotor pitch, 0 aligned, 2^31 unaligned. `tables` must outlive the place. */
phase_map_place_t phase_map_at(const machine_tables_t *tables, uint32_t phase_angle);

/* Torque in N m, Q7.24: positive from unaligned to aligned, negative in the other half by mirror symmetry. Current in
 * A, Q7.9, held within 0..80 A. The product with the current keeps 28 bits, rounded; saturated. */
int32_t phase_map_torque_q24(const phase_map_place_t *place, int32_t current_q9);

/* The same where only the torque is asked for. Current 0..PHASE_MAP_CURRENT_MAX_Q9. Kept out of line: see
 * fixed/compiler.h. */
NOINLINE int32_t phase_map_torque_at_q24(const machine_tables_t *tables, uint32_t phase_angle, int32_t current_q9);

/* Flux linkage in Wb, Q2.29, the same in both halves. Current, product and ends as for the torque. */
int32_t phase_map_flux_q29(const phase_map_place_t *place, int32_t current_q9);

/* By how much the torque rises over so small a turn (2^-32 pitch, below 2^27), of the slope at an angle: N m, Q7.24.
 * Current and ends as for the torque. */
int32_t phase_map_torque_slope_q24(const machine_tables_t *tables, uint32_t phase_angle, int32_t current_q9,
                                   uint32_t turn);

/* What a phase is to have. */
typedef struct {
    uint32_t column; /* of its current, 0..MACHINE_COLUMNS - 2 */
    int32_t flux_q29;
    int32_t torque_q24;
} phase_map_point_t;

/* What it may have. */
typedef struct {
    int32_t lowest_q29;       /* flux linkage in Wb, Q2.29: 0 <= lowest <= highest */
    int32_t highest_q29;      /* which counts more than the current limit */
    int32_t current_limit_q9; /* A, Q7.9, 0..PHASE_MAP_CURRENT_MAX_Q9 */
} phase_map_range_t;

/* The point of a torque (N m, Q7.24; below zero counts as none) at an angle in the half from 2^31, unaligned, to 2^32,
 * or the nearest that the range leaves, whose lowest flux linkage counts most: true when that is the torque itself. At
 * an end of the range's flux linkages the point's is that end, to the bit; no torque is the lowest. The torque that the
 * tables give for the point's flux linkage is the point's within 2 mN m.
 *
 * The search begins at the point's column, and where torque and flux linkage rise with the current it ends at the same
 * point from everywhere; it is short where the current has changed little. */
bool phase_map_reach(const machine_tables_t *tables, uint32_t phase_angle, int32_t torque_q24,
                     const phase_map_range_t *range, phase_map_point_t *point);

#endif
