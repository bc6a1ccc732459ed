/* Slow counts: correction of the load observer while an encoder of up to 12 bits counts less often than twice in a
 * millisecond. From 13 bits on a load step moves the rotor by a count so soon that the bandwidth's own law is better:
 * at standstill by a tenth to a third of the dip.
 *
 * Most samples then tell only that the rotor is within a count. Its middle, which is right for counts that pass within
 * a few periods, would draw speed and load towards a rotor at rest, and let them swing with each count. Instead:
 *
 *   the count has changed    the rotor is at the edge between both counts: innovation of that angle, with the gains of
 *                            an observer whose samples are the edges
 *   it has not, and the      none
 *   prediction is within it
 *   the prediction has       distance to it, with l1 = 1, so that the estimate remains at the edge until the rotor
 *   left it                  arrives there, and l2, l3 for edges each 4 ms
 *
 * The gains are those of load_observer.h for edges a time t apart, with q = 1 - t / 4 ms, from 4 ms on q = 0, with
 * which three edges determine the estimate; l3 is half of that: a load that changed since the last edge has had less
 * time than t. Found by trial with 8 to 14 bits at 5 to 600 r/min.
 */
#ifndef CONTROL_SLOW_COUNTS_H
#define CONTROL_SLOW_COUNTS_H

#include <stdbool.h>
#include <stdint.h>

#include "control/load_observer.h"

typedef struct {
    uint32_t slow_periods;          /* 0.5 ms; UINT32_MAX: counts are never slow */
    uint32_t deadbeat_periods;      /* 4 ms */
    uint32_t step_q31;              /* 1 / deadbeat_periods */
    load_observer_gains_t deadbeat; /* of edges that far apart, and of a prediction outside the count */
} slow_counts_parameters_t;

/* All zero at the start. */
typedef struct {
    uint32_t encoder_angle; /* start of the count, 2^-32 rev */
    uint32_t periods;       /* since it changed, saturates at 2^20 */
    bool slow;
} slow_counts_t;

/* What the coming sample needs; the rest has a meaning while counts are slow. */
typedef struct {
    bool slow;
    uint32_t encoder_angle;     /* of the last sample */
    load_observer_gains_t edge; /* when it changes */
} slow_counts_results_t;

slow_counts_parameters_t slow_counts_configure(uint32_t control_rate_hz, unsigned encoder_bits, int32_t inertia_q30);

/* After a sample: encoder_angle is the start of its count, 2^-32 rev; periods: since the sample before. True when
 * counts are slow. */
bool slow_counts_step(const slow_counts_parameters_t *parameters, slow_counts_t *counts, uint32_t encoder_angle,
                      uint32_t periods);

/* All results but `slow`. Products of 64 bits, rounded down; a 32-bit division when no count changed for 4 ms. */
void slow_counts_set(const slow_counts_parameters_t *parameters, const slow_counts_t *counts,
                     slow_counts_results_t *results);

/* Angle of a sample with slow counts: the edge where the count has changed, else what in the count is nearest to the
 * prediction. All in 2^-32 rev. */
uint32_t slow_counts_angle(const slow_counts_results_t *results, const load_observer_t *observer,
                           uint32_t encoder_angle, unsigned encoder_shift);

/* Gains of that sample. */
const load_observer_gains_t *slow_counts_gains(const slow_counts_parameters_t *parameters,
                                               const slow_counts_results_t *results, uint32_t encoder_angle);

#endif
