/* The asymmetric half bridges' switches over time: from compare values to edges. */
#ifndef PLANT_HALF_BRIDGE_H
#define PLANT_HALF_BRIDGE_H

#include <stdint.h>

#include "hal.h"
#include "hal_pwm.h"

#define HALF_BRIDGE_EDGES_MAX (4 * HAL_PHASES_MAX)

/* Switches that are on from some instant; bit j is phase j. */
typedef struct {
    uint8_t upper;
    uint8_t lower;
} half_bridge_switches_t;

typedef struct {
    uint64_t time_ns;
    half_bridge_switches_t switches; /* from this instant */
} half_bridge_edge_t;

/* One control period. */
typedef struct {
    half_bridge_switches_t first; /* from its start */
    unsigned count;
    half_bridge_edge_t edges[HALF_BRIDGE_EDGES_MAX]; /* rising in time */
} half_bridge_pattern_t;

/* The pattern of a period of 2 * period_ticks timer ticks that begins at start_ns: the switches follow `compare` as
 * hal_pwm.h says, edges exact to the nanosecond. A pulse of a switch within the period that is shorter than
 * minimum_pulse_ns does not happen, and neither does a gap. The lower switch's pulse and the upper switch's gap lie
 * around the period's ends; it is their part within this period that counts, so that what happens is decided when the
 * period begins. period_ticks > 0, 1 <= phases <= HAL_PHASES_MAX. */
void half_bridge_pattern(half_bridge_pattern_t *pattern, unsigned phases, const hal_pwm_compare_t *compare,
                         uint16_t period_ticks, double minimum_pulse_ns, uint64_t start_ns);

#endif
