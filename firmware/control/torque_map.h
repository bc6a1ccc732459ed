/* Phase torque from angle and current, and the current for a torque: the machine's map, bilinearly interpolated. */
#ifndef CONTROL_TORQUE_MAP_H
#define CONTROL_TORQUE_MAP_H

#include <stdint.h>

#include "control/machine_tables.h"

/* Largest current of the map, A in Q7.9. */
#define TORQUE_MAP_CURRENT_MAX_Q9 ((MACHINE_TORQUE_CURRENTS - 1) << MACHINE_TORQUE_COLUMN_BITS)

/* Torque of one phase in N m, Q7.24. Angle of the phase: 2^-32 rotor pitch, 0 aligned, 2^31 unaligned, torque positive
 * from there on; negative in the first half by mirror symmetry. Current in A, Q7.9, held from 0 to 1 LSB below 80 A.
 * Interpolation exact to 2^-14 N m (16 bits of the angle within a row); what the map itself leaves out is stated by its
 * test. 64-bit accumulator. */
int32_t torque_map_torque_q24(const machine_tables_t *tables, uint32_t phase_angle, int32_t current_q9);

/* The current in A, Q7.9, that gives a torque (N m, Q7.24) at an angle of the second half pitch
 * (2^31..2^32-1); 0 for no torque, 80 A where the map does not reach it. Truncated: within 2^-9 A of the
 * map's inverse. */
int32_t torque_map_current_q9(const machine_tables_t *tables, uint32_t phase_angle, int32_t torque_q24);

#endif
