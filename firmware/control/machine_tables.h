/* Data of the machine, generated from the machine file. */
#ifndef CONTROL_MACHINE_TABLES_H
#define CONTROL_MACHINE_TABLES_H

#include <stdint.h>

/* Units: the firmware's unit of a quantity is a power of two of the SI unit, chosen for the machine by the generator
 * (tools/src/salient/machine/scaling.py), so that a format's range fits it:
 *
 *   current 2^a A, voltage and flux linkage 2^v V and Wb, torque 2^t N m, speed 2^w rad/s, time s, angle rev
 *
 * and what follows from them: resistance 2^(v-a) ohm, inertia 2^(t-w) kg m^2, friction 2^(t-w) N m s. Where a comment
 * of the firmware says A, V, Wb, N m or rad/s it means these units; with all exponents 0, as for the bundled machines,
 * they are the SI units. Sensor codes, compare values and encoder counts have no unit, so no law depends on a, v and t.
 * Only what joins angle and speed depends on w; the bus has parameters' fraction bits and the DBC's factors of the
 * machine. */

/* Magnetics of a phase: torque and flux linkage per ampere, T / i and psi / i, over angle and current, from the
 * unaligned to the next aligned position and from 0 to 80 A (in the unit of current). T / i is nearly linear in the
 * current and psi / i of an unsaturated machine constant, so that linear interpolation between columns suffices.
 *
 * Rows: angles, chosen by the generator where the torque curve of the machine has the largest curvature: equidistant
 * rows would miss the corners where poles begin to overlap. Columns: currents in equal steps of 2 A, 2^10 in Q7.9.
 *
 * At fraction u from row r to r + 1 and fraction t from column c to c + 1, T = i value_T, psi = i value_psi,
 *
 *   value(r, c, u, t) = (1 - t) f(c) + t f(c + 1)
 *   f(c) = node[r] + u (node[r + 1] - node[r]) - u (1 - u) 2^curvature_shift curvature[r],   of column c
 *
 * Worked example: node[r] = 1000, node[r + 1] = 1400, curvature[r] = 50, curvature_shift = 1, u = 1/2:
 * f = 1000 + 200 - 1/4 * 2 * 50 = 1175. A column c + 1 with f = 1275 and t = 1/4 gives value = 1200. In LSBs of a node
 * (MACHINE_NODE_OFFSET already added), whose weight machine_format_t defines. */
#define MACHINE_ROWS 33
#define MACHINE_COLUMNS 41     /* 0, 2, .. 80 A */
#define MACHINE_COLUMN_BITS 10 /* of current in Q7.9 */
#define MACHINE_ANGLE_BINS 64  /* equal parts of half an electrical revolution, 2^25 each */
#define MACHINE_ANGLE_BIN_BITS 25

/* Row. Starts ascend from 0, unaligned, to 2^31, aligned, by at least 2^17; at most two lie within an angle bin, not
 * counting one at its start. */
typedef struct {
    uint32_t start;     /* 2^-32 electrical rev past the unaligned position */
    int32_t reciprocal; /* 2^46 / width up to the next row, rounded down; 0 in the last row */
} machine_row_t;

/* Nodes, 0..65535, are stored less this offset, as factors of signed 16-bit products. */
#define MACHINE_NODE_OFFSET 32768

/* Layout of nodes and curvatures: for each column the torque of all rows, then the flux linkage of all rows. The nodes
 * of two adjacent rows are adjacent in memory, for a dual 16-bit product. Distances from the torque of a row and column
 * to the flux linkage there, and to the torque of the next column: */
#define MACHINE_TO_FLUX MACHINE_ROWS
#define MACHINE_TO_NEXT_COLUMN (2 * MACHINE_ROWS)

/* Weight of a node's LSB: result = (value_q14 * current_q9 * 2^15 / 2^32) * 2^result_shift, with value_q14 the value in
 * 2^-14 node LSBs; torque in N m, Q7.24, which may exceed its format, or flux linkage in Wb, Q2.29, which does not. */
typedef struct {
    uint8_t curvature_shift; /* 0..8 */
    uint8_t result_shift;    /* 0..12 */
} machine_format_t;

/* Single pulse operation (control/conduction.h): points equidistant in speed per DC-link voltage, the first at
 * standstill. */
#define MACHINE_PULSE_POINTS 17

typedef struct {
    uint16_t lead;          /* turn-on before the start of the half of the wanted torque, 2^-16 electrical rev */
    uint16_t end;           /* turn-off past the start of that half, 2^-16 electrical rev, 0..2^15 */
    uint16_t smooth_torque; /* largest torque without lead and without ripple, N m, Q7.8 */
    uint16_t mean_torque;   /* largest mean torque, N m, Q7.8 */
    uint16_t peak_torque;   /* largest instantaneous sum of all phases with that pulse, N m, Q7.8 */
} machine_pulse_t;

/* For 1/4, 1/2 and 3/4 of the largest mean torque. */
#define MACHINE_PULSE_PARTS 3
#define MACHINE_RIPPLE_OFFSET 32

typedef struct {
    int8_t on;   /* turn-on past the start of the half of the wanted torque, 2^-8 electrical rev; negative: before */
    uint8_t end; /* turn-off past it, 2^-8 electrical rev, 0..128 */
    /* By which the torque reference is raised, part of the largest mean torque, Q1.7, and MACHINE_RIPPLE_OFFSET. */
    uint8_t ripple;
} machine_partial_pulse_t;

/* Windows of torque sharing up to the base speed (tools/src/salient/machine/sharing_window.py): at standstill and at
 * the base speed, for 1/4, 1/2, 3/4 and all of the largest torque that they make at every angle. */
#define MACHINE_SHARING_SPEEDS 2
#define MACHINE_SHARING_PARTS 4

typedef struct {
    int16_t on;  /* turn-on past the start of the half of the wanted torque, 2^-16 electrical rev; negative: before */
    int16_t off; /* turn-off past it, 2^-16 electrical rev; neighbours in the tables differ by less than a quarter */
} machine_sharing_window_t;

#define MACHINE_PARAMETERS_MAX 96

typedef struct {
    uint8_t phases;            /* 3 to 6 */
    uint8_t rotor_poles;       /* electrical revolutions per mechanical revolution */
    uint8_t speed_exponent;    /* w, 0..3 */
    uint16_t current_range_q9; /* full scale of the current sensors, A, unsigned Q7.9 */
    uint16_t voltage_range_q6; /* full scale of the DC-link voltage divider, V, unsigned Q10.6 */
    /* Two devices carry the current of a phase: two of the worse kind, switches or diodes. */
    uint16_t device_drop_most_q6;  /* threshold, V, Q10.6 */
    uint16_t device_resistance_q8; /* slope, parts of the resistance of the winding, Q8.8, up to 64 */
    uint16_t minimum_pulse_ns;     /* of the converter; shorter pulses and gaps of a switch do not act, 0..2000 */
    uint16_t device_drop_q6;       /* of a switch and a diode, through which a phase's current flows, V, Q10.6 */
    int32_t current_slew_rate_A_s; /* di/dt at the unaligned position: supply voltage / inductance */
    /* Below the over-voltage threshold, in which braking torque decreases so that the DC link has room for the fields
     * of the phases: by the voltage of each period, and by its mean. V, Q10.6; 0 for an ideal link. */
    uint16_t fold_back_q6;
    uint16_t mean_fold_back_q6;
    /* The last row twice: the look-up compares two. */
    machine_row_t row[MACHINE_ROWS + 1];
    uint8_t angle_bin_row[MACHINE_ANGLE_BINS]; /* row in which each angle bin begins */
    machine_format_t torque_format;
    machine_format_t flux_format;
    /* Curvature in the interval that begins at the row; 0 in the last row. */
    int8_t curvature[MACHINE_COLUMNS * MACHINE_TO_NEXT_COLUMN];
    int16_t node[MACHINE_COLUMNS * MACHINE_TO_NEXT_COLUMN];
    uint32_t pulse_index_scale;                     /* index in Q8 = ((|speed_q22| * scale) >> 32) / voltage_q6 */
    machine_pulse_t pulse[2][MACHINE_PULSE_POINTS]; /* motoring, braking */
    machine_partial_pulse_t partial_pulse[2][MACHINE_PULSE_PARTS][MACHINE_PULSE_POINTS];
    uint16_t pulse_base_index; /* of the base speed at the nominal voltage, Q8 */
    machine_sharing_window_t sharing[2][MACHINE_SHARING_SPEEDS][MACHINE_SHARING_PARTS]; /* motoring, braking */
    uint16_t sharing_torque; /* largest torque of those windows at standstill, N m, Q7.8, >= 1 */
    /* A braking current stays within its limit under full opposite voltage up to the angle theta_t at which it is
     * psi_t, when psi <= psi_t + V / omega (theta_t - theta); past theta_t, when it is within its limit. Where no angle
     * needs that, theta_t is where psi at the limit falls fastest. */
    uint16_t braking_end[MACHINE_PULSE_POINTS];  /* theta_t past the aligned position, 2^-16 electrical rev */
    uint16_t braking_flux[MACHINE_PULSE_POINTS]; /* psi_t, Wb, Q2.13 (Q2.29 >> 16) */
    /* Rows of storage/parameters.def, by index: default, raw, and fraction bits of a raw value in the SI unit. */
    int32_t parameter_default[MACHINE_PARAMETERS_MAX];
    int8_t parameter_fraction_bits[MACHINE_PARAMETERS_MAX];
    uint32_t control_rate_min_hz; /* 25 periods in an electrical revolution at a highest speed that the file states */
    int32_t speed_reference_max;  /* magnitude of a command, LSBs of DRIVE_COMMAND.speed_reference_rpm */
    int32_t speed_max_q22;        /* highest speed of the machine, to which references are limited, rad/s, Q9.22 */
    uint32_t dbc_hash;            /* of the machine's CAN database, comms/drive.dbc with its factors and ranges */
    uint32_t machine_hash;        /* of the values of the machine file and its map, which tools know the machine by */
} machine_tables_t;

/* The machine. On a target a constant, which the laws are compiled for when a drive is linked; on the host a variable,
 * filled before drive_init: one program serves every machine. */
#ifdef MACHINE_TABLES_VARIABLE
#define MACHINE_TABLES_CONST
#else
#define MACHINE_TABLES_CONST const
#endif
extern MACHINE_TABLES_CONST machine_tables_t machine_tables;

#endif
