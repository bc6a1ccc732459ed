/* What the firmware knows of its machine: generated from the machine file at build time. */
#ifndef CONTROL_MACHINE_TABLES_H
#define CONTROL_MACHINE_TABLES_H

#include <stdint.h>

/* Torque of a phase over angle and current. Rows: phase angle from unaligned (row 0) to the next aligned position, 128
 * equal steps of half a rotor pitch. Columns: current from 0 to 80 A in steps of 2 A. A map, not a product of curves,
 * so that measured machines fit as well. The angle is the finer axis: torque is smooth over current, but has corners
 * over angle where poles begin to overlap. */
#define MACHINE_TORQUE_ROW_BITS 24    /* a row is 2^24 of the 2^32 of a pitch */
#define MACHINE_TORQUE_COLUMN_BITS 10 /* a column is 2^10 of current in Q7.9 */
#define MACHINE_TORQUE_ANGLES 129
#define MACHINE_TORQUE_CURRENTS 41

typedef struct {
    uint8_t phases;           /* 3 or 4 */
    uint8_t rotor_poles;      /* electrical turns a mechanical turn */
    int32_t inertia_q30;      /* kg m^2, Q1.30 */
    int32_t friction_q30;     /* N m s, Q1.30 */
    int32_t current_rise_A_s; /* supply voltage over unaligned inductance: A/s */
    int16_t torque_q8[MACHINE_TORQUE_ANGLES][MACHINE_TORQUE_CURRENTS]; /* N m, Q7.8, saturated at 127.996 */
} machine_tables_t;

/* The machine that this image is built for. */
extern const machine_tables_t machine_tables;

#endif
