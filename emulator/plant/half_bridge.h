/* Switching edges of the asymmetric half bridges from the compare values of the PWM timer. */
#ifndef PLANT_HALF_BRIDGE_H
#define PLANT_HALF_BRIDGE_H

#include <stdint.h>

#include "hal.h"
#include "hal_pwm.h"

/* Each switch of a phase has at most two edges in a period. */
#define HALF_BRIDGE_EDGES_MAX 4

/* Switches of all phases; bit j is phase j. */
typedef struct {
    uint8_t upper;
    uint8_t lower;
} half_bridge_switches_t;

/* Switches of one phase that are on: a sum of these. */
#define HALF_BRIDGE_LOWER 1u
#define HALF_BRIDGE_UPPER 2u

/* Number of switches of a phase that are on. */
static inline unsigned half_bridge_on(unsigned switches) {
    return (switches & 1u) + (switches >> 1);
}

typedef struct {
    uint8_t first;                            /* switches that are on from the start of the period */
    uint8_t count;                            /* of the edges */
    uint8_t switches[HALF_BRIDGE_EDGES_MAX];  /* that are on after each edge */
    uint32_t delay_ns[HALF_BRIDGE_EDGES_MAX]; /* of each edge after the start of the period, ascending */
} half_bridge_pattern_t;

/* Computes one phase's pattern of a period of 2 * period_ticks timer ticks from its compare values, with edges exact to
 * the nanosecond (pwm_timer.h); hal_pwm.h defines how the switches follow them. Pulses and gaps of a switch within the
 * period that are shorter than 2 * shortest_ticks are suppressed. The lower switch's pulse and the upper switch's gap
 * lie around the ends of the period; only their part within this period counts, so that the pattern depends on no later
 * period. period_ticks > 0. */
void half_bridge_pattern(half_bridge_pattern_t *pattern, uint16_t upper, uint16_t lower, uint16_t period_ticks,
                         uint32_t shortest_ticks);

/* Half of the shortest pulse in timer ticks, rounded up; minimum_pulse_ns >= 0. */
uint32_t half_bridge_shortest_ticks(double minimum_pulse_ns);

#endif
