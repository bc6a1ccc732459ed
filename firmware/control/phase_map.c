#include "control/phase_map.h"

#include "fixed/fixed.h"
#include "fixed/pair.h"

#define HALF_PITCH 0x80000000u
#define COLUMN_Q9 (1 << MACHINE_COLUMN_BITS)
#define ONE_Q14 (1 << 14)
#define ONE_Q15 (1 << 15)

/* Of an inverse: the torque begins as a parabola, the flux linkage is nearly straight between columns. */
#define TORQUE_STEPS 2
#define FLUX_STEPS 1

/* Value in Q14 of a column's curve at a place: the nodes' part is below 2^30, the bend's within 2^27. */
static inline int32_t torque_value_q14(const phase_map_place_t *place, const machine_column_t *column) {
    const int16_t *nodes = &column->torque_node[place->row];
    return fixed_pair_multiply_add(nodes, place->weights_q14, MACHINE_NODE_OFFSET << 14) -
           column->torque_bend[place->row] * place->torque_bend_q14;
}

static inline int32_t flux_value_q14(const phase_map_place_t *place, const machine_column_t *column) {
    const int16_t *nodes = &column->flux_node[place->row];
    return fixed_pair_multiply_add(nodes, place->weights_q14, MACHINE_NODE_OFFSET << 14) -
           column->flux_bend[place->row] * place->flux_bend_q14;
}

/* Value in Q14 times current in Q9, 0..2^10 MACHINE_COLUMNS, as far as one word holds it: below 2^29. */
static inline int32_t product(int32_t value, int32_t current_q9) {
    return fixed_multiply_high(value, current_q9 << 15);
}

/* Such a product in the format of the result, saturated. */
static inline int32_t result(const machine_format_t *format, int32_t product) {
    const int32_t shifted = (int32_t)((uint32_t)product << format->result_shift);
    return shifted >> format->result_shift == product ? shifted : INT32_MAX ^ (product >> 31);
}

/* Product of a current and the value there, between those of two columns. */
static inline int32_t between(int32_t low_q14, int32_t high_q14, int32_t current_q9) {
    const int32_t part_q31 = (int32_t)((uint32_t)current_q9 << (32 - MACHINE_COLUMN_BITS) >> 1);
    return product(low_q14 + 2 * fixed_multiply_high(high_q14 - low_q14, part_q31), current_q9);
}

/* A curve at a column: product of value and current. */
typedef struct {
    int32_t value_q14;
    int32_t product;
} node_t;

static inline node_t torque_node(const phase_map_place_t *place, uint32_t column) {
    const int32_t value = torque_value_q14(place, &place->tables->column[column]);
    return (node_t){value, product(value, (int32_t)(column << MACHINE_COLUMN_BITS))};
}

static inline node_t flux_node(const phase_map_place_t *place, uint32_t column) {
    const int32_t value = flux_value_q14(place, &place->tables->column[column]);
    return (node_t){value, product(value, (int32_t)(column << MACHINE_COLUMN_BITS))};
}

/* Between two columns: start + t rise - t (1 - t) bend, for t from 0 to 1. */
typedef struct {
    int32_t start;
    int32_t rise;
    int32_t bend;
} span_t;

static inline span_t span(node_t low, node_t high) {
    /* (column + t) (low + t (high - low)) */
    return (span_t){low.product, high.product - low.product, product(high.value_q14 - low.value_q14, COLUMN_Q9)};
}

/* t in Q15, below one. */
static inline int32_t at_part(span_t s, int32_t t_q15) {
    return s.start + 2 * fixed_multiply_high(s.rise, t_q15 << 16) -
           4 * fixed_multiply_high(s.bend, t_q15 * (ONE_Q15 - t_q15));
}

/* The t at which a span has a product: so many steps of Newton's iteration behind the first, from the middle. A curve
 * that rises everywhere has a bend within its rise; then no divisor is below a quarter of the rise. */
static inline int32_t part_q15(span_t s, int32_t wanted, int steps) {
    if (wanted <= s.start) {
        return 0;
    }
    if (fixed_subtract(wanted, s.start) >= s.rise) {
        return ONE_Q15 - 1;
    }
    /* The rise becomes 2^13..2^14, the rest, of the same unit, has 15 bits more. */
    const int shift = __builtin_clz((uint32_t)s.rise) - 3;
    const int32_t rest = (wanted - s.start) << shift;
    const int32_t rise = (s.rise << shift) >> 15;
    const int32_t bend = (fixed_clamp(s.bend, -s.rise, s.rise) * (1 << shift)) >> 15;
    int32_t t_q15 = (rest + bend * (1 << 13)) / rise;
    for (int i = 0; i < steps; i++) {
        t_q15 = (rest + bend * ((t_q15 * t_q15) >> 15)) / (rise - bend + ((bend * t_q15) >> 14));
    }
    return fixed_clamp(t_q15, 0, ONE_Q15 - 1);
}

/* The place of a distance from the unaligned position, 0..2^31 - 1. */
static inline phase_map_place_t place_of(const machine_tables_t *tables, uint32_t distance) {
    /* From the row in which its part of half a pitch begins; the last row's start is beyond every distance. */
    const machine_row_t *row = &tables->row[tables->cell_row[distance >> MACHINE_CELL_BITS]];
    while (row[1].start <= distance) {
        row++;
    }
    /* The reciprocal is rounded down and the distance in the row below its width: below one, and rounded at most one.
     */
    const uint32_t fraction_q15 = (uint32_t)(((uint64_t)(distance - row->start) * row->reciprocal) >> 32);
    const int32_t fraction_q14 = (int32_t)((fraction_q15 + 1) >> 1);
    const int32_t bend_q14 = (fraction_q14 * (ONE_Q14 - fraction_q14)) >> 14;
    return (phase_map_place_t){
        .tables = tables,
        .row = (uint32_t)(row - tables->row),
        .weights_q14 = (uint32_t)(ONE_Q14 - fraction_q14) | (uint32_t)fraction_q14 << 16,
        .torque_bend_q14 = bend_q14 << tables->torque_format.bend_shift,
        .flux_bend_q14 = bend_q14 << tables->flux_format.bend_shift,
    };
}

static inline phase_map_place_t place_at(const machine_tables_t *tables, uint32_t phase_angle) {
    const int32_t past_unaligned = (int32_t)(phase_angle - HALF_PITCH);
    /* The magnitude is held below 2^31: the aligned position is the end of the last row. */
    phase_map_place_t place = place_of(tables, (uint32_t)fixed_abs(past_unaligned));
    place.mirrored = past_unaligned < 0;
    return place;
}

static inline int32_t torque_between_q24(const phase_map_place_t *place, const machine_column_t *c, int32_t held_q9) {
    const int32_t there = between(torque_value_q14(place, &c[0]), torque_value_q14(place, &c[1]), held_q9);
    const int32_t forwards_q24 = result(&place->tables->torque_format, there);
    return place->mirrored ? fixed_subtract(0, forwards_q24) : forwards_q24;
}

static inline int32_t flux_between_q29(const phase_map_place_t *place, const machine_column_t *c, int32_t held_q9) {
    const int32_t there = between(flux_value_q14(place, &c[0]), flux_value_q14(place, &c[1]), held_q9);
    return result(&place->tables->flux_format, there);
}

phase_map_place_t phase_map_at(const machine_tables_t *tables, uint32_t phase_angle) {
    return place_at(tables, phase_angle);
}

int32_t phase_map_torque_q24(const phase_map_place_t *place, int32_t current_q9) {
    const int32_t held_q9 = fixed_clamp(current_q9, 0, PHASE_MAP_CURRENT_MAX_Q9);
    return torque_between_q24(place, &place->tables->column[held_q9 >> MACHINE_COLUMN_BITS], held_q9);
}

int32_t phase_map_torque_at_q24(const machine_tables_t *tables, uint32_t phase_angle, int32_t current_q9) {
    const phase_map_place_t place = place_at(tables, phase_angle);
    return torque_between_q24(&place, &tables->column[current_q9 >> MACHINE_COLUMN_BITS], current_q9);
}

int32_t phase_map_flux_q29(const phase_map_place_t *place, int32_t current_q9) {
    const int32_t held_q9 = fixed_clamp(current_q9, 0, PHASE_MAP_CURRENT_MAX_Q9);
    return flux_between_q29(place, &place->tables->column[held_q9 >> MACHINE_COLUMN_BITS], held_q9);
}

int32_t phase_map_torque_slope_q24(const machine_tables_t *tables, uint32_t phase_angle, int32_t current_q9,
                                   uint32_t turn) {
    const machine_format_t *format = &tables->torque_format;
    const phase_map_place_t place = place_at(tables, phase_angle);
    const uint32_t ratio_q15 = (uint32_t)(((uint64_t)tables->row[place.row].reciprocal * turn) >> 32);
    /* Over a row's width: the nodes' difference less what u (1 - u) of the bend changes by, within 2^30 + 2^29. */
    const int32_t bend_q14 = (ONE_Q14 - 2 * (int32_t)(place.weights_q14 >> 16)) * (1 << format->bend_shift);
    const int32_t held_q9 = fixed_clamp(current_q9, 0, PHASE_MAP_CURRENT_MAX_Q9);
    const machine_column_t *c = &tables->column[held_q9 >> MACHINE_COLUMN_BITS];
    int32_t slope_q14[2];
    for (int i = 0; i < 2; i++) {
        slope_q14[i] = fixed_pair_multiply_add(&c[i].torque_node[place.row], fixed_pair(-ONE_Q14, ONE_Q14), 0) -
                       c[i].torque_bend[place.row] * bend_q14;
    }
    const int32_t there = between(slope_q14[0] / 2, slope_q14[1] / 2, held_q9);
    return fixed_saturate(((int64_t)there * ratio_q15) >> (14 - format->result_shift));
}

/* A torque and a range, as products and as a column. */
typedef struct {
    int32_t torque;
    int32_t lowest;
    int32_t highest;
    uint32_t limit;
} target_t;

typedef struct {
    node_t torque;
    node_t flux;
} column_t;

static inline column_t column_at(const phase_map_place_t *place, uint32_t column) {
    return (column_t){torque_node(place, column), flux_node(place, column)};
}

/* Whether a column, which is not the last, is below the target. The first one is below every target. */
static inline bool is_below(column_t c, uint32_t column, target_t target) {
    return c.flux.product <= target.highest && ((c.torque.product <= target.torque && column <= target.limit) ||
                                                (c.flux.product <= target.lowest && column < MACHINE_COLUMNS - 1));
}

bool phase_map_reach(const machine_tables_t *tables, uint32_t phase_angle, int32_t torque_q24,
                     const phase_map_range_t *range, phase_map_point_t *point) {
    const phase_map_place_t place = place_of(tables, phase_angle - HALF_PITCH);
    const machine_format_t *torque_format = &tables->torque_format;
    const machine_format_t *flux_format = &tables->flux_format;
    const int32_t wanted_q24 = torque_q24 > 0 ? torque_q24 : 0;
    /* Where the tables have no torque at any current, none would be the most as well. */
    const int32_t highest_q29 = torque_q24 > 0 ? range->highest_q29 : range->lowest_q29;
    const target_t target = {
        .torque = wanted_q24 >> torque_format->result_shift,
        .lowest = range->lowest_q29 >> flux_format->result_shift,
        .highest = highest_q29 >> flux_format->result_shift,
        .limit = (uint32_t)range->current_limit_q9 >> MACHINE_COLUMN_BITS,
    };

    /* The last column below the target, from where the phase was. */
    uint32_t column = point->column;
    column_t low = column_at(&place, column);
    column_t high = low;
    if (is_below(low, column, target)) {
        while (high = column_at(&place, column + 1), is_below(high, column + 1, target)) {
            low = high;
            column++;
        }
    } else {
        do {
            high = low;
            low = column_at(&place, --column);
        } while (!is_below(low, column, target));
    }
    point->column = column;

    const span_t torque = span(low.torque, high.torque);
    const span_t flux = span(low.flux, high.flux);
    int32_t t_q15 = part_q15(torque, target.torque, TORQUE_STEPS);
    bool reached = torque.start <= target.torque && target.torque < high.torque.product;
    const bool beyond = target.torque >= high.torque.product; /* the flux linkage ends what is below, or the limit */
    const int32_t limit_q15 =
        (range->current_limit_q9 - (int32_t)(column << MACHINE_COLUMN_BITS)) * (1 << (15 - MACHINE_COLUMN_BITS));
    bool limited = t_q15 > limit_q15;
    if (limited) {
        t_q15 = limit_q15 > 0 ? limit_q15 : 0;
    }
    const int32_t there = at_part(flux, t_q15);
    if (there > target.lowest && there <= target.highest && (limited || !beyond)) {
        reached = reached && !limited;
        point->flux_q29 = result(flux_format, there);
        point->torque_q24 = reached ? wanted_q24 : result(torque_format, at_part(torque, t_q15));
        return reached;
    }
    const bool to_lowest = there <= target.lowest;
    t_q15 = part_q15(flux, to_lowest ? target.lowest : target.highest, FLUX_STEPS);
    point->flux_q29 = to_lowest ? range->lowest_q29 : highest_q29;
    point->torque_q24 = result(torque_format, at_part(torque, t_q15));
    return false;
}
