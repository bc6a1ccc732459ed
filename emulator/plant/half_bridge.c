#include "plant/half_bridge.h"

#include "plant/pwm_timer.h"

/* Edge in the first half of the period, in ticks from its start; the second half mirrors the first. */
typedef struct {
    uint16_t tick;
    half_bridge_switches_t toggles;
} half_edge_t;

static void insert_half_edge(half_edge_t *edges, unsigned *count, uint16_t tick, uint8_t upper, uint8_t lower) {
    unsigned at = *count;
    while (at > 0 && edges[at - 1].tick > tick) {
        edges[at] = edges[at - 1];
        at--;
    }
    edges[at] = (half_edge_t){tick, {upper, lower}};
    (*count)++;
}

static void append_edge(half_bridge_pattern_t *pattern, uint64_t time_ns, half_bridge_switches_t toggles) {
    half_bridge_switches_t switches = pattern->first;
    if (pattern->count > 0) {
        half_bridge_edge_t *last = &pattern->edges[pattern->count - 1];
        if (last->time_ns == time_ns) {
            last->switches.upper ^= toggles.upper;
            last->switches.lower ^= toggles.lower;
            return;
        }
        switches = last->switches;
    }
    switches.upper ^= toggles.upper;
    switches.lower ^= toggles.lower;
    pattern->edges[pattern->count++] = (half_bridge_edge_t){time_ns, switches};
}

/* Suppresses a pulse, or the gap between two pulses, that is too short: the compare value becomes 0 or the period. */
static uint16_t without_short_pulses(uint16_t compare, uint16_t period_ticks, double minimum_pulse_ns) {
    if (compare >= period_ticks) {
        return period_ticks;
    }
    if (2.0 * compare * PWM_TIMER_TICK_NS < minimum_pulse_ns) {
        return 0;
    }
    return 2.0 * (period_ticks - compare) * PWM_TIMER_TICK_NS < minimum_pulse_ns ? period_ticks : compare;
}

void half_bridge_pattern(half_bridge_pattern_t *pattern, unsigned phases, const hal_pwm_compare_t *compare,
                         uint16_t period_ticks, double minimum_pulse_ns, uint64_t start_ns) {
    half_edge_t half_edges[2 * HAL_PHASES_MAX];
    unsigned count = 0;
    pattern->first = (half_bridge_switches_t){0, 0};
    pattern->count = 0;
    for (unsigned phase = 0; phase < phases; phase++) {
        const uint16_t upper = without_short_pulses(compare->upper[phase], period_ticks, minimum_pulse_ns);
        const uint16_t lower = without_short_pulses(compare->lower[phase], period_ticks, minimum_pulse_ns);
        const uint8_t bit = (uint8_t)(1u << phase);
        if (upper == period_ticks) {
            pattern->first.upper |= bit;
        } else if (upper > 0) {
            insert_half_edge(half_edges, &count, (uint16_t)(period_ticks - upper), bit, 0);
        }
        if (lower > 0) {
            pattern->first.lower |= bit;
            if (lower < period_ticks) {
                insert_half_edge(half_edges, &count, lower, 0, bit);
            }
        }
    }
    for (unsigned edge = 0; edge < count; edge++) {
        append_edge(pattern, start_ns + (uint64_t)half_edges[edge].tick * PWM_TIMER_TICK_NS, half_edges[edge].toggles);
    }
    for (unsigned edge = count; edge-- > 0;) {
        append_edge(pattern, start_ns + (2u * (uint64_t)period_ticks - half_edges[edge].tick) * PWM_TIMER_TICK_NS,
                    half_edges[edge].toggles);
    }
}
