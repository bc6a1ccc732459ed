#include "control/torque_map.h"

#include "fixed/fixed.h"

#define HALF_PITCH 0x80000000u
#define COLUMN (1 << MACHINE_TORQUE_COLUMN_BITS)

typedef struct {
    const int16_t *low; /* row at or before the angle */
    const int16_t *high;
    int32_t fraction_q16;
} rows_t;

/* The two rows around an angle counted from the unaligned position, 0..2^31-1. */
static rows_t rows_at(const machine_tables_t *tables, uint32_t distance) {
    const uint32_t row = distance >> MACHINE_TORQUE_ROW_BITS;
    return (rows_t){
        .low = tables->torque_q8[row],
        .high = tables->torque_q8[row + 1],
        .fraction_q16 = (int32_t)((distance >> (MACHINE_TORQUE_ROW_BITS - 16)) & 0xFFFFu),
    };
}

/* Between two rows: entries below 2^15 in Q8 or 2^26 in Q18, times a 16-bit fraction: 64 bits. */
static int64_t between(int32_t low, int32_t high, int32_t fraction_q16) {
    return (int64_t)low * 65536 + (int64_t)(high - low) * fraction_q16;
}

int32_t torque_map_torque_q24(const machine_tables_t *tables, uint32_t phase_angle, int32_t current_q9) {
    const int mirrored = phase_angle < HALF_PITCH;
    uint32_t distance = mirrored ? HALF_PITCH - phase_angle : phase_angle - HALF_PITCH;
    if (distance >= HALF_PITCH) {
        distance = HALF_PITCH - 1; /* aligned, seen from the mirrored side */
    }
    const rows_t rows = rows_at(tables, distance);

    const int32_t current = fixed_clamp(current_q9, 0, TORQUE_MAP_CURRENT_MAX_Q9 - 1);
    const uint32_t column = (uint32_t)current >> MACHINE_TORQUE_COLUMN_BITS;
    const int32_t part = current & (COLUMN - 1);
    /* Q8 times the column's 10 bits: Q18, below 2^26. */
    const int32_t low_q18 = rows.low[column] * COLUMN + (rows.low[column + 1] - rows.low[column]) * part;
    const int32_t high_q18 = rows.high[column] * COLUMN + (rows.high[column + 1] - rows.high[column]) * part;
    const int32_t torque_q24 = (int32_t)fixed_shift(between(low_q18, high_q18, rows.fraction_q16), 10);
    return mirrored ? -torque_q24 : torque_q24;
}

int32_t torque_map_current_q9(const machine_tables_t *tables, uint32_t phase_angle, int32_t torque_q24) {
    if (torque_q24 <= 0) {
        return 0;
    }
    const rows_t rows = rows_at(tables, phase_angle - HALF_PITCH);
    /* Torque rises with current in every row: halve the interval of columns that holds it. */
    uint32_t below = 0;
    uint32_t above = MACHINE_TORQUE_CURRENTS - 1;
    if (between(rows.low[above], rows.high[above], rows.fraction_q16) <= torque_q24) {
        return TORQUE_MAP_CURRENT_MAX_Q9;
    }
    while (above - below > 1) {
        const uint32_t middle = (below + above) / 2;
        if (between(rows.low[middle], rows.high[middle], rows.fraction_q16) <= torque_q24) {
            below = middle;
        } else {
            above = middle;
        }
    }
    const int64_t low_q24 = between(rows.low[below], rows.high[below], rows.fraction_q16);
    const int64_t high_q24 = between(rows.low[above], rows.high[above], rows.fraction_q16);
    const int64_t step_q24 = high_q24 - low_q24; /* > 0: low <= torque < high */
    return (int32_t)(below << MACHINE_TORQUE_COLUMN_BITS) + (int32_t)(((torque_q24 - low_q24) * COLUMN) / step_q24);
}
