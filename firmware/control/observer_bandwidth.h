/* Bandwidth scheduling of the load observer: narrow in the steady state, wide after a disturbance.
 *
 *   w0(t) = min(transient, max(steady, 5 / t)),   t = time since the last trigger
 *
 * A fixed bandwidth cannot have both a small ripple (it passes the encoder's quantisation on to speed and torque
 * reference) and a small speed drop after a load step (the load must be detected first). An innovation beyond a
 * threshold triggers the transient bandwidth, which then decays as an estimator's does which restarts with the trigger
 * and weights all samples since equally: the expanding-memory polynomial filter of degree 2 (N. Morrison, "Introduction
 * to Sequential Smoothing and Prediction", McGraw-Hill, 1969), with its gains 9/t, 36/t^2, 60/t^3. The gains of a
 * triple pole at w0 = a / t are 3 a/t, 3 a^2/t^2, a^3/t^3. What was wrong at the trigger decays then as t^s (derived
 * here), with
 *
 *   (s + 3 a) (s - 1) (s - 2) + 3 a^2 (s - 2) + a^3 = 0
 *
 * It decays only for a > 3 + sqrt(3) = 4.73, where s = 0 is a root. With a = 3.5, which has the filter's gains in the
 * geometric mean, s = 0.7: the error of the angle grows, and is taken for a load that moves (moving_load.h).
 *
 * The threshold depends on the resolution of the angle: 1.125 counts for the middle of a count, 8 urad where the time
 * of the last edge is known. The latter has less noise, so its transient bandwidth is wider. Edges count as such only
 * while they are frequent, one each 100 us or more.
 *
 * No bandwidth is wider than the encoder allows. An innovation of one count 2 pi / 2^bits moves the load estimate
 * within 1 / w0 by about J w0^2 2 pi / 2^bits, which is limited to 3/5 of the largest torque after a trigger, to 1/6
 * while the load moves (moving_load.h), and to 1/20 in the steady state. Values found by trial: with twice as much, a
 * load step at 10 r/min is answered by a torque in the wrong direction.
 *
 * While the rotor turns by nearly a ratio p / q of counts in a period the rounding to counts is a slow sawtooth (a
 * beat), whose rounding by moving_load.h is 1/24 count or more. No bandwidth averages it: its steps of 1 / q counts
 * move the estimates of speed and load as far as the bandwidth is wide. So the steady bandwidth is narrower then,
 *
 *   J w0^2 2 pi / 2^bits = 1/512 of the largest torque,
 *
 * between 100 rad/s and the steady one, and the threshold is at least a step of the sawtooth, which is twice the
 * rounding, and 3/8 count; for all q but 1 it stays 1.125 counts. Narrower still, an error of the torque's estimate
 * moved the rotor from count to count: of an error T at any frequency the angle's is at most 0.385 T / (J w0^2), at w0
 * / sqrt(2) (derived here). A rotor that turns by less than half a count in a period has no beat: each count tells the
 * speed.
 *
 * With a wrong model (three times the inertia, tables half a degree off) each transient would trigger the next: a limit
 * cycle. Two measures suppress it. Each trigger lengthens the retrigger hold-off, the minimum time to the next trigger,
 * from 1 ms to at most 256 ms (a trigger in the steady state doubles it); it decays back exponentially. And in the
 * steady state the threshold is at least four times the mean magnitude of the innovation, so that what the model never
 * explains does not trigger.
 */
#ifndef CONTROL_OBSERVER_BANDWIDTH_H
#define CONTROL_OBSERVER_BANDWIDTH_H

#include <stdbool.h>
#include <stdint.h>

#include "control/load_observer.h"
#include "fixed/fixed.h"

/* Stages of the decay, each with 13/16 of the bandwidth before, but for the last ones: the steady bandwidth, and the
 * beat's, which is withheld without one. */
#define OBSERVER_BANDWIDTH_STAGES 19u
#define OBSERVER_BANDWIDTH_STEADY_STAGE (OBSERVER_BANDWIDTH_STAGES - 2)
#define OBSERVER_BANDWIDTH_BEAT_STAGE (OBSERVER_BANDWIDTH_STAGES - 1)

typedef struct {
    load_observer_gains_t gains;
    uint32_t bandwidth_rad_s;
    uint32_t end_ticks; /* end of the stage, periods since the trigger */
} observer_bandwidth_stage_t;

/* Which stage follows which, and when. */
typedef struct {
    uint32_t retrigger_holdoff_ticks; /* minimum hold-off after a trigger, periods */
    uint32_t holdoff_decay_q32;       /* decay factor of the hold-off extension per period, unsigned Q0.32 */
    uint32_t threshold_count;         /* 2^-32 rev, for the middle of a count */
    uint32_t threshold_edge;          /* 2^-32 rev, for an angle from the time of an edge */
    int32_t mean_innovation_gain_q32; /* low-pass gain of the mean innovation per period, Q0.32 */
    uint32_t threshold_error;         /* 2^-32 rev, besides the step of a beat */
    uint32_t beat_step_min;           /* rotation per period from which on there are beats, 2^-32 rev */
    uint32_t beat_rounding_min_q4;    /* rounding of a beat, 2^-32 rev, Q28.4 */
    uint32_t edge_step_min;           /* rotation per period from which edges are frequent, 2^-32 rev */
    bool adaptive;                    /* false: always the steady bandwidth */
    uint8_t trigger_stage_count;      /* first stage after a trigger by a count; by frequent edges stage 0 */
    uint8_t moving_stage;             /* while the load moves */
    uint8_t steady_stage_edge;        /* in the steady state with frequent edges */
} observer_bandwidth_schedule_t;

/* All of it is tunable in a run (configure_tune), a member or stage at a time. */
typedef struct {
    observer_bandwidth_schedule_t schedule;
    observer_bandwidth_stage_t stage[OBSERVER_BANDWIDTH_STAGES];
} observer_bandwidth_parameters_t;

/* Trigger in the last sample or samples. In the steady state it is a new event; during a decay it may belong to the
 * last one. */
typedef enum {
    OBSERVER_TRIGGER_NONE,
    OBSERVER_TRIGGER_IN_DECAY,
    OBSERVER_TRIGGER_IN_STEADY_STATE,
} observer_trigger_t;

/* Position in the schedule, advanced by every sample. */
typedef struct {
    unsigned stage;
    uint32_t ticks;             /* periods since the last trigger, saturates to 2^31 - 1 */
    observer_trigger_t trigger; /* since the caller last set it to OBSERVER_TRIGGER_NONE */
} observer_bandwidth_t;

/* Limits of the coming sample, besides the limits of the parameters. All zero at the start. */
typedef struct {
    uint32_t threshold_mean;    /* four times the mean innovation, 2^-32 rev */
    uint32_t holdoff_ticks;     /* minimum time to the next trigger, periods */
    uint8_t withheld_stages;    /* last stages that the decay does not reach */
    uint8_t trigger_stage_edge; /* first stage after a trigger by an edge */
} observer_bandwidth_limits_t;

/* Statistics from which the limits follow. */
typedef struct {
    uint32_t holdoff_extension_q16; /* hold-off beyond the minimum in the coming sample, in minimum hold-offs, Q8.16 */
    int64_t mean_innovation_q32;    /* mean magnitude of the innovation, 2^-32 rev, Q27.32 */
} observer_bandwidth_statistics_t;

/* Sample for the statistics. */
typedef struct {
    int32_t innovation; /* 2^-32 rev */
    bool from_edge;
    unsigned stage;             /* after the sample */
    observer_trigger_t trigger; /* since the last update */
} observer_bandwidth_sample_t;

typedef struct {
    uint32_t transient_rad_s; /* 100..10000 */
    uint32_t moving_rad_s;    /* while the load moves; not above the transient bandwidth, not below the steady one */
    uint32_t steady_rad_s;    /* 100..transient_rad_s; equal: no scheduling */
    unsigned encoder_bits;    /* 8..32 */
    uint32_t control_rate_hz;
    int32_t inertia_q30;    /* kg m^2, Q1.30 */
    int32_t torque_max_q24; /* of the drive, N m, Q7.24 */
} observer_bandwidth_settings_t;

/* Schedule of the settings, limited to what the encoder allows. */
observer_bandwidth_parameters_t observer_bandwidth_configure(const observer_bandwidth_settings_t *settings);

/* A stage; the last one for a number beyond, which has changed in memory. */
static inline const observer_bandwidth_stage_t *
observer_bandwidth_stage(const observer_bandwidth_parameters_t *parameters, unsigned stage) {
    return &parameters->stage[fixed_min_u32(stage, OBSERVER_BANDWIDTH_BEAT_STAGE)];
}

/* Starts at the transient bandwidth: the initial estimate is unknown. */
void observer_bandwidth_reset(observer_bandwidth_t *bandwidth);

/* One sample: returns its gains. `innovation` in 2^-32 rev, -2^27..2^27 - 1; from_edge: the angle was measured from the
 * time of an edge; it matters for an adaptive bandwidth, and is read then. */
const load_observer_gains_t *observer_bandwidth_step(const observer_bandwidth_parameters_t *parameters,
                                                     observer_bandwidth_t *bandwidth,
                                                     const observer_bandwidth_limits_t *limits, int32_t innovation,
                                                     const bool *from_edge);

/* Adaptive bandwidth: updates the statistics with a sample after its observer_bandwidth_step, and sets the limits
 * of the next one.
 * angle_step: rotation per period, magnitude, 2^-32 rev; rounding_q4: of moving_load_rounding_q4; withheld_stages: of
 * moving_load_step.
 * 64-bit products, rounded down. A sample that is left out does not change the statistics; its trigger counts in the
 * next. */
void observer_bandwidth_update(const observer_bandwidth_schedule_t *schedule,
                               observer_bandwidth_statistics_t *statistics, const observer_bandwidth_sample_t *sample,
                               uint32_t angle_step, uint32_t rounding_q4, uint32_t withheld_stages,
                               observer_bandwidth_limits_t *limits);

#endif
