/* Phase map: torque and flux linkage of one phase from angle and current.
 *
 *   T = i value_T(angle, i),   psi = i value_psi(angle, i)
 *
 * with the values interpolated in the tables of T / i and psi / i, quadratically over the angle and linearly over the
 * current; machine_tables.h has the formula. Derived here. The error of the interpolation is within three LSBs of a
 * table node; the error of the tables against the machine is stated by tests/unit/control/test_phase_map.cpp. The
 * inverse is phase_cell.h.
 *
 * Results are in units of the tables, 2^result_shift LSBs of Q7.24 (torque) or Q2.29 (flux linkage), machine_format_t:
 * below 2^29 in magnitude, so that the sum of all phases fits; phase_map_scale() converts. No loop depends on data. */
#ifndef CONTROL_PHASE_MAP_H
#define CONTROL_PHASE_MAP_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "control/machine_tables.h"
#include "fixed/compiler.h"
#include "fixed/dual16.h"
#include "fixed/fixed.h"
#include "fixed/formats.h"

/* Largest current of the map, A, Q7.9: 1 LSB below 80 A, so that there is always a column above. */
#define PHASE_MAP_CURRENT_MAX_Q9 (((MACHINE_COLUMNS - 1) << MACHINE_COLUMN_BITS) - 1)

/* Interpolation over the angle, for any number of columns at that angle. */
typedef struct {
    const machine_tables_t *tables;
    uint32_t row;         /* row that begins at or before the angle */
    uint32_t weights_q14; /* of this row's nodes and the next row's, sum 2^14: a dual16_pack() */
    int32_t torque_curvature_q14, flux_curvature_q14; /* u (1 - u) 2^curvature_shift */
} phase_map_lookup_t;

/* Distance of an electrical angle (2^-32 rev, 0 aligned, 2^31 unaligned) from the unaligned position, 0..2^31 - 1. The
 * aligned position counts as 1 LSB before it. */
ALWAYS_INLINE uint32_t phase_map_distance(uint32_t phase_angle) {
    return (uint32_t)fixed_abs((int32_t)(phase_angle - HALF_REV));
}

/* An array of the tables, of a type, moved by a number of bytes: entries at constant distances are one load each. */
#define PHASE_MAP_MOVED(type, tables, array, bytes)                                                                    \
    ((const type *)(const void *)(phase_map_moved(tables, bytes) + offsetof(machine_tables_t, array)))

ALWAYS_INLINE const char *phase_map_moved(const machine_tables_t *tables, int32_t bytes) {
    const char *moved = (const char *)tables + bytes;
    IN_REGISTER(moved);
    return moved;
}

/* True in the half of an electrical revolution in which the torque is negative. */
ALWAYS_INLINE bool phase_map_mirrored(uint32_t phase_angle) {
    return phase_angle < HALF_REV;
}

/* -1 when a row begins after the distance, else 0: both are below 2^31. */
ALWAYS_INLINE int32_t phase_map_before(const machine_row_t *row, uint32_t distance) {
    return (int32_t)(distance - row->start) >> 31;
}

/* Looks up a distance from the unaligned position, 0..2^31 - 1. `tables` must outlive the lookup. */
ALWAYS_INLINE phase_map_lookup_t phase_map_lookup(const machine_tables_t *tables, uint32_t distance) {
    /* At most two rows begin within an angle bin, those after its first; the start of the last row is above every
     * distance. Counted from two rows further on, which takes fewer instructions. */
    const int32_t first = tables->angle_bin_row[distance >> MACHINE_ANGLE_BIN_BITS];
    const machine_row_t *in_bin = PHASE_MAP_MOVED(machine_row_t, tables, row, first * (int32_t)sizeof(machine_row_t));
    const int32_t row = first + phase_map_before(&in_bin[1], distance) + phase_map_before(&in_bin[2], distance);
    const machine_row_t *before = PHASE_MAP_MOVED(machine_row_t, tables, row, row * (int32_t)sizeof(machine_row_t));
    const machine_row_t *at = before + 2;
    /* The reciprocal is rounded down and the distance within the row is below its width: at most one after rounding. */
    const int32_t fraction_q14 = fixed_multiply_high((int32_t)(distance - at->start), at->reciprocal);
    const int32_t curvature_q14 = (fraction_q14 * (ONE_Q14 - fraction_q14)) >> 14;
    return (phase_map_lookup_t){
        .tables = tables,
        .row = (uint32_t)row + 2,
        .weights_q14 = (uint32_t)(ONE_Q14 - fraction_q14) | (uint32_t)fraction_q14 << 16,
        .torque_curvature_q14 = curvature_q14 << tables->torque_format.curvature_shift,
        .flux_curvature_q14 = curvature_q14 << tables->flux_format.curvature_shift,
    };
}

/* Index of a column, 0..MACHINE_COLUMNS - 1, at the row of the lookup. */
ALWAYS_INLINE uint32_t phase_map_index(const phase_map_lookup_t *lookup, uint32_t column) {
    return lookup->row + column * MACHINE_TO_NEXT_COLUMN;
}

/* Nodes and curvatures at a column and row, from the torque of that column on. */
typedef struct {
    const int16_t *node;
    const int8_t *curvature;
} phase_map_nodes_t;

ALWAYS_INLINE phase_map_nodes_t phase_map_nodes(const phase_map_lookup_t *lookup, uint32_t column) {
    /* Counted from two rows before, as in the lookup: the distances are then constants of the loads. */
    const int32_t before = (int32_t)phase_map_index(lookup, column) - 2;
    const int16_t *node = PHASE_MAP_MOVED(int16_t, lookup->tables, node, before * (int32_t)sizeof(int16_t));
    const int8_t *curvature = PHASE_MAP_MOVED(int8_t, lookup->tables, curvature, before);
    return (phase_map_nodes_t){node + 2, curvature + 2};
}

/* T / i and psi / i at nodes, `offset` further on, in node LSBs, Q14: the nodes' part is below 2^30, the curvature's
 * within 2^27. */
ALWAYS_INLINE int32_t phase_map_torque_value_q14(const phase_map_lookup_t *lookup, const phase_map_nodes_t *nodes,
                                                 unsigned offset) {
    return dual16_multiply_add(&nodes->node[offset], lookup->weights_q14, MACHINE_NODE_OFFSET << 14) -
           nodes->curvature[offset] * lookup->torque_curvature_q14;
}

ALWAYS_INLINE int32_t phase_map_flux_value_q14(const phase_map_lookup_t *lookup, const phase_map_nodes_t *nodes,
                                               unsigned offset) {
    return dual16_multiply_add(&nodes->node[offset + MACHINE_TO_FLUX], lookup->weights_q14, MACHINE_NODE_OFFSET << 14) -
           nodes->curvature[offset + MACHINE_TO_FLUX] * lookup->flux_curvature_q14;
}

/* Result in units of the tables: value in Q14 times current in Q9, over 2^17. */
ALWAYS_INLINE int32_t phase_map_product(int32_t value_q14, int32_t current_q9) {
    return fixed_multiply_high(value_q14, current_q9 << 15);
}

/* Result at a current between two columns, whose values are given. */
ALWAYS_INLINE int32_t phase_map_between(int32_t low_q14, int32_t high_q14, int32_t current_q9) {
    const int32_t fraction_q31 = (int32_t)((uint32_t)current_q9 << (32 - MACHINE_COLUMN_BITS) >> 1);
    return phase_map_product(low_q14 + 2 * fixed_multiply_high(high_q14 - low_q14, fraction_q31), current_q9);
}

/* Result in its format from units of the tables; saturates to INT32_MIN or the last unit before INT32_MAX. */
ALWAYS_INLINE int32_t phase_map_scale(const machine_format_t *format, int32_t result) {
    const unsigned shift = format->result_shift;
    return fixed_clamp(result, INT32_MIN >> shift, INT32_MAX >> shift) * (1 << shift);
}

/* Torque in units of the tables, at an electrical angle: positive from unaligned to aligned, negative in the other half
 * by mirror symmetry. Current in A, Q7.9, 0..PHASE_MAP_CURRENT_MAX_Q9. */
NOINLINE int32_t phase_map_torque(const machine_tables_t *tables, uint32_t phase_angle, int32_t current_q9);

/* Slope of the torque at an angle, as the change over `angle_step` (2^-32 electrical rev, below 2^27): N m, Q7.24,
 * saturated. Current as above. */
int32_t phase_map_torque_slope_q24(const machine_tables_t *tables, uint32_t phase_angle, int32_t current_q9,
                                   uint32_t angle_step);

/* Flux linkage, Wb, Q2.29, saturated, at a distance from the unaligned position, 0..2^31 - 1. Any current; it is
 * limited to the range above. */
NOINLINE int32_t phase_map_flux_q29(const machine_tables_t *tables, uint32_t distance, int32_t current_q9);

#endif
