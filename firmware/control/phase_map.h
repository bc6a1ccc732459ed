/* Magnetics of one phase: torque and flux linkage from angle and current, and the current for either.
 *
 * Of the machine's tables of T / i and psi / i (control/machine_tables.h): quadratic over the angle between rows, cubic
 * over the current through four columns, times the current. Within two units of the last place that the tables hold;
 * what the tables leave out of a machine is stated by the tests. */
#ifndef CONTROL_PHASE_MAP_H
#define CONTROL_PHASE_MAP_H

#include <stdbool.h>
#include <stdint.h>

#include "control/machine_tables.h"

/* Largest current of the map, 80 A in Q7.9. */
#define PHASE_MAP_CURRENT_MAX_Q9 ((2 * (MACHINE_COLUMNS - 1) - MACHINE_FINE_COLUMNS) << MACHINE_FINE_BITS)

/* An angle found in the tables: one search and one division for all that is asked there. */
typedef struct {
    const machine_tables_t *tables;
    uint32_t row;         /* at or before the angle */
    int32_t fraction_q15; /* of the way to the next row, 0..2^15 */
    int32_t bend_q15;     /* fraction (1 - fraction) */
    bool mirrored;        /* between aligned and unaligned, where torque is negative */
} phase_map_place_t;

/* Angle of the phase: 2^-32 rotor pitch, 0 aligned, 2^31 unaligned. `tables` must outlive the place. */
phase_map_place_t phase_map_at(const machine_tables_t *tables, uint32_t phase_angle);

/* Torque in N m, Q7.24: positive from unaligned to aligned, negative in the other half by mirror symmetry. Current in
 * A, Q7.9, held within 0..80 A. 64-bit accumulator, truncated, saturated. */
int32_t phase_map_torque_q24(const phase_map_place_t *place, int32_t current_q9);

/* Flux linkage in Wb, Q2.29, the same in both halves. Current, accumulator and ends as for the torque. */
int32_t phase_map_flux_q29(const phase_map_place_t *place, int32_t current_q9);

/* The current in A, Q7.9, for a torque in N m, Q7.24: the greatest that does not give more, 0 where the torque is none
 * or of the sign that the phase has not here, 80 A where the map does not reach it. By bisection of the function above:
 * no more than the torque wanted, and one unit of current more gives no less. */
int32_t phase_map_current_of_torque_q9(const phase_map_place_t *place, int32_t torque_q24);

/* The current in A, Q7.9, for a flux linkage in Wb, Q2.29; as for the torque. */
int32_t phase_map_current_of_flux_q9(const phase_map_place_t *place, int32_t flux_q29);

#endif
