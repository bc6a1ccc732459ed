/* Bandwidth of the load observer over time: narrow while the model explains what the encoder shows, wide when it does
 * not.
 *
 * A fixed bandwidth cannot give both a small ripple (it passes the encoder's steps on to speed and torque reference)
 * and a small dip (it must see a load first). An innovation beyond a threshold wakes the observer: the bandwidth jumps
 * and decays as 3.5 / t, the schedule of an estimate that starts anew and averages over the time since, down to the
 * steady one. What the threshold is depends on what the angle is good to: 1.125 counts where it is the middle of a
 * count, 8 urad where the time of the last edge is known; a wider start with the latter, whose noise is smaller.
 *
 * A drive whose model is wrong (three times the inertia, tables half a degree off) would wake again and again, each
 * time by what the last one stirred up: a limit cycle. Two things end it. Each waking lengthens the pause before the
 * next can come, from 1 ms to at most 256 ms, one out of the steady state to twice as long, and time shrinks the pause
 * again. And in the steady bandwidth the threshold follows four times the mean size of the innovation, so that what the
 * model always leaves unexplained wakes nobody.
 */
#ifndef CONTROL_OBSERVER_BANDWIDTH_H
#define CONTROL_OBSERVER_BANDWIDTH_H

#include <stdbool.h>
#include <stdint.h>

#include "control/load_observer.h"

/* Stages of the decay, each 13/16 of the one before, the last the steady one. */
#define OBSERVER_BANDWIDTH_STAGES 18

typedef struct {
    load_observer_gains_t gains[OBSERVER_BANDWIDTH_STAGES];
    uint16_t bandwidth_rad_s[OBSERVER_BANDWIDTH_STAGES];
    uint32_t end_ticks[OBSERVER_BANDWIDTH_STAGES]; /* periods since the waking at which a stage ends */
    uint32_t pause_ticks;                          /* least pause after a waking, in periods */
    uint32_t forget_q32;                           /* what is left of a longer one a period later */
    uint32_t threshold_count;                      /* 2^-32 turn, for the middle of a count */
    uint32_t threshold_edge;                       /* for an angle from an edge's time */
    int32_t usual_share_q32;                       /* of the mean innovation a period */
    bool wakes;                                    /* false: always the steady bandwidth */
    uint8_t first_stage_count; /* where the decay begins; with an edge's time in stage 0, the widest */
} observer_bandwidth_parameters_t;

typedef struct {
    unsigned stage;
    uint32_t ticks;     /* since the last waking */
    uint32_t pause_q16; /* by how many least pauses the pause is longer */
    int64_t usual_q32;  /* mean size of the innovation, 2^-32 turn */
} observer_bandwidth_t;

/* Schedule from widest to steady bandwidth in rad/s (100 <= steady <= widest <= 10000). steady == widest: never wakes.
 */
observer_bandwidth_parameters_t observer_bandwidth_configure(uint32_t widest_rad_s, uint32_t steady_rad_s,
                                                             unsigned encoder_bits, uint32_t control_rate_hz,
                                                             int32_t inertia_q30);

/* Awake at its widest: what is known at the start is nothing. */
void observer_bandwidth_reset(observer_bandwidth_t *bandwidth);

/* One sample: the gains for it. `innovation` in 2^-32 turn, -2^27..2^27-1; from_edge: the angle was measured by an
 * edge's time. */
const load_observer_gains_t *observer_bandwidth_step(const observer_bandwidth_parameters_t *parameters,
                                                     observer_bandwidth_t *bandwidth, int32_t innovation,
                                                     bool from_edge);

/* True when the decay has ended, or there is none. */
bool observer_bandwidth_steady(const observer_bandwidth_parameters_t *parameters,
                               const observer_bandwidth_t *bandwidth);

#endif
