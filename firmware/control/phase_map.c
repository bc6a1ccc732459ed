#include "control/phase_map.h"

#include "fixed/dual16.h"
#include "fixed/fixed.h"
#include "fixed/formats.h"

#define COLUMN_Q9 (1 << MACHINE_COLUMN_BITS)

/* Newton steps of an inverse: the torque starts as a parabola over the current, the flux linkage is nearly linear
 * between columns. */
#define TORQUE_NEWTON_STEPS 2
#define FLUX_NEWTON_STEPS 1

/* Value f of a column, Q14: the nodes' part is below 2^30, the curvature's within 2^27. */
static inline int32_t torque_value_q14(const phase_map_lookup_t *lookup, const machine_column_t *column) {
    const int16_t *nodes = &column->torque_node[lookup->row];
    return dual16_multiply_add(nodes, lookup->weights_q14, MACHINE_NODE_OFFSET << 14) -
           column->torque_curvature[lookup->row] * lookup->torque_curvature_q14;
}

static inline int32_t flux_value_q14(const phase_map_lookup_t *lookup, const machine_column_t *column) {
    const int16_t *nodes = &column->flux_node[lookup->row];
    return dual16_multiply_add(nodes, lookup->weights_q14, MACHINE_NODE_OFFSET << 14) -
           column->flux_curvature[lookup->row] * lookup->flux_curvature_q14;
}

/* Unscaled result, value in Q14 times current in Q9, 0..2^10 MACHINE_COLUMNS, over 2^17: below 2^29. */
static inline int32_t unscaled(int32_t value, int32_t current_q9) {
    return fixed_multiply_high(value, current_q9 << 15);
}

/* Result in its format from an unscaled one, saturated. */
static inline int32_t scale(const machine_format_t *format, int32_t product) {
    const int32_t shifted = (int32_t)((uint32_t)product << format->result_shift);
    return shifted >> format->result_shift == product ? shifted : INT32_MAX ^ (product >> 31);
}

/* Unscaled result at a current between two columns, whose values are given. */
static inline int32_t interpolate_columns(int32_t low_q14, int32_t high_q14, int32_t current_q9) {
    const int32_t fraction_q31 = (int32_t)((uint32_t)current_q9 << (32 - MACHINE_COLUMN_BITS) >> 1);
    return unscaled(low_q14 + 2 * fixed_multiply_high(high_q14 - low_q14, fraction_q31), current_q9);
}

/* Curve at a column: value and unscaled result. */
typedef struct {
    int32_t value_q14;
    int32_t product;
} node_t;

static inline node_t torque_node(const phase_map_lookup_t *lookup, uint32_t column) {
    const int32_t value = torque_value_q14(lookup, &lookup->tables->column[column]);
    return (node_t){value, unscaled(value, (int32_t)(column << MACHINE_COLUMN_BITS))};
}

static inline node_t flux_node(const phase_map_lookup_t *lookup, uint32_t column) {
    const int32_t value = flux_value_q14(lookup, &lookup->tables->column[column]);
    return (node_t){value, unscaled(value, (int32_t)(column << MACHINE_COLUMN_BITS))};
}

/* Unscaled result between two columns: start + t rise - t (1 - t) curvature, t in 0..1. */
typedef struct {
    int32_t start;
    int32_t rise;
    int32_t curvature;
} span_t;

static inline span_t span(node_t low, node_t high) {
    /* (column + t) (low + t (high - low)), expanded */
    return (span_t){low.product, high.product - low.product, unscaled(high.value_q14 - low.value_q14, COLUMN_Q9)};
}

/* Unscaled result at t, Q15, below one. */
static inline int32_t evaluate_span(span_t s, int32_t t_q15) {
    return s.start + 2 * fixed_multiply_high(s.rise, t_q15 << 16) -
           4 * fixed_multiply_high(s.curvature, t_q15 * (ONE_Q15 - t_q15));
}

/* Inverse of a span: t, Q15, for an unscaled result, by a first Newton step from t = 1/2 and `steps` more. The
 * curvature of a curve that rises everywhere is within its rise; no divisor is then below a quarter of the rise. */
static inline int32_t solve_span_q15(span_t s, int32_t target, int steps) {
    if (target <= s.start) {
        return 0;
    }
    if (fixed_subtract(target, s.start) >= s.rise) {
        return ONE_Q15 - 1;
    }
    /* Normalised: rise in 2^13..2^14, the numerator with 15 fraction bits more. */
    const int shift = __builtin_clz((uint32_t)s.rise) - 3;
    const int32_t numerator = (target - s.start) << shift;
    const int32_t rise = (s.rise << shift) >> 15;
    const int32_t curvature = (fixed_clamp(s.curvature, -s.rise, s.rise) * (1 << shift)) >> 15;
    int32_t t_q15 = (numerator + curvature * (1 << 13)) / rise;
    for (int i = 0; i < steps; i++) {
        t_q15 = (numerator + curvature * ((t_q15 * t_q15) >> 15)) / (rise - curvature + ((curvature * t_q15) >> 14));
    }
    return fixed_clamp(t_q15, 0, ONE_Q15 - 1);
}

/* Lookup of a distance from the unaligned position, 0..2^31 - 1. */
static inline phase_map_lookup_t lookup_distance(const machine_tables_t *tables, uint32_t distance) {
    /* Search from the row in which the angle bin begins; the start of the last row is above every distance. */
    const machine_row_t *row = &tables->row[tables->angle_bin_row[distance >> MACHINE_ANGLE_BIN_BITS]];
    while (row[1].start <= distance) {
        row++;
    }
    /* The reciprocal is rounded down and the distance within the row is below its width: the fraction is below one in
     * Q15, at most one after rounding to Q14. */
    const uint32_t fraction_q15 = (uint32_t)(((uint64_t)(distance - row->start) * row->reciprocal) >> 32);
    const int32_t fraction_q14 = (int32_t)((fraction_q15 + 1) >> 1);
    const int32_t curvature_q14 = (fraction_q14 * (ONE_Q14 - fraction_q14)) >> 14;
    return (phase_map_lookup_t){
        .tables = tables,
        .row = (uint32_t)(row - tables->row),
        .weights_q14 = (uint32_t)(ONE_Q14 - fraction_q14) | (uint32_t)fraction_q14 << 16,
        .torque_curvature_q14 = curvature_q14 << tables->torque_format.curvature_shift,
        .flux_curvature_q14 = curvature_q14 << tables->flux_format.curvature_shift,
    };
}

static inline phase_map_lookup_t lookup_angle(const machine_tables_t *tables, uint32_t phase_angle) {
    const int32_t past_unaligned = (int32_t)(phase_angle - HALF_REV);
    /* The magnitude saturates at 2^31 - 1: the aligned position is the end of the last row. */
    phase_map_lookup_t lookup = lookup_distance(tables, (uint32_t)fixed_abs(past_unaligned));
    lookup.mirrored = past_unaligned < 0;
    return lookup;
}

static inline int32_t interpolate_torque_q24(const phase_map_lookup_t *lookup, const machine_column_t *c,
                                             int32_t clamped_q9) {
    const int32_t product =
        interpolate_columns(torque_value_q14(lookup, &c[0]), torque_value_q14(lookup, &c[1]), clamped_q9);
    const int32_t positive_half_q24 = scale(&lookup->tables->torque_format, product);
    return lookup->mirrored ? fixed_subtract(0, positive_half_q24) : positive_half_q24;
}

static inline int32_t interpolate_flux_q29(const phase_map_lookup_t *lookup, const machine_column_t *c,
                                           int32_t clamped_q9) {
    const int32_t product =
        interpolate_columns(flux_value_q14(lookup, &c[0]), flux_value_q14(lookup, &c[1]), clamped_q9);
    return scale(&lookup->tables->flux_format, product);
}

phase_map_lookup_t phase_map_lookup(const machine_tables_t *tables, uint32_t phase_angle) {
    return lookup_angle(tables, phase_angle);
}

int32_t phase_map_torque_q24(const phase_map_lookup_t *lookup, int32_t current_q9) {
    const int32_t clamped_q9 = fixed_clamp(current_q9, 0, PHASE_MAP_CURRENT_MAX_Q9);
    return interpolate_torque_q24(lookup, &lookup->tables->column[clamped_q9 >> MACHINE_COLUMN_BITS], clamped_q9);
}

int32_t phase_map_torque_at_q24(const machine_tables_t *tables, uint32_t phase_angle, int32_t current_q9) {
    const phase_map_lookup_t lookup = lookup_angle(tables, phase_angle);
    return interpolate_torque_q24(&lookup, &tables->column[current_q9 >> MACHINE_COLUMN_BITS], current_q9);
}

int32_t phase_map_flux_q29(const phase_map_lookup_t *lookup, int32_t current_q9) {
    const int32_t clamped_q9 = fixed_clamp(current_q9, 0, PHASE_MAP_CURRENT_MAX_Q9);
    return interpolate_flux_q29(lookup, &lookup->tables->column[clamped_q9 >> MACHINE_COLUMN_BITS], clamped_q9);
}

int32_t phase_map_torque_slope_q24(const machine_tables_t *tables, uint32_t phase_angle, int32_t current_q9,
                                   uint32_t angle_step) {
    const machine_format_t *format = &tables->torque_format;
    const phase_map_lookup_t lookup = lookup_angle(tables, phase_angle);
    const uint32_t ratio_q15 = (uint32_t)(((uint64_t)tables->row[lookup.row].reciprocal * angle_step) >> 32);
    /* Over the width of a row: difference of the nodes less (1 - 2 u) times the curvature, within 2^30 + 2^29. */
    const int32_t curvature_q14 = (ONE_Q14 - 2 * (int32_t)(lookup.weights_q14 >> 16)) * (1 << format->curvature_shift);
    const int32_t clamped_q9 = fixed_clamp(current_q9, 0, PHASE_MAP_CURRENT_MAX_Q9);
    const machine_column_t *c = &tables->column[clamped_q9 >> MACHINE_COLUMN_BITS];
    int32_t slope_q14[2];
    for (int i = 0; i < 2; i++) {
        slope_q14[i] = dual16_multiply_add(&c[i].torque_node[lookup.row], dual16_pack(-ONE_Q14, ONE_Q14), 0) -
                       c[i].torque_curvature[lookup.row] * curvature_q14;
    }
    const int32_t product = interpolate_columns(slope_q14[0] / 2, slope_q14[1] / 2, clamped_q9);
    return fixed_saturate(((int64_t)product * ratio_q15) >> (14 - format->result_shift));
}

/* Target torque and constraints: unscaled, current limit as column. */
typedef struct {
    int32_t torque;
    int32_t flux_min;
    int32_t flux_max;
    uint32_t limit_column;
} target_t;

typedef struct {
    node_t torque;
    node_t flux;
} column_t;

static inline column_t column_at(const phase_map_lookup_t *lookup, uint32_t column) {
    return (column_t){torque_node(lookup, column), flux_node(lookup, column)};
}

/* True when a column other than the last is below the target. The first column is below every target. */
static inline bool is_below(column_t c, uint32_t column, target_t target) {
    return c.flux.product <= target.flux_max && ((c.torque.product <= target.torque && column <= target.limit_column) ||
                                                 (c.flux.product <= target.flux_min && column < MACHINE_COLUMNS - 1));
}

bool phase_map_solve(const machine_tables_t *tables, uint32_t phase_angle, int32_t torque_q24,
                     const phase_map_constraints_t *constraints, phase_map_operating_point_t *point) {
    const phase_map_lookup_t lookup = lookup_distance(tables, phase_angle - HALF_REV);
    const machine_format_t *torque_format = &tables->torque_format;
    const machine_format_t *flux_format = &tables->flux_format;
    const int32_t target_q24 = torque_q24 > 0 ? torque_q24 : 0;
    /* At angles without torque at any current, a target of 0 would otherwise be reached at flux_max. */
    const int32_t flux_max_q29 = torque_q24 > 0 ? constraints->flux_max_q29 : constraints->flux_min_q29;
    const target_t target = {
        .torque = target_q24 >> torque_format->result_shift,
        .flux_min = constraints->flux_min_q29 >> flux_format->result_shift,
        .flux_max = flux_max_q29 >> flux_format->result_shift,
        .limit_column = (uint32_t)constraints->current_limit_q9 >> MACHINE_COLUMN_BITS,
    };

    /* Last column below the target, searched from the column of the last point. */
    uint32_t column = point->column;
    column_t low = column_at(&lookup, column);
    column_t high = low;
    if (is_below(low, column, target)) {
        while (high = column_at(&lookup, column + 1), is_below(high, column + 1, target)) {
            low = high;
            column++;
        }
    } else {
        do {
            high = low;
            low = column_at(&lookup, --column);
        } while (!is_below(low, column, target));
    }
    point->column = column;

    const span_t torque = span(low.torque, high.torque);
    const span_t flux = span(low.flux, high.flux);
    int32_t t_q15 = solve_span_q15(torque, target.torque, TORQUE_NEWTON_STEPS);
    bool reached = torque.start <= target.torque && target.torque < high.torque.product;
    /* True when the search ended at flux_max or at the current limit. */
    const bool torque_above_span = target.torque >= high.torque.product;
    const int32_t limit_q15 =
        (constraints->current_limit_q9 - (int32_t)(column << MACHINE_COLUMN_BITS)) * (1 << (15 - MACHINE_COLUMN_BITS));
    bool current_limited = t_q15 > limit_q15;
    if (current_limited) {
        t_q15 = limit_q15 > 0 ? limit_q15 : 0;
    }
    const int32_t flux_product = evaluate_span(flux, t_q15);
    if (flux_product > target.flux_min && flux_product <= target.flux_max && (current_limited || !torque_above_span)) {
        reached = reached && !current_limited;
        point->flux_q29 = scale(flux_format, flux_product);
        point->torque_q24 = reached ? target_q24 : scale(torque_format, evaluate_span(torque, t_q15));
        return reached;
    }
    const bool at_flux_min = flux_product <= target.flux_min;
    t_q15 = solve_span_q15(flux, at_flux_min ? target.flux_min : target.flux_max, FLUX_NEWTON_STEPS);
    point->flux_q29 = at_flux_min ? constraints->flux_min_q29 : flux_max_q29;
    point->torque_q24 = scale(torque_format, evaluate_span(torque, t_q15));
    return false;
}
