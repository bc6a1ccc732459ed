/* What the firmware knows of its machine: generated from the machine file at build time. */
#ifndef CONTROL_MACHINE_TABLES_H
#define CONTROL_MACHINE_TABLES_H

#include <stdint.h>

/* Magnetics of a phase over angle and current, from unaligned to the next aligned position and from 0 to 80 A.
 *
 * Rows: angles that the generator chooses where this machine's torque bends most, because corners over the angle, where
 * poles begin to overlap, are what equal steps miss. Columns: currents in equal steps of 2 A, 2^10 of current in Q7.9.
 * Held is what an ampere gives, T / i and psi / i: nearly straight over the current, constant for a linear machine's
 * flux linkage, so that a straight line between columns does. Maps, not products of curves, so that measured machines
 * fit as well. */
#define MACHINE_ROWS 33
#define MACHINE_COLUMNS 41     /* 0, 2, .. 80 A */
#define MACHINE_COLUMN_BITS 10 /* of current in Q7.9 */
#define MACHINE_CELLS 64       /* equal parts of half a pitch, 2^25 of the 2^32 of a pitch */
#define MACHINE_CELL_BITS 25

/* A row. Starts rise from 0, unaligned, to 2^31, aligned, in steps of at least 2^17. */
typedef struct {
    uint32_t start;      /* 2^-32 pitch past the unaligned position */
    uint32_t reciprocal; /* 2^47 over the width up to the next row, rounded down; of the last row 0 */
} machine_row_t;

/* A node is less MACHINE_NODE_OFFSET, so that all 16 bits serve in a signed product. */
#define MACHINE_NODE_OFFSET 32768

/* Over the angle at a current, so that the nodes of two rows lie side by side. At fraction u from a row to the next:
 * node + u (next row's node - node) - u (1 - u) 2^bend_shift bend. */
typedef struct {
    int16_t torque_node[MACHINE_ROWS]; /* T / i */
    int16_t flux_node[MACHINE_ROWS];   /* psi / i */
    int8_t torque_bend[MACHINE_ROWS - 1];
    int8_t flux_bend[MACHINE_ROWS - 1];
} machine_column_t;

/* A value, in Q14 of a node's last place, times current in Q7.9 and 2^15, less the low 32 bits, times 2^result_shift is
 * the result: torque in N m, Q7.24, or flux linkage in Wb, Q2.29. */
typedef struct {
    uint8_t bend_shift;   /* 0..8 */
    uint8_t result_shift; /* 0..12 */
} machine_format_t;

typedef struct {
    uint8_t phases;           /* 3 or 4 */
    uint8_t rotor_poles;      /* electrical turns a mechanical turn */
    int32_t inertia_q30;      /* kg m^2, Q1.30 */
    int32_t friction_q30;     /* N m s, Q1.30 */
    int32_t resistance_q24;   /* ohm, Q7.24 */
    int32_t current_rise_A_s; /* supply voltage over unaligned inductance: A/s */
    machine_row_t row[MACHINE_ROWS];
    uint8_t cell_row[MACHINE_CELLS]; /* the row in which a part of half a pitch begins */
    machine_format_t torque_format;
    machine_format_t flux_format;
    machine_column_t column[MACHINE_COLUMNS];
} machine_tables_t;

/* The machine that this image is built for. */
extern const machine_tables_t machine_tables;

#endif
