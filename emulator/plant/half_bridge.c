#include "plant/half_bridge.h"

#include <math.h>
#include <stdbool.h>

#include "plant/pwm_timer.h"

uint32_t half_bridge_shortest_ticks(double minimum_pulse_ns) {
    return (uint32_t)fmin(ceil(minimum_pulse_ns * (0.5 / PWM_TIMER_TICK_REAL_NS)), UINT16_MAX);
}

/* Suppresses a pulse, or the gap between two pulses, that is too short: the compare value becomes 0 or the period. */
static inline uint32_t without_short_pulses(uint32_t compare, uint32_t period_ticks, uint32_t shortest_ticks) {
    if (compare >= period_ticks) {
        return period_ticks;
    }
    if (compare < shortest_ticks) {
        return 0;
    }
    return period_ticks - compare < shortest_ticks ? period_ticks : compare;
}

void half_bridge_pattern(half_bridge_pattern_t *pattern, uint16_t upper, uint16_t lower, uint16_t period_ticks,
                         uint32_t shortest_ticks) {
    const uint32_t period = period_ticks;
    const uint32_t upper_ticks = without_short_pulses(upper, period, shortest_ticks);
    const uint32_t lower_ticks = without_short_pulses(lower, period, shortest_ticks);
    const uint32_t rise = period - upper_ticks; /* of the upper switch; the lower one falls at lower_ticks */
    const bool rises = rise > 0 && rise<period, falls = lower_ticks> 0 && lower_ticks < period;

    /* The edges of the first half; the second half mirrors them. */
    uint32_t ticks[2] = {rise, lower_ticks};
    uint8_t toggles[2] = {HALF_BRIDGE_UPPER, HALF_BRIDGE_LOWER};
    unsigned count = 2;
    if (!(rises && falls)) {
        count = rises || falls ? 1 : 0;
        if (falls) {
            ticks[0] = lower_ticks;
            toggles[0] = HALF_BRIDGE_LOWER;
        }
    } else if (rise == lower_ticks) {
        count = 1;
        toggles[0] = HALF_BRIDGE_UPPER | HALF_BRIDGE_LOWER;
    } else if (lower_ticks < rise) {
        ticks[0] = lower_ticks;
        ticks[1] = rise;
        toggles[0] = HALF_BRIDGE_LOWER;
        toggles[1] = HALF_BRIDGE_UPPER;
    }
    uint8_t switches = (uint8_t)((rise == 0 ? HALF_BRIDGE_UPPER : 0u) | (lower_ticks > 0 ? HALF_BRIDGE_LOWER : 0u));
    pattern->first = switches;
    pattern->count = (uint8_t)(2 * count);
    for (unsigned edge = 0; edge < count; edge++) {
        switches ^= toggles[edge];
        pattern->delay_ns[edge] = (uint32_t)pwm_timer_ns(ticks[edge]);
        pattern->switches[edge] = switches;
    }
    for (unsigned edge = count; edge-- > 0;) {
        switches ^= toggles[edge];
        pattern->delay_ns[2 * count - 1 - edge] = (uint32_t)pwm_timer_ns(2 * period - ticks[edge]);
        pattern->switches[2 * count - 1 - edge] = switches;
    }
}
