/* What the firmware knows of its machine: generated from the machine file at build time. */
#ifndef CONTROL_MACHINE_TABLES_H
#define CONTROL_MACHINE_TABLES_H

#include <stdint.h>

/* Torque of a phase over angle and current. Rows: phase angle from unaligned (row 0) to the next aligned position, 64
 * equal steps of half a rotor pitch. Columns: current from 0 to 80 A in steps of 1 A. A map, not a product of curves,
 * so that measured machines fit as well. */
#define MACHINE_TORQUE_ANGLES 65
#define MACHINE_TORQUE_CURRENTS 81

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
