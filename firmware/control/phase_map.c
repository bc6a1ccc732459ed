#include "control/phase_map.h"

#include "fixed/fixed.h"

#define HALF_PITCH 0x80000000u
#define COLUMN_Q9 (1 << MACHINE_COLUMN_BITS)
#define ONE_Q14 (1 << 14)

/* Right shift from value in Q14 of the tables' last place times current in Q9 to the format of the result. */
#define TORQUE_SHIFT(surface) ((unsigned)(surface)->fraction_bits + 14 + 9 - 24)
#define FLUX_SHIFT(surface) ((unsigned)(surface)->fraction_bits + 14 + 9 - 29)

/* Fraction bits that a value keeps in an inverse, so that a product with a column's number and all differences of such
 * products stay below 2^30, whatever the tables hold. */
#define INVERSE_BITS 6

/* A surface at the angle of a place, from a column on: its node and bend, and the weights of this row's nodes, the next
 * row's and the bends. */
typedef struct {
    const uint16_t *node;
    const int8_t *bend;
    int32_t low_q14, high_q14, bend_q14;
} curve_t;

static inline curve_t curve_at(const machine_surface_t *surface, const phase_map_place_t *place, int32_t column) {
    const uint32_t first = place->first + (uint32_t)column;
    return (curve_t){
        .node = &surface->node[first],
        .bend = &surface->bend[first],
        .low_q14 = ONE_Q14 - place->fraction_q14,
        .high_q14 = place->fraction_q14,
        .bend_q14 = place->bend_q14 << surface->bend_shift,
    };
}

/* Value in Q14, so many columns on: the nodes' part is below 2^30, the bend's within 2^27. */
static inline int32_t column_q14(const curve_t *curve, int32_t column) {
    const uint16_t *node = &curve->node[column];
    return node[0] * curve->low_q14 + node[MACHINE_COLUMNS] * curve->high_q14 - curve->bend[column] * curve->bend_q14;
}

/* value >> shift, saturated; shift 1..31, for which two words need no more than this. */
static inline int32_t shifted(int64_t value, unsigned shift) {
    const int32_t high = (int32_t)(value >> 32);
    const int32_t low = (int32_t)((uint32_t)value >> shift | (uint32_t)high << (32 - shift));
    /* What does not fit in a word: more than copies of its sign. */
    if (high >> (shift - 1) != low >> 31) {
        return high < 0 ? INT32_MIN : INT32_MAX;
    }
    return low;
}

static inline int32_t look_up(const machine_surface_t *surface, const phase_map_place_t *place, int32_t current_q9,
                              unsigned shift) {
    const int32_t held_q9 = fixed_clamp(current_q9, 0, PHASE_MAP_CURRENT_MAX_Q9);
    const curve_t curve = curve_at(surface, place, held_q9 >> MACHINE_COLUMN_BITS);
    const int32_t part_q31 = (held_q9 & (COLUMN_Q9 - 1)) << (31 - MACHINE_COLUMN_BITS);
    const int32_t low_q14 = column_q14(&curve, 0);
    const int32_t high_q14 = column_q14(&curve, 1);
    const int32_t value_q14 = low_q14 + 2 * (int32_t)(((int64_t)(high_q14 - low_q14) * part_q31) >> 32);
    return shifted((int64_t)value_q14 * held_q9, shift);
}

/* Greatest t, Q10 of a column, below one, with slope t + bend t^2 <= rest: a bit at a time, as a division that keeps
 * its remainder. All of them below 2^29; more than rest at t = 1. */
static inline int32_t part_q10(int32_t slope, int32_t bend, int32_t rest) {
    int32_t part = 0;
#pragma GCC unroll 10
    for (int bit = 0; bit < MACHINE_COLUMN_BITS; bit++) {
        /* Over a step of 2^-k, here times 2^k: slope + 2^-k bend; behind it the slope is 2^(1-k) bend more. */
        rest *= 2;
        bend >>= 1;
        part *= 2;
        if (slope + bend <= rest) {
            rest -= slope + bend;
            slope += 2 * bend;
            part += 1;
        }
    }
    return part;
}

/* `result` in the format that look_up() gives with the same shift. */
static int32_t current_of(const machine_surface_t *surface, const phase_map_place_t *place, int32_t result,
                          unsigned shift) {
    if (result <= 0) {
        return 0;
    }
    const curve_t curve = curve_at(surface, place, 0);
    /* Value in INVERSE_BITS times the column's number. */
    const int32_t wanted = fixed_saturate(((int64_t)result << shift) >> (14 - INVERSE_BITS + MACHINE_COLUMN_BITS));
    /* Halve the interval of columns that holds it. */
    int32_t below = 0;
    int32_t above = MACHINE_COLUMNS - 1;
    int32_t low = column_q14(&curve, below) >> (14 - INVERSE_BITS);
    int32_t high = column_q14(&curve, above) >> (14 - INVERSE_BITS);
    if (above * high <= wanted) {
        return PHASE_MAP_CURRENT_MAX_Q9;
    }
    while (above - below > 1) {
        const int32_t middle = (int32_t)((uint32_t)(below + above) / 2);
        const int32_t value = column_q14(&curve, middle) >> (14 - INVERSE_BITS);
        if (middle * value <= wanted) {
            below = middle;
            low = value;
        } else {
            above = middle;
            high = value;
        }
    }
    /* In it, (below + t) (low + t (high - low)) = wanted. */
    const int32_t part = part_q10(low + below * (high - low), high - low, wanted - below * low);
    return (below << MACHINE_COLUMN_BITS) + part;
}

phase_map_place_t phase_map_at(const machine_tables_t *tables, uint32_t phase_angle) {
    const bool mirrored = phase_angle < HALF_PITCH;
    uint32_t distance = mirrored ? HALF_PITCH - phase_angle : phase_angle - HALF_PITCH;
    distance -= distance >> 31; /* the aligned position is the end of the last row */
    /* From the row in which its part of half a pitch begins; the last row's start is beyond every distance. */
    uint32_t row = tables->cell_row[distance >> MACHINE_CELL_BITS];
    while (tables->row[row + 1].start <= distance) {
        row++;
    }
    /* The reciprocal is rounded down and the distance in the row below its width: below one, and rounded at most one.
     */
    const uint32_t inside = distance - tables->row[row].start;
    const uint32_t fraction_q15 = (uint32_t)(((uint64_t)inside * tables->row[row].reciprocal) >> 32);
    const int32_t fraction_q14 = (int32_t)((fraction_q15 + 1) >> 1);
    return (phase_map_place_t){
        .tables = tables,
        .first = row * MACHINE_COLUMNS,
        .fraction_q14 = fraction_q14,
        .bend_q14 = (fraction_q14 * (ONE_Q14 - fraction_q14)) >> 14,
        .mirrored = mirrored,
    };
}

int32_t phase_map_torque_q24(const phase_map_place_t *place, int32_t current_q9) {
    const machine_surface_t *surface = &place->tables->torque_per_ampere;
    const int32_t forwards_q24 = look_up(surface, place, current_q9, TORQUE_SHIFT(surface));
    return place->mirrored ? fixed_subtract(0, forwards_q24) : forwards_q24;
}

int32_t phase_map_flux_q29(const phase_map_place_t *place, int32_t current_q9) {
    const machine_surface_t *surface = &place->tables->flux_per_ampere;
    return look_up(surface, place, current_q9, FLUX_SHIFT(surface));
}

int32_t phase_map_current_of_torque_q9(const phase_map_place_t *place, int32_t torque_q24) {
    const machine_surface_t *surface = &place->tables->torque_per_ampere;
    const int32_t forwards_q24 = place->mirrored ? fixed_subtract(0, torque_q24) : torque_q24;
    return current_of(surface, place, forwards_q24, TORQUE_SHIFT(surface));
}

int32_t phase_map_current_of_flux_q9(const phase_map_place_t *place, int32_t flux_q29) {
    const machine_surface_t *surface = &place->tables->flux_per_ampere;
    return current_of(surface, place, flux_q29, FLUX_SHIFT(surface));
}
