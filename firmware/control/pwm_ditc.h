/* PWM-DITC: direct instantaneous torque control with the output of the BP-PID as duty, the paper's controller at a
 * realistic sampling rate.
 *
 * One phase is regulated: duty = BP-PID(reference - total torque), from -1 (both switches off) over 0 (freewheeling) to
 * +1 (both on). During commutation the BP-PID first keeps regulating the outgoing phase, which has most of the torque,
 * while the incoming phase is driven to the current that will carry the reference at the crossover angle:
 *
 *   duty(incoming) = incoming_gain (current setpoint(reference) - current) - duty that acts until then / 2
 *
 * half of a deadbeat law: without overshoot at the unaligned inductance, and well damped at any larger one. As soon as
 * the incoming phase has the larger torque, the BP-PID regulates it, starting from its duty, and the outgoing phase
 * keeps the mean duty that it had, by which its torque falls as before: the sum goes on without a step. Beyond
 * the outer band the rule of DITC holds for the phase that is not regulated: torque missing switches it on, up to
 * the current limit, torque in excess switches an outgoing phase off.
 *
 * Source: the paper, with the modulation by duty instead of the switch states of DITC (ditc_hysteresis.h). Derived
 * here, with psi the flux linkage of the regulated phase, Vdc Ts what a period can add to it, and S = Vdc Ts dT/dpsi:
 *
 *   gain of the loop    S differs between phases, angles and currents by a factor of up to ten. The gains of the
 *                       BP-PID are those at a reference point, half of the current limit in the middle of the window,
 *                       times S(reference point) / S, 1/32 to 4 (pwm_ditc_plan)
 *   feed-forward        what the incoming phase gains in a period, the outgoing phase is to lose: - dT(incoming) / S
 *   lead                the duty acts one to two periods after the sample, and the current takes a time to rise: the
 *                       phases change roles where the rotor will be when half of it has risen (pwm_ditc_plan), so that
 *                       the incoming torque is about 0 meanwhile. Turn-on angles for the unaligned position only
 *
 * The duty of a regulated phase acts from one to two periods after the sample. Below the current limit it is at most
 *
 *   ceiling_gain (ceiling - current) - duty that acts until then
 *
 * which at a low control rate leaves it below the trip (configure_torque.c) and at a high one is above 1; above the
 * limit 0.
 */
#ifndef CONTROL_PWM_DITC_H
#define CONTROL_PWM_DITC_H

#include <stdbool.h>
#include <stdint.h>

#include "control/bp_pid.h"
#include "control/commutation.h"
#include "control/machine_tables.h"

/* Current that makes a torque at the crossover angle, A, Q7.9: entry 4 m + n for (2^m (1 + n / 4) - 1) / 16 N m, from 0
 * in the first to the maximum of Q7.24 in the last. */
#define PWM_DITC_SETPOINTS 46
typedef struct {
    uint16_t current_q9[PWM_DITC_SETPOINTS];
} pwm_ditc_setpoints_t;

typedef struct {
    bp_pid_parameters_t pid;
    pwm_ditc_setpoints_t current_setpoints;
    int32_t incoming_gain_q24;  /* duty per A of current error, Q7.24 */
    int32_t band_outer_q24;     /* N m, Q7.24 */
    int32_t current_limit_q9;   /* A, Q7.9 */
    int32_t current_ceiling_q9; /* of the regulated phase, >= limit, A, Q7.9 */
    int32_t ceiling_gain_q24;   /* inverse of a period's rise at full voltage below it, duty per A, Q7.24 */
    /* At the reference point: */
    int32_t torque_per_flux_q16; /* dT/dpsi, units of the tables per 2^-29 Wb, Q16 */
    int32_t duty_per_torque_q44; /* 1 / S, duty per unit of the tables, Q44 */
} pwm_ditc_parameters_t;

/* Values that follow from a sample and may act some periods later; all zero: the BP-PID keeps its duty. */
typedef struct {
    int32_t factor_q16;          /* S at the reference point / S of the regulated phase, Q16, 1/32..4 */
    int32_t duty_per_torque_q47; /* 1 / S, duty per unit of the tables, Q47 */
    int32_t setpoint_q9; /* current that carries the reference at the crossover angle, within the limit, A, Q7.9 */
    uint32_t lead;       /* angle by which the phases change roles early, 2^-32 electrical rev */
} pwm_ditc_plan_t;

typedef struct {
    bp_pid_t pid;
    unsigned regulated;      /* phase of the BP-PID; COMMUTATION_NONE before the first */
    int32_t released_q15;    /* mean duty of the regulated phase, held after a change, Q1.15 */
    int32_t error_q24;       /* of the last sample, N m, Q7.24 */
    int32_t incoming_torque; /* of the incoming phase in the last sample, unit of the tables */
} pwm_ditc_t;

typedef struct {
    const int32_t *current_q9; /* A, Q7.9, by phase */
    const int32_t *torque;     /* by phase, unit of the tables */
    int32_t error_q24;         /* reference - total torque, N m, Q7.24 */
    const int32_t *gain_q24;   /* of the BP-PID, bp_pid_step() */
    const pwm_ditc_plan_t *plan;
} pwm_ditc_sample_t;

/* Current setpoints of a machine for a crossover angle of 2^31..2^32 - 1, 2^-32 electrical rev. */
pwm_ditc_setpoints_t pwm_ditc_setpoints(const machine_tables_t *tables, uint32_t crossover_angle);

/* Current setpoint in A, Q7.9, for a torque in N m, Q7.24; interpolated linearly, the place between two entries
 * to 2^-14 and the current to 1 LSB, both rounded down. A negative torque, as only a constant in a faulty memory makes
 * it, is 0. */
int32_t pwm_ditc_setpoint_q9(const pwm_ditc_setpoints_t *setpoints, int32_t torque_q24);

/* Sets the values of the reference point of parameters that are complete otherwise: half of the current limit at an
 * electrical angle with torque, 2^-32 rev. voltage_step_q29: Vdc Ts, Wb, Q2.29, > 0. [background] */
void pwm_ditc_set_reference_point(pwm_ditc_parameters_t *parameters, const machine_tables_t *tables, uint32_t angle,
                                  int32_t voltage_step_q29);

/* Sample for the plan. */
typedef struct {
    uint32_t angle;        /* of the regulated phase, 2^-32 electrical rev */
    int32_t current_q9;    /* its current, A, Q7.9; at least 1/32 of the limit is taken */
    int32_t reference_q24; /* N m, Q7.24 */
    int32_t angle_step;    /* rotation per period, 2^-32 electrical rev, negative backwards */
} pwm_ditc_plan_sample_t;

/* Plan for the coming periods. S from the differences of torque and flux linkage over an eighth of the current; where
 * the torque does not rise with the current, the largest factor. Lead: the rotation in two periods and half of the rise
 * of the current. [deferred interrupt] */
pwm_ditc_plan_t pwm_ditc_plan(const pwm_ditc_parameters_t *parameters, const machine_tables_t *tables,
                              const pwm_ditc_plan_sample_t *sample);

/* No phase regulated. */
void pwm_ditc_reset(pwm_ditc_t *ditc);

/* One sample: duty of each phase, Q1.15, -32768..32768, from its last ones. Duties are clamped, products of 32 bits
 * rounded to nearest. */
void pwm_ditc_step(const pwm_ditc_parameters_t *parameters, pwm_ditc_t *ditc, const commutation_t *commutation,
                   const pwm_ditc_sample_t *sample, int32_t duty_q15[HAL_PHASES_MAX]);

#endif
