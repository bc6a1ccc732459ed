/* Mean load over a stroke, and whether it is constant.
 *
 * What a wrong table adds to the load estimate repeats with every stroke and has the same mean in each; a load that
 * changes has not. The mean of each stroke is compared with the same phase's in the first stroke of the present load:
 * phases whose misalignments differ have different means, and successive strokes at a high speed differ by little even
 * while the load changes quickly. That mean is followed slowly, by half in 0.2 s, because learning a misalignment moves
 * it, by a quarter of the torque in a second. A phase that has not been seen since a change may instead have the mean
 * of the stroke after which the load counts as changed: the misalignment of the encoder is common to all phases, and at
 * 10 r/min each takes a second to come.
 *
 * A load that moves with nearly the frequency of the strokes, or faster, has the same mean in each. Below 53 strokes a
 * second it is found by its course within them:
 *
 *   h = (mean of the first half - mean of the second half) / 2,   d = mean |load - mean that is compared with|
 *
 * The h of a misalignment repeats with each stroke of its phase, and learning takes it towards 0; the h of a load has
 * any size and sign. So the load has changed also when h is larger than in the same phase's last stroke, or than
 * half of it in the other direction. A load with several periods in a stroke has hardly any h, but d. A misalignment
 * has both: of 4 degrees, d is about 1.5 |h|. So the load has changed also when d is more than 2 |h|. Tolerances: half
 * of the mean's for h, 5/4 of it for d. */
#ifndef CONTROL_STROKE_MEAN_H
#define CONTROL_STROKE_MEAN_H

#include <stdbool.h>
#include <stdint.h>

#include "hal.h"

typedef struct {
    uint32_t phases;
    uint32_t settle_updates; /* updates without a change before a load is constant: 150 ms */
} stroke_mean_parameters_t;

/* Stroke that has ended, for stroke_mean_review. */
typedef struct {
    int32_t half;           /* sum of h, N m, 2^8 of Q24, from 256 updates on 2^16 */
    uint32_t deviation;     /* of d, likewise */
    uint32_t updates;       /* in the sums; 0: no stroke has ended */
    uint32_t tolerance_q24; /* of h, N m, Q7.24 */
    uint32_t phase;
} stroke_mean_ended_t;

/* All zero at the start. */
typedef struct {
    int64_t sum_q24;                      /* N m, Q24, since the stroke began */
    int64_t half_sum_q24;                 /* the same of the halves of the stroke, the second one negative */
    uint64_t deviation_sum_q24;           /* of the magnitude of the load less the mean that is compared with */
    uint32_t updates;                     /* in the sums */
    uint32_t stroke;                      /* number of the stroke in the electrical revolution */
    int32_t constant_q24[HAL_PHASES_MAX]; /* means that are compared with, N m, Q7.24 */
    int32_t changed_q24;                  /* mean of the stroke that showed the last change, N m, Q7.24 */
    uint32_t amplitude_q24;               /* |h| of the last stroke, N m, Q7.24 */
    int32_t half_q24[HAL_PHASES_MAX];     /* h of the last stroke of each phase, N m, Q7.24; INT32_MIN: unknown */
    bool changed;                         /* the load, in the stroke that ended last */
    bool grown;                           /* the amplitude, in that stroke or the one before */
    bool last_grown;                      /* in that stroke itself */
    stroke_mean_ended_t ended;
    uint32_t remaining;         /* updates until the load is constant */
    uint32_t disturbed_strokes; /* of the present load, less the undisturbed ones since */
    bool disturbed;             /* in this stroke */
    bool undisturbed_stroke;    /* the last one was: its mean has shown the load */
} stroke_mean_t;

/* Rate of the updates in Hz. */
stroke_mean_parameters_t stroke_mean_configure(unsigned phases, uint32_t update_rate_hz);

/* One update; true if the load is constant: within the last 150 ms, and the last two strokes, no mean changed by
 * more than 0.1 N m and 1/16 of the torque, by which learning itself moves it, 1/8 while strokes are disturbed.
 * electrical: angle of phase 0, 2^-32 electrical rev; load and torque in N m, Q7.24. Strokes of fewer than 8 updates
 * are not separated. */
bool stroke_mean_step(const stroke_mean_parameters_t *parameters, stroke_mean_t *mean, uint32_t electrical,
                      int32_t load_torque_q24, int32_t torque_q24, bool disturbed);

/* After an update for which stroke_mean_to_review: whether the course of the load in the stroke that has ended shows
 * another load, which is then not constant for the same time. */
void stroke_mean_review(const stroke_mean_parameters_t *parameters, stroke_mean_t *mean);

/* True if a stroke has ended in the last update. */
static inline bool stroke_mean_ended(const stroke_mean_t *mean) {
    return mean->updates == 1;
}

/* True if one has ended in the update before. */
static inline bool stroke_mean_to_review(const stroke_mean_t *mean) {
    return mean->updates == 2 && mean->ended.updates > 0;
}

/* True if no disturbance is left of which the mean has not shown yet whether it was a change of the load: there was
 * none in this stroke and the last, or strokes of equal mean keep being disturbed, by the machine itself. */
bool stroke_mean_shows_load(const stroke_mean_t *mean);

#endif
