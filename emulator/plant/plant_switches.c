#include "plant/plant_switches.h"

#include "plant/min_max.h"

void plant_set_switches(plant_t *plant, const hal_pwm_compare_t *compare, uint16_t period_ticks) {
    const bool other = period_ticks != plant->pattern_source.period_ticks ||
                       !(plant->minimum_pulse_ns == plant->pattern_source.minimum_pulse_ns);
    const uint32_t shortest_ticks =
        other ? half_bridge_shortest_ticks(plant->minimum_pulse_ns) : plant->pattern_source.shortest_ticks;
    plant->pattern_ns = plant->time_ns;
    plant->pattern_source.period_ticks = period_ticks;
    plant->pattern_source.minimum_pulse_ns = plant->minimum_pulse_ns;
    plant->pattern_source.shortest_ticks = shortest_ticks;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        const uint16_t upper = compare->upper[phase], lower = compare->lower[phase];
        if (other || upper != plant->pattern_source.compare.upper[phase] ||
            lower != plant->pattern_source.compare.lower[phase]) {
            half_bridge_pattern(&plant->pattern[phase], upper, lower, period_ticks, shortest_ticks);
            plant->pattern_source.compare.upper[phase] = upper;
            plant->pattern_source.compare.lower[phase] = lower;
        }
        plant->edge_next[phase] = 0;
        plant->switches[phase] = plant->pattern[phase].first;
    }
}

uint64_t plant_follow_edges(plant_t *plant, uint64_t to_ns) {
    uint64_t next_ns = to_ns;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        const half_bridge_pattern_t *pattern = &plant->pattern[phase];
        for (; plant->edge_next[phase] < pattern->count; plant->edge_next[phase]++) {
            const uint64_t edge_ns = plant->pattern_ns + pattern->delay_ns[plant->edge_next[phase]];
            if (edge_ns > plant->time_ns) {
                next_ns = min_u64(edge_ns, next_ns);
                break;
            }
            plant->switches[phase] = pattern->switches[plant->edge_next[phase]];
        }
    }
    return next_ns;
}

void plant_open_all(plant_t *plant) {
    plant->pattern_source.period_ticks = 0;
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        plant->switches[phase] = plant->pattern[phase].count = plant->edge_next[phase] = 0;
    }
}
