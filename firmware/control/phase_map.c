#include "control/phase_map.h"

static inline uint32_t index_of(const phase_map_lookup_t *lookup, int32_t current_q9) {
    return phase_map_index(lookup, (uint32_t)current_q9 >> MACHINE_COLUMN_BITS);
}

int32_t phase_map_torque(const machine_tables_t *tables, uint32_t phase_angle, int32_t current_q9) {
    const phase_map_lookup_t lookup = phase_map_lookup(tables, phase_map_distance(phase_angle));
    const phase_map_nodes_t nodes = phase_map_nodes(&lookup, (uint32_t)current_q9 >> MACHINE_COLUMN_BITS);
    const int32_t torque =
        phase_map_between(phase_map_torque_value_q14(&lookup, &nodes, 0),
                          phase_map_torque_value_q14(&lookup, &nodes, MACHINE_TO_NEXT_COLUMN), current_q9);
    const int32_t sign = (int32_t)(phase_angle - HALF_REV) >> 31; /* -1 in the mirrored half: -t is ~t + 1 */
    return (torque ^ sign) - sign;
}

int32_t phase_map_torque_slope_q24(const machine_tables_t *tables, uint32_t phase_angle, int32_t current_q9,
                                   uint32_t angle_step) {
    const machine_format_t *format = &tables->torque_format;
    const phase_map_lookup_t lookup = phase_map_lookup(tables, phase_map_distance(phase_angle));
    const machine_row_t *row = &tables->row[lookup.row];
    const int32_t ratio_q14 = fixed_multiply_high((int32_t)angle_step, row->reciprocal);
    /* Over the width of a row: difference of the nodes less (1 - 2 u) times the curvature, within 2^30 + 2^29. */
    const int32_t curvature_q14 = (ONE_Q14 - 2 * (int32_t)(lookup.weights_q14 >> 16)) * (1 << format->curvature_shift);
    int32_t slope_q14[2];
    for (unsigned i = 0; i < 2; i++) {
        const uint32_t index = index_of(&lookup, current_q9) + i * MACHINE_TO_NEXT_COLUMN;
        slope_q14[i] = dual16_multiply_add(&tables->node[index], dual16_pack(-ONE_Q14, ONE_Q14), 0) -
                       tables->curvature[index] * curvature_q14;
    }
    const int32_t product = phase_map_between(slope_q14[0] / 2, slope_q14[1] / 2, current_q9);
    return fixed_saturate(((int64_t)product * ratio_q14) >> (13 - format->result_shift));
}

int32_t phase_map_flux_q29(const machine_tables_t *tables, uint32_t distance, int32_t current_q9) {
    const int32_t clamped_q9 = fixed_clamp(current_q9, 0, PHASE_MAP_CURRENT_MAX_Q9);
    const phase_map_lookup_t lookup = phase_map_lookup(tables, distance);
    const phase_map_nodes_t nodes = phase_map_nodes(&lookup, (uint32_t)clamped_q9 >> MACHINE_COLUMN_BITS);
    return phase_map_scale(&tables->flux_format,
                           phase_map_between(phase_map_flux_value_q14(&lookup, &nodes, 0),
                                             phase_map_flux_value_q14(&lookup, &nodes, MACHINE_TO_NEXT_COLUMN),
                                             clamped_q9));
}
