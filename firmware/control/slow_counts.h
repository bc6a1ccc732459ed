/* Slow counts: correction of the load observer while an encoder of up to 12 bits counts less often than twice in a
 * millisecond. From 13 bits on a load step moves the rotor by a count so soon that the bandwidth's own law is better:
 * at standstill by a tenth to a third of the dip. They remain slow until one comes within 3/8 ms: where it is now one
 * law and now the other, the mean speed is neither's.
 *
 * Most samples then tell only that the rotor is within a count. Its middle, which is right for counts that pass within
 * a few periods, would draw speed and load towards a rotor at rest, and let them swing with each count. Instead:
 *
 *   the count has changed    the rotor is at the edge between both counts: innovation of that angle, with the gains of
 *                            an observer whose samples are the edges
 *   it has not, and the      none
 *   prediction is within it
 *   the prediction has       distance to it, with l1 = 1, so that the estimate remains at the edge until the rotor
 *   left it                  arrives there; l2, l3 of an edge now, but neither closer than 4 ms nor later than the
 *                            estimated speed takes for a count
 *
 * The gains are as in load_observer.h for edges a time t apart, with q = 1 - t / 4 ms, from 4 ms on q = 0, with
 * which three edges determine the estimate; l3 is half of that: a load that changed since the last edge has had less
 * time than t. Found by trial with 8 to 14 bits at 5 to 600 r/min. A prediction that is late has the gains of its own
 * time, not of 4 ms, because it contradicts the estimate by no more than its lateness: answered by gains of a
 * shorter time the rotor is driven to each edge and passes the next ones too early, and its mean speed is a third
 * above the estimated one.
 *
 * From 4 ms on the angle by which the estimate errs feeds back on itself: at the currents for the estimated angle the
 * rotor makes another torque, d2(error)/dt2 = (K / J) error with K the sum of the slopes dT/dtheta of the phases, up
 * to 180 N m / rad with 8 N m on the finite-element machine, where an error grows e-fold in 5 ms. By u = K t^2 / J the
 * error that arrives at an edge has the speed sqrt(u) coth(sqrt(u)) / t if it began as one of the speed, and
 * sqrt(u) coth(sqrt(u) / 2) / t if as one of the load; l2 is the mean of both, whose value without a slope is 1.5 / t:
 *
 *   l2 = (1.5 / t) (1 + 0.188 u) / (1 + 0.0293 u)
 *
 * within 6 percent, 10 at the lower end, for u = -2.25..36, to which u is limited: a torque that falls with the angle
 * holds the rotor.
 *
 * A rotor that has not left its count for a time t turns slowly, whatever the model expects: from t = 4 ms on the
 * magnitude of the estimated speed is at most 4 counts / t. Without this bound a rotor that is locked within a count
 * may keep the speed of its reference for half a second, because the estimated load takes up what the edge corrects,
 * and its stall shows that much later. 8 counts do as well; 2 disturb a rotor whose speed swings between the counts.
 */
#ifndef CONTROL_SLOW_COUNTS_H
#define CONTROL_SLOW_COUNTS_H

#include <stdbool.h>
#include <stdint.h>

#include "control/load_observer.h"

typedef struct {
    uint32_t slow_periods;          /* 0.5 ms; UINT32_MAX: counts are never slow */
    uint32_t fast_periods;          /* 0.375 ms, below which they are no longer */
    uint32_t deadbeat_periods;      /* 4 ms */
    uint32_t count;                 /* 2^-32 rev */
    int32_t slope_gain_q16;         /* u of 4 ms for a slope in N m per 0.02 rad */
    uint32_t step_q31;              /* 1 / deadbeat_periods */
    int32_t late_speed_q22;         /* 4 counts in 4 ms, rad/s, Q9.22 */
    load_observer_gains_t deadbeat; /* of edges that far apart, and of a prediction outside the count */
} slow_counts_parameters_t;

/* All zero at the start. */
typedef struct {
    uint32_t encoder_angle; /* start of the count, 2^-32 rev */
    uint32_t periods;       /* since it changed, saturates at 2^20 */
    uint32_t interval;      /* in which the estimated speed passes a count, or since then */
    uint32_t apart;         /* periods between the last two changes */
    bool slow;
    bool late;                  /* the interval is longer than 4 ms */
    int32_t speed_max_q22;      /* largest magnitude of the speed until then, rad/s, Q9.22 */
    load_observer_gains_t edge; /* when the count changes, and when the prediction leaves it late */
} slow_counts_t;

/* Values that the coming sample needs; the rest has a meaning while counts are slow. */
typedef struct {
    bool slow;
    bool late;
    uint32_t encoder_angle; /* of the last sample */
    int32_t speed_max_q22;  /* while it is the same, rad/s, Q9.22 */
    load_observer_gains_t edge;
} slow_counts_results_t;

slow_counts_parameters_t slow_counts_configure(uint32_t control_rate_hz, unsigned encoder_bits, int32_t inertia_q30);

/* After a sample: encoder_angle is the start of its count, angle the one predicted for the next sample, 2^-32 rev;
 * periods: since the sample before. True when counts are slow. */
bool slow_counts_step(const slow_counts_parameters_t *parameters, slow_counts_t *counts, uint32_t encoder_angle,
                      uint32_t angle, uint32_t periods);

/* Gains of the coming samples, while counts are slow. slope_q24: K in N m per 0.02 rad, Q7.24. Products of 64 bits,
 * rounded to 2 LSB, by the slope's factor down; up to four 32-bit divisions when no count changed for 4 ms. */
void slow_counts_update(const slow_counts_parameters_t *parameters, slow_counts_t *counts, int32_t slope_q24);

/* All results but `slow`. */
static inline void slow_counts_set(const slow_counts_t *counts, slow_counts_results_t *results) {
    results->late = counts->late;
    results->encoder_angle = counts->encoder_angle;
    results->speed_max_q22 = counts->speed_max_q22;
    results->edge = counts->edge;
}

/* Angle by which the estimate may err between the counts: a quarter of a count for each 4 ms that they are apart, at
 * most two counts; 2^-32 rev. */
uint32_t slow_counts_uncertain_angle(const slow_counts_parameters_t *parameters, const slow_counts_t *counts);

/* Angle of a sample with slow counts: the edge where the count has changed, else what in the count is nearest to the
 * prediction. All in 2^-32 rev. */
uint32_t slow_counts_angle(const slow_counts_results_t *results, const load_observer_t *observer,
                           uint32_t encoder_angle, unsigned encoder_shift);

/* Gains of that sample. */
const load_observer_gains_t *slow_counts_gains(const slow_counts_parameters_t *parameters,
                                               const slow_counts_results_t *results, uint32_t encoder_angle);

#endif
