/* Misalignment: angle by which the torque of each phase is displaced from the tables, learned while the drive runs.
 *
 * An encoder or a pole displaced by 0.2 degrees causes a ripple of two percent: the torque estimate is taken at a wrong
 * angle, and the load observer sees the difference from the true torque as a load that alternates with the strokes. To
 * first order that difference is
 *
 *   y = sum over phases of delta_j s_j,   s_j = dT_j / dtheta at the present current,
 *
 * where s_j is known from the tables. Each delta_j follows the correlation of the alternating parts of y and s_j by
 * normalised least mean squares (LMS: B. Widrow, M. E. Hoff, "Adaptive switching circuits", IRE WESCON Convention
 * Record, 1960):
 *
 *   d delta_j / dt = rate y s_j / (mean of sum s_j^2 + 0.05 T^2 / rad^2)
 *
 * A misaligned encoder displaces all phases by the same angle, and its y is delta sum s_j, which is small because the
 * slopes of two overlapping phases nearly cancel, and at high speeds much smaller after the observer than the y of the
 * phases, which alternate more slowly. So the same law learns that angle once more, normalised by itself:
 *
 *   d delta / dt = rate / 2 y S / (mean of S^2 + 0.00007 T^2 / rad^2 + N),   S = sum s_j
 *
 * N is for the rounding to counts of q rad. Far above its bandwidth w0 the observer makes a y of 3 J w0^2 of the error
 * of an angle, a rounding of the density q^2 / 6 Ts therefore a y of (3 J w0^2 q)^2 / 6 Ts. Of a white y of the density
 * D the law makes a delta of the variance rate / 2 D / 4 / (S^2 + N) S^2 / (S^2 + N), which is at most s^2 with
 *
 *   N = rate / 8 D / s^2 = rate Ts (3 J w0^2 q)^2 / (48 s^2),   s = 0.00025 rad
 *
 * (derived here). A beat of the counts is not white: while there is one, nothing is learned from y
 * (interrupts/deferred.c).
 *
 * Both alternate with the strokes, so y and S pass through the same band-pass around their frequency: the slopes jump
 * where phases are turned on and off, and sampling them folds the harmonics of these jumps to frequencies far below,
 * where the observer's lag does not suppress them; the quantisation of the encoder likewise, to far above.
 *
 * y is the load estimate plus the torque that the speed correction stands for, -(J / Ts) l2 e, which responds within
 * 1 / w0; s_j passes through two first-order filters of 1 / (1.6 w0), about the same delay. A correction indexed by the
 * rotor angle in bins could cancel any error, not only a misalignment, but would have dozens of values to learn from
 * the same signal instead of one per phase.
 *
 * A load that moves hides that ripple. While it does, each phase follows the angle that its flux linkage shows
 * (flux_angle.h), at half of the rate. That angle knows nothing of the load, but errs with the shape of the tables, so
 * that under a constant load the ripple has the last word, within 0.29 degrees. What it teaches beyond that is a load
 * that seems constant: then the flux linkage takes over until the state has been steady for 1.2 s.
 *
 * A load that changes within a stroke teaches until the end of that stroke shows it (stroke_mean.h). What was learned
 * from the ripple in that stroke and the one before it is then forgotten if the load's amplitude within the stroke has
 * grown, because learning reduces that, and itself changes the mean.
 *
 * s_j is filtered by the observer's present bandwidth. Learning of the phases is suspended unless speed and load are
 * steady, the torque is above 1 N m and the voltage is not limited; a large misalignment itself disturbs every stroke,
 * and is learned between these disturbances.
 */
#ifndef CONTROL_MISALIGNMENT_H
#define CONTROL_MISALIGNMENT_H

#include <stdbool.h>
#include <stdint.h>

#include "control/machine_tables.h"
#include "hal.h"

#define MISALIGNMENT_PROBE_ANGLE 6835653 /* 0.01 rad, 2^-32 rev */
/* Error of the angle by flux linkage that tables of another shape than the machine's make: 0.29 degrees, 2^-32 rev. */
#define MISALIGNMENT_SHAPE_ANGLE (MISALIGNMENT_PROBE_ANGLE / 2)

typedef struct {
    uint32_t probe_angle;    /* 0.01 rad mechanical, 2^-32 electrical rev; s_j is the torque change over twice that */
    int32_t rate_q30;        /* rate times the update interval of a phase, Q1.30; 0: no learning */
    int32_t common_rate_q30; /* the same for the common angle, half of that rate, Q1.30 */
    int32_t flux_rate_q8;    /* half of that rate, 2^-40 of 0.02 rad per 2^-32 electrical rev, Q23.8 */
    int32_t filter_q32;      /* 1.6 times the update interval, s, Q0.32 */
    int32_t mean_q16;        /* 10 / s times the update interval, Q0.16 */
    int32_t noise_q22;       /* of the common angle, N / 16, (N m per 0.02 rad)^2, Q9.22 */
    int32_t inertia_rate_q8; /* J / Ts: N m per rad/s, Q23.8 */
    uint32_t settle_updates; /* steady updates before learning */
} misalignment_parameters_t;

typedef struct {
    int32_t slope_q24; /* s_j at the last update: N m per 0.02 rad, Q7.24 */
    int32_t slope_lag1_q24, slope_lag2_q24,
        slope_mean_q24;                  /* s_j after one filter, two, and mean: N m per 0.02 rad, Q7.24 */
    int64_t last_sum_q24;                /* disturbance_sum_q24 at the last update of the phase */
    int64_t offset_q40;                  /* delta_j in 0.02 rad, within +-3.5 (4 degrees) */
    int64_t common_sum_q40;              /* of misalignment_t, at the last update of the phase */
    int64_t before_last_q40, before_q40; /* delta_j at the start of the last stroke, and of this one */
    int32_t offset;                      /* delta_j, 2^-32 electrical rev, to subtract from the phase's angle */
} misalignment_phase_t;

/* Band-pass around the frequency of the strokes, N m, Q7.24. */
typedef struct {
    int32_t mean_q24, value_q24; /* low-pass of its input; and of the rest */
} misalignment_band_t;

typedef struct {
    misalignment_phase_t phase[HAL_PHASES_MAX];
    int64_t disturbance_sum_q24;  /* sum of y over all updates, N m, Q24; 2^37 updates fit */
    int64_t last_common_sum_q24;  /* at the last update of the common angle */
    int32_t disturbance_mean_q24; /* mean of y, N m, Q7.24 */
    int32_t power_q24;            /* mean of sum s_j^2, Q7.24 */
    uint32_t steady_updates;
    int64_t common_power_q40; /* mean of the band's (sum s_j / 4)^2, (N m per 0.02 rad)^2, Q40 */
    int64_t common_sum_q40;   /* of the steps of the common angle, which each phase takes with its next update */
    misalignment_band_t common_slope, common_disturbance; /* of sum s_j / 4, N m per 0.02 rad, and of y */
    bool contradicted;    /* ripple estimate contradicts flux estimate: settling time x 8 */
    bool learning;        /* from the ripple, by the conditions of the last misalignment_step */
    unsigned phase_index; /* phase to update, in turn */
} misalignment_t;

typedef enum {
    MISALIGNMENT_UNSTEADY,    /* learning waits until the state has been steady for 150 ms */
    MISALIGNMENT_INTERRUPTED, /* by the misalignment itself, with every stroke: learning continues afterwards */
    MISALIGNMENT_STEADY,      /* speed and load are steady, the voltage is not limited */
} misalignment_condition_t;

typedef struct {
    int32_t current_q9;       /* of the phase to update, A, Q7.9 */
    uint32_t angle;           /* of that phase, corrected, 2^-32 electrical rev */
    int32_t disturbance_q24;  /* y, N m, Q7.24 */
    int32_t torque_q24;       /* reference, N m, Q7.24 */
    uint32_t bandwidth_rad_s; /* of the load observer */
    misalignment_condition_t condition;
    int32_t flux_misalignment; /* of that phase by flux_angle.h, 2^-32 electrical rev; 0: unknown */
} misalignment_sample_t;

typedef struct {
    int32_t rate_1_s; /* 0..100 */
    uint32_t control_rate_hz;
    unsigned periods_per_update;        /* control periods, misalignment_step */
    unsigned periods_per_common_update; /* misalignment_common_step */
    int32_t inertia_q30;                /* kg m^2, Q1.30 */
    unsigned phases, rotor_poles;
    unsigned encoder_bits;    /* 8..32 */
    uint32_t bandwidth_rad_s; /* of the load observer in steady state, at most 10000 */
    unsigned speed_exponent;  /* of machine_tables_t */
} misalignment_settings_t;

misalignment_parameters_t misalignment_configure(const misalignment_settings_t *settings);

/* The phase of the next step. An index that has changed in memory stays within the array. */
static inline unsigned misalignment_phase_index(const misalignment_t *misalignment) {
    return misalignment->phase_index % HAL_PHASES_MAX;
}

/* y in N m, Q7.24, from J / Ts (misalignment_parameters_t), load torque (N m, Q7.24) and speed correction (rad/s,
 * Q9.22) of the load observer. The product is rounded to nearest and saturates to within 4 N m of the end; the
 * difference saturates. */
int32_t misalignment_disturbance_q24(int32_t inertia_rate_q8, int32_t load_torque_q24, int32_t speed_correction_q22);

/* Instead of misalignment_step(), where the ripple teaches nothing: updates one phase by its flux linkage alone
 * (flux_misalignment: of misalignment_sample_t), and its slope, at its corrected angle (2^-32 electrical rev) and
 * current (A, Q7.9). */
void misalignment_follow_flux(const misalignment_parameters_t *parameters, misalignment_t *misalignment,
                              const machine_tables_t *tables, uint32_t angle, int32_t current_q9,
                              int32_t flux_misalignment);

/* Sum of the phases' slopes at their last updates, N m per 0.02 rad, Q7.24, saturates. */
int32_t misalignment_slope_q24(const misalignment_t *misalignment);

/* One sample, after load_observer_step(); updates one phase. 64-bit products, rounded to nearest, in low-passes
 * to 2 LSB, in misalignment_follow_flux() down; quotients are rounded towards zero, means down; sums saturate,
 * offsets are clamped to +-3.5 of 0.02 rad (4 degrees). */
void misalignment_step(const misalignment_parameters_t *parameters, misalignment_t *misalignment,
                       const machine_tables_t *tables, const misalignment_sample_t *sample);

/* False when the angle of a phase is beyond what is ever learned: it has changed in memory. */
bool misalignment_is_intact(const misalignment_parameters_t *parameters, const misalignment_t *misalignment,
                            uint32_t phases);

/* One sample: updates the offset that the phases have in common, from the slopes of the last misalignment_step of each
 * and the mean of y since the last step, of four of them, while those learn from the ripple; each takes it with its
 * next step. Torque reference in N m, Q7.24; stroke_part_q16: part of a stroke since the last step, from 0; rounding as
 * there. */
void misalignment_common_step(const misalignment_parameters_t *parameters, misalignment_t *misalignment,
                              unsigned phases, int32_t torque_q24, int32_t stroke_part_q16);

/* At the end of a stroke: forgets what was learned in it and in the one before, if it was of a load that has changed.
 * changed, grown: of stroke_mean_t. */
void misalignment_end_stroke(misalignment_t *misalignment, bool changed, bool grown);

/* At the end of a run: what has been learned is not forgotten. */
void misalignment_keep(misalignment_t *misalignment);

#endif
