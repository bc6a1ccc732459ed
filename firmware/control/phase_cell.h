/* Phase cell: torque and flux linkage of a phase between two columns of the machine tables, at one angle, as parabolas
 * of the current.
 *
 *   y(u) = middle + u (rise + u curvature),   u = (i - i_middle) / column width
 *
 * exactly what phase_map.h interpolates for u in -1/2..1/2, because value_T and value_psi are linear in the current
 * between columns and the result is their product with the current. Beyond, T / i and psi / i continue linearly; the
 * error there is stated by tests/unit/control/test_phase_cell.cpp.
 *
 * Torque over flux linkage, to second order, with v = (psi - psi_middle) / rise_psi = u + u^2 c_psi / rise_psi:
 *
 *   T(v) = T_middle + v (rise_T + v c),   c = c_T - rise_T c_psi / rise_psi
 *
 * and its inverse by two steps of Newton's method from v = 0, v1 = r / rise_T, v2 = (r + c v1^2) / (rise_T + 2 c v1)
 * with r = T - T_middle. Derived here. No loop and no number of iterations depends on data. Units of the tables, as
 * phase_map.h. */
#ifndef CONTROL_PHASE_CELL_H
#define CONTROL_PHASE_CELL_H

#include <stdbool.h>
#include <stdint.h>

#include "control/machine_tables.h"
#include "control/phase_map.h"

#define PHASE_CELL_COLUMN_MAX (MACHINE_COLUMNS - 2)

/* u and v in Q2.13, saturated to -4..4 - 2^-13, three columns and a half beyond the cell: with two columns a voltage
 * limited machine overshot its torque limit by 8 % (tests/hil/test_salient_controller.py). */
#define PHASE_CELL_BITS 16
#define PHASE_CELL_REACH 3 /* whole columns beyond the cell */
#define PHASE_CELL_V_MAX_Q13 ((1 << (PHASE_CELL_BITS - 1)) - 1)
#define PHASE_CELL_FIRST_BITS 15 /* of the first step of the inverse: -2..2 */
#define PHASE_CELL_RATIO_BITS 14 /* c_psi / rise_psi, Q2.13, saturated to -1..1: a fraction in any machine */
#define PHASE_CELL_HALF_Q13 (1 << 12)

#define PHASE_CELL_RISE_BITS 26

typedef struct {
    int32_t middle;
    int32_t rise;
    int32_t curvature;
} phase_cell_curve_t;

typedef struct {
    phase_cell_curve_t torque; /* over u */
    phase_cell_curve_t flux;   /* over u */
    int32_t curvature;         /* c of the torque over v */
    int32_t column;
    bool located; /* the cell is known */
    int8_t sign;  /* of the torque: 1 in the half of positive torque, -1 in the other one */
} phase_cell_t;

/* Dividend and divisor of quotients in Q2.13 by a rise. The dividend, y - middle or a curvature, is saturated to 2^25
 * units. The rise, from -2^7 on, is rounded to an odd multiple of 2^8 units, 2 uWb or 0.1 mN m over a column:
 * within 1.5 times that; one of less, or negative by rounding, counts as 2^8. */
ALWAYS_INLINE int32_t phase_cell_dividend(int32_t units) {
    return fixed_saturate_bits(units, PHASE_CELL_RISE_BITS) * (1 << 5);
}

ALWAYS_INLINE int32_t phase_cell_divisor(int32_t rise) {
    return ((rise + (1 << 7)) >> 8) | 1;
}

ALWAYS_INLINE int32_t phase_cell_quotient_q13(int32_t units, int32_t rise, unsigned bits) {
    return fixed_saturate_bits(phase_cell_dividend(units) / phase_cell_divisor(rise), bits);
}

/* Curve from the values at both columns, Q14, and the current of the lower one, A, Q7.9. A value is below 2^31, the
 * width of a column 1/40 of the range: the curvature is below 2^25, and so is the rise of every machine, saturated. */
ALWAYS_INLINE phase_cell_curve_t phase_cell_curve(int32_t low_q14, int32_t high_q14, int32_t low_q9) {
    const int32_t start = phase_map_product(low_q14, low_q9);
    const int32_t end = phase_map_product(high_q14, low_q9 + (1 << MACHINE_COLUMN_BITS));
    const int32_t rise = fixed_saturate_bits(end - start, PHASE_CELL_RISE_BITS);
    const int32_t curvature = (high_q14 - low_q14) >> (32 - 15 - MACHINE_COLUMN_BITS);
    return (phase_cell_curve_t){start + (rise >> 1) - (curvature >> 2), rise, curvature};
}

/* Cell between a column, 0..PHASE_CELL_COLUMN_MAX, and the next, at an angle. */
ALWAYS_INLINE void phase_cell_locate(const machine_tables_t *tables, uint32_t distance, int32_t column,
                                     phase_cell_t *cell) {
    const phase_map_lookup_t lookup = phase_map_lookup(tables, distance);
    const phase_map_nodes_t low = phase_map_nodes(&lookup, (uint32_t)column);
    const int32_t low_q9 = column * (1 << MACHINE_COLUMN_BITS);
    cell->located = true;
    cell->column = column;
    cell->torque = phase_cell_curve(phase_map_torque_value_q14(&lookup, &low, 0),
                                    phase_map_torque_value_q14(&lookup, &low, MACHINE_TO_NEXT_COLUMN), low_q9);
    cell->flux = phase_cell_curve(phase_map_flux_value_q14(&lookup, &low, 0),
                                  phase_map_flux_value_q14(&lookup, &low, MACHINE_TO_NEXT_COLUMN), low_q9);
    const int32_t ratio_q13 = phase_cell_quotient_q13(cell->flux.curvature, cell->flux.rise, PHASE_CELL_RATIO_BITS);
    const int32_t curvature =
        cell->torque.curvature - 2 * fixed_multiply_high(cell->torque.rise, ratio_q13 * (1 << 18));
    cell->curvature = fixed_saturate_bits(curvature, PHASE_CELL_RISE_BITS - 2);
}

/* u of a current in A, Q7.9, 0..2^18: Q2.13, saturated to -4..4. */
ALWAYS_INLINE int32_t phase_cell_u_q13(const phase_cell_t *cell, int32_t current_q9) {
    const unsigned shift = 13 - MACHINE_COLUMN_BITS;
    const int32_t middle_q9 = PHASE_CELL_HALF_Q13 >> shift;
    return fixed_shift_up_saturate_bits(current_q9 - cell->column * (1 << MACHINE_COLUMN_BITS) - middle_q9, shift,
                                        PHASE_CELL_BITS);
}

/* middle + x (rise + x curvature), x in Q2.13, both products rounded to 8 units: within 4 + 4 |x| units. */
ALWAYS_INLINE int32_t phase_cell_evaluate(int32_t middle, int32_t rise, int32_t curvature, int32_t x_q13) {
    const int32_t x_q29 = x_q13 * (1 << 16);
    const int32_t slope = rise + 8 * fixed_multiply_high(curvature, x_q29);
    return middle + 8 * fixed_multiply_high(slope, x_q29);
}

/* Torque and flux linkage at u. */
ALWAYS_INLINE int32_t phase_cell_curve_at(const phase_cell_curve_t *curve, int32_t u_q13) {
    return phase_cell_evaluate(curve->middle, curve->rise, curve->curvature, u_q13);
}

/* Torque at v, and the v of a torque. */
ALWAYS_INLINE int32_t phase_cell_torque(const phase_cell_t *cell, int32_t v_q13) {
    return phase_cell_evaluate(cell->torque.middle, cell->torque.rise, cell->curvature, v_q13);
}

ALWAYS_INLINE int32_t phase_cell_solve_q13(const phase_cell_t *cell, int32_t torque) {
    const int32_t rest = phase_cell_dividend(fixed_subtract(torque, cell->torque.middle));
    const int32_t rise = phase_cell_divisor(cell->torque.rise);
    const int32_t curvature = cell->curvature >> 8; /* in the unit of the divisor */
    const int32_t first_q13 = fixed_saturate_bits(rest / rise, PHASE_CELL_FIRST_BITS);
    const int32_t slope = (rise + ((curvature * first_q13) >> 12)) | 1;
    const int32_t dividend = rest + curvature * ((first_q13 * first_q13) >> 13);
    return fixed_saturate_bits(dividend / slope, PHASE_CELL_BITS);
}

/* Flux linkage at v, and the v of a flux linkage. */
ALWAYS_INLINE int32_t phase_cell_flux(const phase_cell_t *cell, int32_t v_q13) {
    return cell->flux.middle + 8 * fixed_multiply_high(cell->flux.rise, v_q13 * (1 << 16));
}

ALWAYS_INLINE int32_t phase_cell_v_q13(const phase_cell_t *cell, int32_t flux) {
    return phase_cell_quotient_q13(fixed_subtract(flux, cell->flux.middle), cell->flux.rise, PHASE_CELL_BITS);
}

/* Columns from the middle of the cell to y along the straight line through the middle, Q4, rounded towards zero. */
ALWAYS_INLINE int32_t phase_cell_distance_q4(const phase_cell_curve_t *curve, int32_t y) {
    const int32_t rise_q4 = curve->rise >> 4;
    return fixed_subtract(y, curve->middle) / (rise_q4 > 0 ? rise_q4 : 1);
}

#endif
