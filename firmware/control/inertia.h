/* Inertia: power of two by which the machine's inertia differs from the parameter, identified from transients.
 *
 * With load TL the speed follows J dw/dt = T - TL. The second difference of the rotor angle over two windows is their
 * acceleration in a triangular mean; times the inertia J0 of the parameters it is a torque A, and T the machine torque
 * in the same mean. The regression of A on T, both less their means,
 *
 *   cov(T, A) / var(T) = J0 / J,
 *
 * is free of a load that stays the same, whatever it is. It counts when T varies enough and A follows it, cov(T, A)^2 >
 * 7/8 var(T) var(A), while the speed approaches a changed reference and T is at its limit or has been within the last 8
 * windows: in a start, a braking or a reversal, and above all at their ends. A torque that follows a load is not in
 * proportion to A, but at the limit, in the few milliseconds of a steep ramp, it may seem so.
 *
 * Means are exponential, over 4 windows. A window is at least 0.8 ms, so that they last longer than the torque needs to
 * fall from its limit, and as long as the encoder needs: an error of one count in the angle is 1/24 of the largest
 * torque.
 *
 * At the start of a run T and A begin at 0. A load that begins with it, as friction, looks like a larger inertia then:
 * for the first 4 windows only smaller ones are identified, after them the regression begins anew.
 *
 * The result is the shift k of J0 / J = 2^k, within -2..2: J = J0 / 5 and J = 5 J0 then differ from 2^-k J0 by a
 * quarter. It changes by one at a time, when the regression is off by more than 1.75 or 1 / 1.6. A machine as its
 * parameters state stays at k = 0, where the laws are the parameters'.
 *
 * A position is followed by a feed-forward in proportion to the inertia, for which a power of two is not enough. There
 * the rest g = J0 / (J 2^k), within 1/2..2, follows the regression where it is straight, cov(T, A)^2 > 31/32 var(T)
 * var(A), in each window by half or more of what is missing; by an eighth or more when that is less than a quarter, for
 * the counts of a heavy shaft are noise. A quarter of the variance is enough. For the first rest of a run a 64th is,
 * with which a move of some counts is over, where the encoder's counts are at most a 16th of var(A): their second
 * difference has half the square of one. A rest beyond 5/8..7/4 changes k. The reciprocal comes by Newton's method.
 * Each run begins with a rest of 1; with coarse encoders it stays.
 */
#ifndef CONTROL_INERTIA_H
#define CONTROL_INERTIA_H

#include <stdbool.h>
#include <stdint.h>

#include "control/load_observer.h"

/* Parts of the control laws in proportion to the inertia or its reciprocal. */
typedef struct {
    load_observer_inertia_t observer;
    int32_t reaching_gain_q24; /* J k of speed_smc.h, N m s/rad, Q7.24 */
    int32_t rate_q8;           /* J / Ts of misalignment.h */
} inertia_laws_t;

typedef struct {
    int32_t gain_q8;            /* J0 / window^2: N m, Q8.23, per 2^-32 electrical rev, in Q8 */
    int32_t variance_min_q14;   /* of the torque, (N m)^2, Q17.14 */
    unsigned window_shift;      /* a window is 2^window_shift updates, from 1 */
    unsigned torque_shift;      /* from N m, Q7.24, to half of T / 4^window_shift, Q8.23 */
    int32_t reaching_gain_q24;  /* of J0 */
    int32_t rate_q8;            /* of J0 */
    int32_t count_variance_q14; /* of A by the counts of the encoder, (N m)^2; 0: windows too long for the rest */
} inertia_parameters_t;

/* Laws of the inertia J0 / g. */
typedef struct {
    load_observer_model_t observer;
    int32_t reaching_gain_q24, rate_q8;
} inertia_base_t;

typedef struct {
    int32_t gain_q8; /* of the parameters with which the shift has been identified */
    int32_t shift;   /* k */
    inertia_base_t base;
    inertia_laws_t laws;
    int32_t rest_q14, inverse_rest_q14;   /* g and 1 / g, 2^13..2^15 */
    int32_t ratio_q14;                    /* J / J0, with which a position is followed */
    int32_t refined_shift;                /* k to which the rest belongs */
    uint32_t refined_windows;             /* of which the rest has been found */
    uint32_t transient_windows;           /* left of the transient */
    uint32_t updates;                     /* since the start of the run */
    uint32_t sum_q23;                     /* of T / 4^window_shift, wraps */
    uint32_t sum_of_sums_q23;             /* of that sum over the window, wraps */
    uint32_t last_sum_of_sums_q23;        /* of the window before */
    uint32_t angle;                       /* at its beginning, 2^-32 electrical rev */
    uint32_t rotation;                    /* in the window before */
    int32_t torque_q23, acceleration_q23; /* T and A of the last two windows */
    int32_t torque_mean_q23, acceleration_mean_q23;
    int32_t torque_variance_q14, acceleration_variance_q14, covariance_q14; /* (N m)^2 */
} inertia_t;

typedef struct {
    uint32_t control_rate_hz;
    unsigned periods_per_update;
    unsigned encoder_bits, rotor_poles;
    int32_t inertia_q30;    /* J0, kg m^2, Q1.30 */
    int32_t torque_max_q24; /* of the drive, N m, Q7.24 */
    int32_t reaching_gain_q24, rate_q8;
} inertia_settings_t;

inertia_parameters_t inertia_configure(const inertia_settings_t *settings);

/* Outside a run, with the rotor angle in 2^-32 electrical rev. Parameters of another inertia reset the shift. */
void inertia_restart(const inertia_parameters_t *parameters, const load_observer_model_t *model, inertia_t *inertia,
                     uint32_t angle);

/* The laws of changed parameters, which do not mean another inertia, in two parts: by the parameters, then by the
 * identified inertia. An update between the two does no harm. */
void inertia_tune(const inertia_parameters_t *parameters, const load_observer_model_t *model, inertia_t *inertia);
void inertia_tune_laws(inertia_t *inertia);

/* One update of a run: rotor angle in 2^-32 electrical rev, machine torque in N m, Q7.24, in the mean since the last
 * one: a torque that swings within it would not show in a sample. limited: its reference is at
 * a limit. approaching: the speed approaches a changed reference. */
void inertia_step(const inertia_parameters_t *parameters, inertia_t *inertia, uint32_t angle, int32_t torque_q24,
                  bool limited, bool approaching);

/* While a position is followed, in each period: the rest, and laws with it, once in a window. */
void inertia_refine(const inertia_parameters_t *parameters, const load_observer_model_t *model, inertia_t *inertia);

#endif
