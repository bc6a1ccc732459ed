#include "control/phase_map.h"

#include "fixed/fixed.h"

#define HALF_PITCH 0x80000000u

/* End of the columns of 2 A, A in Q7.9. */
#define FINE_END_Q9 (MACHINE_FINE_COLUMNS << MACHINE_FINE_BITS)

/* Bits that a value between nodes has more than the tables. With 10 the cubic of any four nodes, sensible or not, stays
 * below 2^31: a node with its bend is within -2^13..2^16 + 2^13, the cubic within 18 times that range. */
#define EXTRA_BITS 10

/* Right shift from value times current in Q9 to the format of the result. */
#define TORQUE_SHIFT(surface) ((unsigned)(surface)->fraction_bits + EXTRA_BITS + 9 - 24)
#define FLUX_SHIFT(surface) ((unsigned)(surface)->fraction_bits + EXTRA_BITS + 9 - 29)

phase_map_place_t phase_map_at(const machine_tables_t *tables, uint32_t phase_angle) {
    const bool mirrored = phase_angle < HALF_PITCH;
    const uint32_t distance = mirrored ? HALF_PITCH - phase_angle : phase_angle - HALF_PITCH;
    const uint32_t whole = distance >> MACHINE_ROW_BITS;
    /* The last row that starts at or before it, but for the aligned position's, where the map ends. */
    const uint16_t *start = tables->row_start;
    for (uint32_t step = (MACHINE_ROWS - 1) / 2; step > 0; step /= 2) {
        start += start[step] <= whole ? step : 0;
    }
    /* Distance in the row, below width << MACHINE_ROW_BITS; at the aligned position itself equal to it. */
    const uint32_t inside = distance - ((uint32_t)start[0] << MACHINE_ROW_BITS);
    const uint32_t width = (uint32_t)(start[1] - start[0]);
    const int32_t fraction_q15 = (int32_t)((inside >> (MACHINE_ROW_BITS - 15)) / width);
    return (phase_map_place_t){
        .tables = tables,
        .row = (uint32_t)(start - tables->row_start),
        .fraction_q15 = fraction_q15,
        .bend_q15 = (fraction_q15 * (32768 - fraction_q15)) >> 15,
        .mirrored = mirrored,
    };
}

/* Place among the columns, Q5.11, of a current of 0..80 A in Q7.9, and a column's current. */
static inline int32_t position_q11(int32_t current_q9) {
    return current_q9 < FINE_END_Q9 ? 2 * current_q9 : current_q9 + FINE_END_Q9;
}

static inline int32_t column_current_q9(int32_t column) {
    return column < MACHINE_FINE_COLUMNS ? column << 10 : (column << 11) - FINE_END_Q9;
}

/* A column's value at the angle. Differences of 16-bit entries times at most 2^15 stay within 32 bits. */
static inline int32_t at_angle(const phase_map_place_t *place, int32_t low, int32_t high, int32_t bend) {
    return (low << EXTRA_BITS) + (((high - low) * place->fraction_q15) >> (15 - EXTRA_BITS)) -
           ((bend * place->bend_q15) >> (15 - EXTRA_BITS));
}

/* Newton's form of the cubic through four columns of equal steps, t in columns from the first of them:
 * value = first + t (once + (t - 1) (twice + (t - 2) thrice)). */
typedef struct {
    int32_t start_q11; /* position of the first column */
    int32_t first, once, twice, thrice;
} cubic_t;

/* The cubic for currents from `column` to the next: one column more on either side, or what there is of its width. */
static inline cubic_t cubic_at(const machine_surface_t *surface, const phase_map_place_t *place, int32_t column) {
    const int32_t first = column < MACHINE_FINE_COLUMNS
                              ? fixed_clamp(column - 1, 0, MACHINE_FINE_COLUMNS - 3)
                              : fixed_clamp(column - 1, MACHINE_FINE_COLUMNS, MACHINE_COLUMNS - 4);
    const uint16_t *low = &surface->node[place->row][first];
    const uint16_t *high = &surface->node[place->row + 1][first];
    const int16_t *bend = &surface->bend[place->row][first];
    const int32_t v0 = at_angle(place, low[0], high[0], bend[0]);
    const int32_t v1 = at_angle(place, low[1], high[1], bend[1]);
    const int32_t v2 = at_angle(place, low[2], high[2], bend[2]);
    const int32_t v3 = at_angle(place, low[3], high[3], bend[3]);
    return (cubic_t){
        .start_q11 = first << 11,
        .first = v0,
        .once = v1 - v0,
        .twice = (v2 - 2 * v1 + v0) / 2,
        .thrice = (v3 - v0 - 3 * (v2 - v1)) / 6,
    };
}

/* Current times value, with EXTRA_BITS + 9 fraction bits more than the tables; current 0..80 A. Truncated steps. */
static inline int64_t product(const cubic_t *cubic, int32_t current_q9) {
    const int32_t t_q11 = position_q11(current_q9) - cubic->start_q11;
    int32_t value = cubic->thrice;
    value = cubic->twice + (int32_t)(((int64_t)value * (t_q11 - 2 * 2048)) >> 11);
    value = cubic->once + (int32_t)(((int64_t)value * (t_q11 - 2048)) >> 11);
    value = cubic->first + (int32_t)(((int64_t)value * t_q11) >> 11);
    return (int64_t)value * current_q9;
}

static int32_t look_up(const machine_surface_t *surface, const phase_map_place_t *place, int32_t current_q9,
                       unsigned shift) {
    const int32_t held_q9 = fixed_clamp(current_q9, 0, PHASE_MAP_CURRENT_MAX_Q9);
    const cubic_t cubic = cubic_at(surface, place, position_q11(held_q9) >> 11);
    return fixed_saturate(product(&cubic, held_q9) >> shift);
}

/* Current times value at a column, as product() gives it. */
static inline int64_t product_at(const machine_surface_t *surface, const phase_map_place_t *place, int32_t column) {
    const int32_t value = at_angle(place, surface->node[place->row][column], surface->node[place->row + 1][column],
                                   surface->bend[place->row][column]);
    return (int64_t)value * column_current_q9(column);
}

/* `result` in the format that look_up() gives with the same shift. */
static int32_t current_of(const machine_surface_t *surface, const phase_map_place_t *place, int64_t result,
                          unsigned shift) {
    if (result <= 0) {
        return 0;
    }
    const int64_t wanted = result << shift; /* below 2^31 << 25 */
    /* Halve the interval of columns that holds it. */
    int32_t below = 0;
    int32_t above = MACHINE_COLUMNS - 1;
    if (product_at(surface, place, above) <= wanted) {
        return PHASE_MAP_CURRENT_MAX_Q9;
    }
    while (above - below > 1) {
        const int32_t middle = (below + above) / 2;
        if (product_at(surface, place, middle) <= wanted) {
            below = middle;
        } else {
            above = middle;
        }
    }
    /* Then the currents in it, a bit at a time. */
    const cubic_t cubic = cubic_at(surface, place, below);
    int32_t found_q9 = column_current_q9(below);
    for (int32_t step = (column_current_q9(above) - found_q9) / 2; step > 0; step /= 2) {
        found_q9 += product(&cubic, found_q9 + step) <= wanted ? step : 0;
    }
    return found_q9;
}

int32_t phase_map_torque_q24(const phase_map_place_t *place, int32_t current_q9) {
    const machine_surface_t *surface = &place->tables->torque_per_ampere;
    const int32_t torque_q24 = look_up(surface, place, current_q9, TORQUE_SHIFT(surface));
    return place->mirrored ? fixed_subtract(0, torque_q24) : torque_q24;
}

int32_t phase_map_flux_q29(const phase_map_place_t *place, int32_t current_q9) {
    const machine_surface_t *surface = &place->tables->flux_per_ampere;
    return look_up(surface, place, current_q9, FLUX_SHIFT(surface));
}

int32_t phase_map_current_of_torque_q9(const phase_map_place_t *place, int32_t torque_q24) {
    const machine_surface_t *surface = &place->tables->torque_per_ampere;
    const int64_t forwards_q24 = place->mirrored ? -(int64_t)torque_q24 : torque_q24;
    return current_of(surface, place, forwards_q24, TORQUE_SHIFT(surface));
}

int32_t phase_map_current_of_flux_q9(const phase_map_place_t *place, int32_t flux_q29) {
    const machine_surface_t *surface = &place->tables->flux_per_ampere;
    return current_of(surface, place, flux_q29, FLUX_SHIFT(surface));
}
