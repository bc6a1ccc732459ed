/* Moving load: a load that changes all the time, as a piston compressor's does, detected by the trend of the
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
 * A trend above its threshold withholds the last stages of the bandwidth's decay: four more than the present one, at
 * 2.3 times its bandwidth, and again each time constant until the trend is gone. So the bandwidth is as wide as the
 * load needs, whose rate may grow by (16/13)^12 = 12 times with each of these steps, and no wider: the ripple of the
 * drive itself has a trend as well, of an error T of the torque about T / (J w0^2), and the widest bandwidth would turn
 * it into noise of J w0^2 count of the torque. Steps of one or two stages follow a load ramp too late, steps of more
 * than five answer ripple with four times the noise (compare ramps, ripple).
 *
 * Rounding to counts has a trend of its own. While the rotor turns by r = p / q + d counts in a period, the errors of q
 * successive samples are spread evenly over a count, and their mean is a sawtooth of +-1 / (2 q) counts that repeats
 * q |d| times in a period. Of n repetitions within the time constant T a low-pass leaves 1 / (8 q n) for large n
 * (integral of half a wave, over T), and 1 / (2 q) for n = 0:
 *
 *   rounding = max over q of 1 / (2 q) / (4 n + 1) counts,   n = |q r - p| T / Ts
 *
 * which is added to a threshold of 1/8 count, below which all q > 4 stay by themselves. The stages are released 25 ms
 * after the last such trend, one each 5 ms; when a trend interrupts the release, after twice the time before, up to
 * 0.8 s. The value 1/8 is found by trial: one of 1/11 takes the ripple of an encoder that is 0.05 degrees off for a
 * moving load, with one of 3/16 tables that are 5 % wrong make finite_element swing.
 *
 * The last stage is the beat's (observer_bandwidth.h), so narrow that the ripple of wrong tables has a trend. A
 * trend in it withholds this stage alone; the load moves when there is a trend in the steady stage as well.
 *
 * A load step is no moving load. The observer is wide after its trigger anyway, and the trend that it leaves is not one
 * of the load: none counts until the first stage after the trigger has ended, which removes the step, and three time
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
    uint32_t stages;             /* to withhold, at most; 0: no detection */
} moving_load_parameters_t;

/* All zero at the start. */
typedef struct {
    int64_t trend_q36;   /* low-pass of the innovation, 2^-32 rev, Q27.36 */
    uint32_t hold_ticks; /* next hold, periods; 0: the shortest */
    uint32_t ticks;      /* until the next release */
    uint32_t settling;   /* periods in which the trend may come from a narrower bandwidth */
    uint32_t withheld;   /* stages */
    bool releasing;      /* no trend since a stage was released */
    bool first;          /* none had been withheld lately, and nothing has triggered since */
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
    uint32_t stages;        /* to withhold, at most */
    uint32_t trigger_ticks; /* end of the first stage after a trigger, periods */
} moving_load_settings_t;

moving_load_parameters_t moving_load_configure(const moving_load_settings_t *settings);

/* One sample: largest trend that rounding to counts causes, 2^-32 rev, Q28.4, at a rotation per period (angle_step,
 * magnitude, 2^-32 rev), by the formula above; |q r - p| is rounded down to 2^-15 count, n to quarters, the result to 1
 * LSB. One of q = 1..6 a sample, so the result is up to 11 samples old. A 32-bit division in every sixth. */
uint32_t moving_load_rounding_q4(const moving_load_parameters_t *parameters, moving_load_rounding_t *rounding,
                                 uint32_t angle_step);

/* One sample: returns the number of stages to withhold. rounding_q4: of moving_load_rounding_q4, up to half a count;
 * hold: what is withheld stays withheld. 64-bit product, rounded down. */
uint32_t moving_load_step(const moving_load_parameters_t *parameters, moving_load_t *moving,
                          const observer_bandwidth_sample_t *sample, uint32_t rounding_q4, bool hold);

#endif
