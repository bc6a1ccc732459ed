/* Misalignment of each phase: how far its torque is from where the tables say, learned while the drive runs.
 *
 * An encoder that is mounted 0.2 degrees off, or a pole that is, makes a ripple of two percent: the tables are asked at
 * a wrong angle, the torque they promise is not the torque that acts, and the load observer sees the difference as a
 * load that goes up and down with the stroke. To first order that difference is
 *
 *   y = sum over phases of delta_j s_j,   s_j = dT_j / dtheta at the present current,
 *
 * and s_j is in the tables. So each delta_j follows the correlation of the alternating parts of y and s_j (normalised
 * least mean squares, B. Widrow, M. E. Hoff, "Adaptive switching circuits", WESCON 1960):
 *
 *   d delta_j / dt = rate y s_j / (mean of sum s_j^2 + 0.05 T^2 / rad^2)
 *
 * y is the load estimate with the part that the speed's correction adds, which answers within 1 / w0; s_j is sent
 * through two first-order filters of 1 / (1.6 w0) with about the same delay. A correction indexed by the rotor angle in
 * bins could mend any error, not only a misalignment, but would have dozens of numbers to learn from the same signal;
 * here it is one a phase.
 *
 * Learning pauses unless speed and load are steady, the torque is above 1 N m and voltage suffices.
 */
#ifndef CONTROL_MISALIGNMENT_H
#define CONTROL_MISALIGNMENT_H

#include <stdbool.h>
#include <stdint.h>

#include "control/load_observer.h"
#include "control/machine_tables.h"
#include "hal.h"

typedef struct {
    uint32_t probe;          /* 0.01 rad mechanical in 2^-32 pitch: s_j is what the torque rises over twice that */
    int32_t rate_q30;        /* rate times the time between two turns of a phase, Q1.30; 0 learns nothing */
    int32_t filter_q16;      /* 1.6 w0 times that time, Q1.16, below one */
    int32_t mean_q16;        /* 10 / s times that time, Q1.16 */
    int32_t inertia_rate_q8; /* J / Ts: N m per rad/s, Q23.8 */
    uint32_t settle_ticks;   /* steady periods before learning */
} misalignment_parameters_t;

typedef struct {
    int32_t first_q24, second_q24, mean_q24; /* s_j filtered once, twice, and its mean: N m over 0.02 rad, Q7.24 */
    int64_t sum_q24;                         /* of y, at the phase's last turn */
    int64_t offset_q40;                      /* delta_j in 0.02 rad, within +-0.875 (1 degree) */
    int32_t offset;                          /* the same in 2^-32 pitch, to be taken off the phase's angle */
} misalignment_phase_t;

typedef struct {
    misalignment_phase_t phase[HAL_PHASES_MAX];
    int64_t sum_q24;              /* of y over all periods: 2^37 of them */
    int32_t disturbance_mean_q24; /* of y, N m */
    int32_t power_q24;            /* mean of the sum of s_j^2 */
    uint32_t steady_ticks;
    unsigned turn; /* phase to learn from: one a period */
} misalignment_t;

typedef struct {
    const int32_t *current_q9; /* A, Q7.9, by phase */
    const uint32_t *angle;     /* 2^-32 pitch, by phase, as corrected */
    int32_t torque_q24;        /* reference, N m, Q7.24 */
    bool steady;               /* speed, load and voltage */
} misalignment_sample_t;

/* Rate in 1/s (0..100), the load observer's steady bandwidth in rad/s. */
misalignment_parameters_t misalignment_configure(int32_t rate_1_s, uint32_t bandwidth_rad_s, uint32_t control_rate_hz,
                                                 int32_t inertia_q30, unsigned phases, unsigned rotor_poles);

/* All aligned. */
void misalignment_reset(misalignment_t *misalignment);

/* One sample, behind the load observer's. */
void misalignment_step(const misalignment_parameters_t *parameters, misalignment_t *misalignment,
                       const machine_tables_t *tables, const load_observer_t *observer,
                       const misalignment_sample_t *sample);

#endif
