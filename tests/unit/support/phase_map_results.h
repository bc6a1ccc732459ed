// Torque and flux linkage of the phase map at any electrical angle and any current, which is clamped to the tables, in
// N m, Q7.24, and Wb, Q2.29.
#ifndef TESTS_UNIT_PHASE_MAP_RESULTS_H
#define TESTS_UNIT_PHASE_MAP_RESULTS_H

#include <algorithm>
#include <cstdint>

extern "C" {
#include "control/phase_map.h"
}

namespace phase_map_results {

inline int32_t clamped_q9(int32_t current_q9) {
    return std::clamp(current_q9, 0, int32_t(PHASE_MAP_CURRENT_MAX_Q9));
}

// Flux linkage in units of the tables, which the firmware takes from cells only.
inline int32_t flux_units(const machine_tables_t &tables, uint32_t angle, int32_t current_q9) {
    const int32_t clamped = clamped_q9(current_q9);
    const phase_map_lookup_t lookup = phase_map_lookup(&tables, phase_map_distance(angle));
    const phase_map_nodes_t nodes = phase_map_nodes(&lookup, uint32_t(clamped) >> MACHINE_COLUMN_BITS);
    return phase_map_between(phase_map_flux_value_q14(&lookup, &nodes, 0),
                             phase_map_flux_value_q14(&lookup, &nodes, MACHINE_TO_NEXT_COLUMN), clamped);
}

inline int32_t torque_q24(const machine_tables_t &tables, uint32_t angle, int32_t current_q9) {
    return phase_map_scale(&tables.torque_format, phase_map_torque(&tables, angle, clamped_q9(current_q9)));
}

inline int32_t flux_q29(const machine_tables_t &tables, uint32_t angle, int32_t current_q9) {
    return phase_map_scale(&tables.flux_format, flux_units(tables, angle, current_q9));
}

} // namespace phase_map_results

#endif
