/* Moving load: a load that changes all the time, as that of a piston compressor, detected by the trend of the
 * innovation.
 *
 * The load observer assumes a constant load. Under one that changes at a rate r its innovation has the mean
 *
 *   e = r / (J w0^3)
 *
 * (derived here: the triple pole of load_observer.h at z = 1), and the speed is wrong by 3 w0 e. That mean stays below
 * the threshold of observer_bandwidth.h, which belongs to single samples, and that threshold follows it. So the mean is
 * looked for by itself:
 *
 *   trend += (innovation - trend) Ts / 1.6 ms
 *
 * The ripple of the drive itself has a trend as well, which a light rotor or a slow one shows. The wide bandwidth then
 * only adds noise, of J w0^2 count / 4 to the estimate, and ripple. The load has moved when the range of the estimate
 * since the last movement, after a low-pass of 6 ms, exceeds 1/8 of that noise and 1/64 of the largest torque together.
 * While it has not for 156 ms, longer than the crest of a sine of 1 Hz takes, a longer hold than 25 ms is cut
 * short. A trend after that or soon after a release is ripple, with 2.5 times the threshold until the load moves: what
 * has been learned while it moved is less exact than what will be while it does not. A larger trend is more than
 * ripple, such as that of a misalignment which is still to be learned: then the base threshold and the long holds
 * return for 0.5 s, as often as that happens. More than that factor would let the innovation reach the count at
 * which observer_bandwidth.h takes it for a load step.
 *
 * Rounding to counts has a trend of its own. While the rotor turns by r = p / q + d counts in a period, the errors of q
 * successive samples are spread evenly over a count, and their mean is a sawtooth of +-1 / (2 q) counts that repeats
 * q |d| times in a period. Of n repetitions within the time constant T a low-pass leaves 1 / (8 q n) for large n
 * (integral of half a wave, over T), and 1 / (2 q) for n = 0:
 *
 *   rounding = max over q of 1 / (2 q) / (4 n + 1) counts,   n = |q r - p| T / Ts
 *
 * which is added to a threshold of 1/8 count, below which all q > 4 stay by themselves. A trend withholds the last
 * stages of the bandwidth's decay, so that the observer follows the load. They are released 25 ms after the last such
 * trend, one each 5 ms; when a trend interrupts the release, after twice the time before, up to 0.8 s. The value 1/8 is
 * found by trial: one of 1/11 takes the ripple of an encoder that is 0.05 degrees off for a moving load, one of 1/5
 * makes the speed drop of a load ramp of 200 ms that of the paper's controller twice over.
 *
 * The last stage is that of a beat (observer_bandwidth.h), so narrow that the ripple of wrong tables has a trend: of
 * an error T the angle's is about T / (J w0^2). A trend in it withholds this stage alone; the load moves when there is
 * a trend in the steady stage as well. The wide bandwidth would pass the beat on to the torque. For 5 ms after the
 * bandwidth has widened no trend counts: it may still be that of the narrow one.
 *
 * A load step is no moving load. The observer is wide after its trigger anyway, and the trend that it leaves is none of
 * the load: none counts until the first stage after the trigger has ended, which removes the step, and three time
 * constants more, which remove the trend. What the step withheld before its trigger is released then, once. */
#ifndef CONTROL_MOVING_LOAD_H
#define CONTROL_MOVING_LOAD_H

#include <stdbool.h>
#include <stdint.h>

#include "control/observer_bandwidth.h"

typedef struct {
    int32_t gain_q32;            /* of the low-pass per period, Q0.32 */
    uint32_t time_constant;      /* of the low-pass, periods */
    unsigned encoder_shift;      /* a count is 2^encoder_shift of 2^-32 rev */
    uint32_t threshold_count_q4; /* of the trend, 2^-32 rev, Q28.4, for angles from counts */
    uint32_t hold_ticks_min;     /* 25 ms, periods */
    uint32_t hold_ticks_max;     /* 0.8 s */
    uint32_t release_ticks;      /* 5 ms */
    uint32_t settling_ticks;     /* after a trigger */
    uint32_t still_reviews;      /* 0.5 s */
    int32_t movement_min_q24;    /* range of the load's estimate, N m, Q7.24 */
    uint32_t stages;             /* to withhold; 0: no detection */
} moving_load_parameters_t;

/* Source that a trend is attributed to. */
typedef enum {
    MOVING_LOAD_SOURCE_LOAD,       /* a load that has moved lately: base threshold */
    MOVING_LOAD_SOURCE_RIPPLE,     /* ripple of the drive: 2.5 times the base threshold */
    MOVING_LOAD_SOURCE_UNMODELLED, /* larger than ripple, of a load that does not move: base threshold */
} moving_load_source_t;

/* All zero at the start. */
typedef struct {
    int64_t trend_q36;   /* low-pass of the innovation, 2^-32 rev, Q27.36 */
    uint32_t hold_ticks; /* next hold, periods; 0: the shortest */
    uint32_t ticks;      /* until the next release */
    uint32_t settling;   /* periods in which the trend may be that of a narrower bandwidth */
    uint32_t withheld;   /* stages */
    bool first;          /* none had been withheld lately, and nothing has triggered since */
    moving_load_source_t source;
    uint32_t still;   /* reviews since the last movement, or since it is more than ripple, up to still_reviews */
    int32_t load_q24; /* low-pass of the estimate, N m, Q7.24 */
    int32_t load_min_q24, load_max_q24; /* its range since the last movement */
} moving_load_t;

/* All zero at the start. */
typedef struct {
    uint32_t q;           /* of the last sample, 0 after the last one */
    uint32_t least;       /* of q (4 n + 1) so far */
    uint32_t rounding_q4; /* of the last q, 2^-32 rev, Q28.4 */
} moving_load_rounding_t;

typedef struct {
    unsigned encoder_bits; /* 8..32 */
    uint32_t control_rate_hz;
    uint32_t periods_per_review;
    uint32_t stages;          /* to withhold */
    uint32_t bandwidth_rad_s; /* of the observer then, from 100 */
    uint32_t trigger_ticks;   /* end of the first stage after a trigger, periods */
    int32_t inertia_q30;      /* kg m^2, Q1.30 */
    int32_t torque_max_q24;   /* of the drive, N m, Q7.24 */
} moving_load_settings_t;

moving_load_parameters_t moving_load_configure(const moving_load_settings_t *settings);

/* One sample: largest trend that rounding to counts causes, 2^-32 rev, Q28.4, at a rotation per period (angle_step,
 * magnitude, 2^-32 rev), by the formula above; |q r - p| is rounded down to 2^-15 count, n to quarters, the result to 1
 * LSB. One of q = 1..6 a sample, so the result is that of up to 11 samples ago. A 32-bit division in every sixth. */
uint32_t moving_load_rounding_q4(const moving_load_parameters_t *parameters, moving_load_rounding_t *rounding,
                                 uint32_t angle_step);

/* One sample: returns the number of stages to withhold. rounding_q4: of moving_load_rounding_q4, up to half a count;
 * hold: what is withheld stays withheld. 64-bit product, rounded down. */
uint32_t moving_load_step(const moving_load_parameters_t *parameters, moving_load_t *moving,
                          const observer_bandwidth_sample_t *sample, uint32_t rounding_q4, bool hold);

/* Each periods_per_review: whether the load still moves, from the estimate of the observer in N m, Q7.24; hold: what is
 * withheld stays withheld. */
void moving_load_review(const moving_load_parameters_t *parameters, moving_load_t *moving, int32_t load_torque_q24,
                        bool hold);

#endif
