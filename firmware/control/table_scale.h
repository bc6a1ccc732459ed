/* Scale of the machine's tables: the factor by which the torque of the machine differs from its tables', learned
 * from the energy of each conduction interval of a phase, whatever the tables err by.
 *
 * Between two zeros of its current a phase converts
 *
 *   W = integral of i dpsi,   dpsi = (v - R i) dt                  into work, less the core's loss
 *
 * and the tables say W_t, the same integral with psi(angle, i). Both are sums over the same samples, so that what the
 * sampling cuts off cancels in their ratio. v is known from duty and DC-link voltage, less the drops of the devices; R
 * is not, because the winding's temperature changes it. But the flux linkage ends where it has begun, at none, and its
 * integral shows the error of R at the end of each interval:
 *
 *   integral of (v - R0 i) dt = s psi_t + (R - R0) integral of i dt                                           (1)
 *   integral of i (v - R0 i) dt = s W_t + (R - R0) integral of i^2 dt                                         (2)
 *
 * s and R - R0 follow from sums over the last sixteen intervals of all phases: (1) weighted by the charge, over the
 * samples at the end of the interval, the smaller their flux linkage the more; (2) by the sign of W_t. Errors of the
 * voltage that a current has, as drops which the machine file does not state, count as resistance. Derived here; the
 * energy balance is from J. M. Stephenson, J. Corda, "Computation of torque and current in doubly salient reluctance
 * motors from nonlinear magnetization data", Proc. IEE 126(5), 1979.
 *
 * s is exact for tables that err by a factor; for tables that err in their shape, or at an angle that is wrong, it is
 * the factor of the mean torque. What a sensor reads without a current is taken for its offset. Not observable: errors
 * of the current's gain g, because i dpsi is larger by it, and of the DC-link voltage's gain, likewise: the torque then
 * errs by that gain.
 */
#ifndef CONTROL_TABLE_SCALE_H
#define CONTROL_TABLE_SCALE_H

#include <stdbool.h>
#include <stdint.h>

#include "control/flux_observer.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"
#include "hal.h"

#define TABLE_SCALE_ONE_Q30 (1 << 30)
#define TABLE_SCALE_MIN_Q30 751619277  /* 0.7 */
#define TABLE_SCALE_MAX_Q30 1503238554 /* 1.4 */

/* State of a phase; all zero at the start. */
typedef struct {
    bool ended;       /* the current has fallen so far that the integral of the voltage is limited to 0 */
    bool whole;       /* sampled since its current was zero */
    int32_t rest_q17; /* what the sensor reads without a current, A, Q7.17 */
    int64_t tail, tail_table, tail_charge; /* sums of (1), as of table_scale_t */
    int32_t corrections_q29;               /* of the integral of the voltage, Wb, Q2.29 */
    int32_t drops_q29;                     /* integral of the devices' drops, Wb, Q2.29 */
    int32_t current_q9;                    /* at the last sample, A, Q7.9 */
    int32_t flux_q29, table_q29;           /* at the last sample, Wb, Q2.29 */
    int32_t most_q9, most_q29;             /* largest current, and flux linkage by the tables */
    int64_t applied_q39, table_q39;        /* integrals of i dpsi by voltage and tables, J */
    int64_t charge_q10;                    /* of i, A periods */
    int64_t square_q18;                    /* of i^2, A^2 periods */
} table_scale_phase_t;

/* All zero but for `scale_q30` and `smooth_q30`, 1, and its complement at the start. */
typedef struct {
    table_scale_phase_t phase[HAL_PHASES_MAX];
    int64_t applied_q30, table_q30, square_q10; /* sums of (2) */
    int64_t end, end_table, charge;             /* sums of (1), weighted: Wb A periods, Q21 Q1; A^2 periods^2, Q1 Q1 */
    bool differs;                               /* s is another one than 1: from 1/40 on, until it is within 1/80 */
    uint32_t intervals;                         /* since the start, at most TABLE_SCALE_INTERVALS_MIN */
    int32_t scale_q30;                          /* s of the sums, Q1.30 */
    int32_t smooth_q30;                         /* that follows it, Q1.30 */
    int32_t smooth_complement;                  /* of its bits: a scale that has changed in memory begins anew at 1 */
    int32_t resistance_q40;                     /* (R - R0) Ts of the sums, ohm s, Q-9.40 */
    int32_t smooth_resistance_q40;              /* that follows it */
} table_scale_t;

/* Intervals from which on a scale is used: the first ones of a start are at few angles, at which an error of the
 * encoder is one of the torque. */
#define TABLE_SCALE_INTERVALS_MIN 12u

typedef struct {
    int32_t current_q9;     /* A, Q7.9 */
    int32_t flux_q29;       /* by the voltage since the phase was without current, with all corrections, Wb, Q2.29 */
    int32_t correction_q29; /* that is added to it after this sample, Wb, Q2.29 */
    int32_t table_q29;      /* by the tables, Wb, Q2.29 */
    uint32_t periods;       /* control periods since the last sample */
    int32_t drop_q29;       /* drops of the devices times that time, Wb, Q2.29 */
    bool zero;              /* the phase is off and has no current */
    bool none;              /* no current, or so small a one that the integral is limited to 0 (applied_flux.h) */
    bool lost;              /* control periods were lost since the last sample */
} table_scale_sample_t;

/* Factors for the interrupt: with voltages and resistances over s the flux linkages of predictive_torque.h are the
 * tables'. */
typedef struct {
    int32_t excess_q31;              /* s - 1, Q0.31 */
    int32_t inverse_excess_q31;      /* 1 / s - 1, Q0.31 */
    int32_t period_q40;              /* Ts / s, s, Q-9.40 */
    flux_observer_parameters_t flux; /* with R Ts / s */
} table_scale_factors_t;

/* Factors for a scale from TABLE_SCALE_MIN_Q30 to TABLE_SCALE_MAX_Q30: 1 / s is rounded to 2^-30, what is divided by s
 * to nearest after that, so that its error is 1/2 LSB and 2^-31 of the dividend. [background] */
table_scale_factors_t table_scale_factors(int32_t scale_q30, int32_t period_q40,
                                          const flux_observer_parameters_t *flux);

/* Torque times a factor, of which excess_q31 is what it exceeds 1 by, Q0.31: rounded to 2 LSB, saturated; exact for a
 * factor of 1. Two instructions. */
ALWAYS_INLINE int32_t table_scale_multiply(int32_t torque_q24, int32_t excess_q31) {
    return fixed_add_twice(torque_q24, fixed_multiply_high(torque_q24, excess_q31));
}

/* No interval, scale 1. */
void table_scale_reset(table_scale_t *scale);

/* One sample of the phase with an index; least_q9: current that an interval has to exceed to count, A, Q7.9.
 * [background] */
void table_scale_add(table_scale_t *scale, unsigned index, const table_scale_sample_t *sample, int32_t least_q9);

/* Part by which smooth_q30 follows in a control period, for a time constant of 0.2 s: Q0.31. */
static inline int32_t table_scale_part_q31(uint32_t control_rate_hz) {
    return (int32_t)((UINT32_C(1) << 31) / (control_rate_hz / 5u));
}

/* Moves smooth_q30 towards scale_q30 times a factor, Q1.30, by a part of the difference, Q0.31, and the resistance by a
 * quarter of the part. While the scale does not differ and the factor is 1, towards 1: tables that are right stay as
 * they are, and nothing moves with the errors of the scale. [background] */
void table_scale_follow(table_scale_t *scale, int32_t factor_q30, int32_t part_q31);

#endif
