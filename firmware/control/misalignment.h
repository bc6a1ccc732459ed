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
 * y is the load estimate plus the torque that the speed correction stands for, -(J / Ts) l2 e, which responds within
 * 1 / w0; s_j passes through two first-order filters of 1 / (1.6 w0), about the same delay. A correction indexed by the
 * rotor angle in bins could cancel any error, not only a misalignment, but would have dozens of values to learn from
 * the same signal instead of one per phase.
 *
 * Learning is suspended unless speed and load are steady, the torque is above 1 N m and the voltage is not limited.
 */
#ifndef CONTROL_MISALIGNMENT_H
#define CONTROL_MISALIGNMENT_H

#include <stdbool.h>
#include <stdint.h>

#include "control/machine_tables.h"
#include "hal.h"

typedef struct {
    uint32_t probe_angle;    /* 0.01 rad mechanical, 2^-32 electrical rev; s_j is the torque change over twice that */
    int32_t rate_q30;        /* rate times the update interval of a phase, Q1.30; 0: no learning */
    int32_t filter_q16;      /* 1.6 w0 times the update interval, Q0.16 */
    int32_t mean_q16;        /* 10 / s times the update interval, Q0.16 */
    int32_t inertia_rate_q8; /* J / Ts: N m per rad/s, Q23.8 */
    uint32_t settle_ticks;   /* steady periods before learning */
} misalignment_parameters_t;

typedef struct {
    int32_t slope_lag1_q24, slope_lag2_q24,
        slope_mean_q24;   /* s_j after one filter, two, and mean: N m per 0.02 rad, Q7.24 */
    int64_t last_sum_q24; /* disturbance_sum_q24 at the last update of the phase */
    int64_t offset_q40;   /* delta_j in 0.02 rad, within +-0.875 (1 degree) */
    int32_t offset;       /* delta_j, 2^-32 electrical rev, to subtract from the phase's angle */
} misalignment_phase_t;

typedef struct {
    misalignment_phase_t phase[HAL_PHASES_MAX];
    int64_t disturbance_sum_q24;  /* sum of y over all periods, N m, Q24; 2^37 periods fit */
    int32_t disturbance_mean_q24; /* mean of y, N m, Q7.24 */
    int32_t power_q24;            /* mean of sum s_j^2, Q7.24 */
    uint32_t steady_ticks;
    unsigned phase_index; /* phase to update: one per period, in turn */
} misalignment_t;

typedef struct {
    int32_t current_q9;           /* of the phase to update, A, Q7.9 */
    uint32_t angle;               /* of that phase, corrected, 2^-32 electrical rev */
    int32_t load_torque_q24;      /* load observer, N m, Q7.24 */
    int32_t speed_correction_q22; /* load observer, rad/s, Q9.22 */
    int32_t torque_q24;           /* reference, N m, Q7.24 */
    bool steady;                  /* speed and load are steady, the voltage is not limited */
} misalignment_sample_t;

/* Learning rate in 1/s (0..100), steady bandwidth of the load observer in rad/s, inertia in kg m^2, Q1.30. */
misalignment_parameters_t misalignment_configure(int32_t rate_1_s, uint32_t bandwidth_rad_s, uint32_t control_rate_hz,
                                                 int32_t inertia_q30, unsigned phases, unsigned rotor_poles);

/* Offsets and filters 0. */
void misalignment_reset(misalignment_t *misalignment);

/* One sample, after load_observer_step(); updates one phase. 64-bit products, rounded to nearest; sums saturate,
 * offsets are clamped to +-0.875 of 0.02 rad (1 degree). */
void misalignment_step(const misalignment_parameters_t *parameters, misalignment_t *misalignment,
                       const machine_tables_t *tables, const misalignment_sample_t *sample);

#endif
