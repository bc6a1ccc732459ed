/* Switching edges of the asymmetric half bridges from the compare values of the PWM timer. */
#ifndef PLANT_HALF_BRIDGE_H
#define PLANT_HALF_BRIDGE_H

#include <stdint.h>

#include "hal.h"
#include "hal_pwm.h"

#define HALF_BRIDGE_EDGES_MAX (4 * HAL_PHASES_MAX)

/* Switches that are on; bit j is phase j. */
typedef struct {
    uint8_t upper;
    uint8_t lower;
} half_bridge_switches_t;

typedef struct {
    uint64_t time_ns;
    half_bridge_switches_t switches; /* from time_ns on */
} half_bridge_edge_t;

/* One control period. */
typedef struct {
    half_bridge_switches_t first; /* from the start of the period */
    unsigned count;
    half_bridge_edge_t edges[HALF_BRIDGE_EDGES_MAX]; /* in ascending order of time */
} half_bridge_pattern_t;

/* Computes the pattern of a period of 2 * period_ticks timer ticks that begins at start_ns, with edges exact to the
 * nanosecond; hal_pwm.h defines how the switches follow `compare`. Pulses and gaps of a switch within the period that
 * are shorter than minimum_pulse_ns are suppressed. The lower switch's pulse and the upper switch's gap lie around the
 * ends of the period; only their part within this period counts, so that the pattern depends on no later period.
 * period_ticks > 0, 1 <= phases <= HAL_PHASES_MAX. */
void half_bridge_pattern(half_bridge_pattern_t *pattern, unsigned phases, const hal_pwm_compare_t *compare,
                         uint16_t period_ticks, double minimum_pulse_ns, uint64_t start_ns);

#endif
