/* Magnetics of one phase: torque and flux linkage from angle and current, and the current for either.
 *
 * Of the machine's tables of T / i and psi / i (control/machine_tables.h): quadratic over the angle between rows,
 * linear over the current between columns, times the current. Within three units of the last place that the tables
 * hold; what the tables leave out of a machine is stated by the tests. */
#ifndef CONTROL_PHASE_MAP_H
#define CONTROL_PHASE_MAP_H

#include <stdbool.h>
#include <stdint.h>

#include "control/machine_tables.h"

/* Largest current of the map, in Q7.9: the last before 80 A, so that there is always a column above. */
#define PHASE_MAP_CURRENT_MAX_Q9 (((MACHINE_COLUMNS - 1) << MACHINE_COLUMN_BITS) - 1)

/* An angle found in the tables: one search and one multiplication for all that is asked there. */
typedef struct {
    const machine_tables_t *tables;
    uint32_t first;       /* node of the row at or before the angle, column 0 */
    int32_t fraction_q14; /* of the way to the next row, 0..2^14, rounded to nearest */
    int32_t bend_q14;     /* fraction (1 - fraction) */
    bool mirrored;        /* between aligned and unaligned, where torque is negative */
} phase_map_place_t;

/* Angle of the phase: 2^-32 rotor pitch, 0 aligned, 2^31 unaligned. `tables` must outlive the place. */
phase_map_place_t phase_map_at(const machine_tables_t *tables, uint32_t phase_angle);

/* Torque in N m, Q7.24: positive from unaligned to aligned, negative in the other half by mirror symmetry. Current in
 * A, Q7.9, held within 0..80 A. 64-bit product, truncated, saturated. */
int32_t phase_map_torque_q24(const phase_map_place_t *place, int32_t current_q9);

/* Flux linkage in Wb, Q2.29, the same in both halves. Current, product and ends as for the torque. */
int32_t phase_map_flux_q29(const phase_map_place_t *place, int32_t current_q9);

/* The current in A, Q7.9, for a torque in N m, Q7.24: the greatest of its 2 A that does not give more, 0 where the
 * torque is none or of the sign that the phase has not here, the map's end where it does not reach the torque. T / i
 * is counted here in steps of 1/64 of the tables' last place: but for 1/32 of it, times the current of the column
 * above, the torque there is no more than wanted, and one unit of current more gives no less. */
int32_t phase_map_current_of_torque_q9(const phase_map_place_t *place, int32_t torque_q24);

/* The current in A, Q7.9, for a flux linkage in Wb, Q2.29; as for the torque. */
int32_t phase_map_current_of_flux_q9(const phase_map_place_t *place, int32_t flux_q29);

#endif
