/* Phase cell: torque and flux linkage of a phase between two columns of the machine tables, at one angle, as parabolas
 * of the current, and their inverses.
 *
 *   y(u) = middle + u (rise + u curvature),   u = (i - i_middle) / column width
 *
 * exactly what phase_map.h interpolates for u in -1/2..1/2, because value_T and value_psi are linear in the current
 * between columns and the result is their product with the current. The parabolas are used to half a column beyond, u
 * in -1..1, where their error is that of one more step of linear extrapolation of T / i and psi / i.
 *
 * Inverse: two steps of Newton's method from u = 0, u1 = r / rise, u2 = (r + c u1^2) / (rise + 2 c u1) with r = y -
 * middle. No loop and no number of iterations depends on data. Units of the tables, as phase_map.h. */
#ifndef CONTROL_PHASE_CELL_H
#define CONTROL_PHASE_CELL_H

#include <stdint.h>

#include "control/machine_tables.h"
#include "control/phase_map.h"

#define PHASE_CELL_COLUMN_MAX (MACHINE_COLUMNS - 2)

/* u in Q2.13, saturated to -1..1 - 2^-13. */
#define PHASE_CELL_BITS 14
#define PHASE_CELL_MAX_Q13 ((1 << (PHASE_CELL_BITS - 1)) - 1)
#define PHASE_CELL_HALF_Q13 (1 << 12)

typedef struct {
    int32_t middle;
    int32_t rise;
    int32_t curvature;
} phase_cell_curve_t;

typedef struct {
    phase_cell_curve_t torque;
    phase_cell_curve_t flux;
} phase_cell_t;

/* Curve from the values at both columns, Q14, and the current of the lower one, A, Q7.9. */
ALWAYS_INLINE phase_cell_curve_t phase_cell_curve(int32_t low_q14, int32_t high_q14, int32_t low_q9) {
    const int32_t start = phase_map_product(low_q14, low_q9);
    const int32_t rise = phase_map_product(high_q14, low_q9 + (1 << MACHINE_COLUMN_BITS)) - start;
    const int32_t curvature = (high_q14 - low_q14) >> (32 - 15 - MACHINE_COLUMN_BITS);
    return (phase_cell_curve_t){start + (rise >> 1) - (curvature >> 2), rise, curvature};
}

/* Cell between a column, 0..PHASE_CELL_COLUMN_MAX, and the next. */
ALWAYS_INLINE phase_cell_t phase_cell_at(const phase_map_lookup_t *lookup, int32_t column) {
    const uint32_t low = phase_map_index(lookup, (uint32_t)column);
    const uint32_t high = low + MACHINE_TO_NEXT_COLUMN;
    const int32_t low_q9 = column * (1 << MACHINE_COLUMN_BITS);
    return (phase_cell_t){
        .torque = phase_cell_curve(phase_map_torque_value_q14(lookup, low), phase_map_torque_value_q14(lookup, high),
                                   low_q9),
        .flux =
            phase_cell_curve(phase_map_flux_value_q14(lookup, low), phase_map_flux_value_q14(lookup, high), low_q9),
    };
}

/* y at u, Q2.13. */
ALWAYS_INLINE int32_t phase_cell_evaluate(const phase_cell_curve_t *curve, int32_t u_q13) {
    const int32_t u_q31 = u_q13 * (1 << 18);
    const int32_t slope = curve->rise + 2 * fixed_multiply_high(curve->curvature, u_q31);
    return curve->middle + 2 * fixed_multiply_high(slope, u_q31);
}

/* u of y, Q2.13, saturated. Any y. In tables rise and curvature are below 2^25, because the value of a column is below
 * 2^31 and a column's width 2^-7 of the current's range; the rise is positive but for rounding, and above twice the
 * curvature's part at |u| = 1. Divisors are rounded to 2^8 units, 2 uWb or 0.1 mN m over a column. */
ALWAYS_INLINE int32_t phase_cell_solve_q13(const phase_cell_curve_t *curve, int32_t y) {
    const int32_t rest_q5 = fixed_saturate_bits(fixed_subtract(y, curve->middle), 26) * (1 << 5);
    const int32_t rise = ((curve->rise + (1 << 7)) >> 8) | 1; /* 2^8 units */
    const int32_t curvature = curve->curvature >> 8;
    const int32_t first_q13 = fixed_saturate_bits(rest_q5 / rise, PHASE_CELL_BITS);
    const int32_t slope = (rise + ((curvature * first_q13) >> 12)) | 1;
    const int32_t numerator_q5 = rest_q5 + curvature * ((first_q13 * first_q13) >> 13);
    return fixed_saturate_bits(numerator_q5 / slope, PHASE_CELL_BITS);
}

/* Columns from the middle of the cell to y along the straight line through the middle, Q4, rounded towards zero. */
ALWAYS_INLINE int32_t phase_cell_distance_q4(const phase_cell_curve_t *curve, int32_t y) {
    const int32_t rise_q4 = curve->rise >> 4;
    return fixed_subtract(y, curve->middle) / (rise_q4 > 0 ? rise_q4 : 1);
}

#endif
