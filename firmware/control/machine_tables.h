/* What the firmware knows of its machine: generated from the machine file at build time. */
#ifndef CONTROL_MACHINE_TABLES_H
#define CONTROL_MACHINE_TABLES_H

#include <stdint.h>

/* Magnetics of a phase over angle and current, from unaligned to the next aligned position and from 0 to 80 A.
 *
 * Rows: angles that the generator chooses where this machine's torque bends most, because corners over the angle, where
 * poles begin to overlap, are what equal steps miss. Columns: currents in steps of 2 A up to 32 A, where iron begins to
 * saturate, and of 4 A from there on. Held is what an ampere gives, T / i and psi / i: nearly straight over the
 * current, constant for a linear machine's flux linkage, so that few columns do. Maps, not products of curves, so that
 * measured machines fit as well. */
#define MACHINE_ROWS 33         /* one more than a power of two */
#define MACHINE_ROW_BITS 17     /* a row starts at a multiple of 2^17 of the 2^32 of a pitch */
#define MACHINE_COLUMNS 29      /* 0, 2, .. 30, 32, 36, .. 80 A */
#define MACHINE_FINE_COLUMNS 16 /* steps of 2 A */
#define MACHINE_FINE_BITS 10    /* 2 A are 2^10 of current in Q7.9 */

/* At fraction u from a row to the next: node + u (next node - node) - u (1 - u) bend. */
typedef struct {
    uint8_t fraction_bits; /* of node and bend alike */
    uint16_t node[MACHINE_ROWS][MACHINE_COLUMNS];
    int16_t bend[MACHINE_ROWS - 1][MACHINE_COLUMNS];
} machine_surface_t;

typedef struct {
    uint8_t phases;                      /* 3 or 4 */
    uint8_t rotor_poles;                 /* electrical turns a mechanical turn */
    int32_t inertia_q30;                 /* kg m^2, Q1.30 */
    int32_t friction_q30;                /* N m s, Q1.30 */
    int32_t current_rise_A_s;            /* supply voltage over unaligned inductance: A/s */
    uint16_t row_start[MACHINE_ROWS];    /* rising from 0, unaligned, to 2^14, aligned */
    machine_surface_t torque_per_ampere; /* N m / A, fraction_bits 6..30 */
    machine_surface_t flux_per_ampere;   /* Wb / A, fraction_bits 11..30 */
} machine_tables_t;

/* The machine that this image is built for. */
extern const machine_tables_t machine_tables;

#endif
