/* PWM-DITC: direct instantaneous torque control with the output of the BP-PID as duty, the paper's controller at a
 * realistic sampling rate.
 *
 * One phase is regulated: duty = BP-PID(reference - total torque), from -1 (both switches off) over 0 (freewheeling) to
 * +1 (both on). During commutation the BP-PID keeps regulating the outgoing phase, which has most of the torque, while
 * the incoming phase is driven to the current that will carry the reference at the crossover angle:
 *
 *   duty(incoming) = incoming_gain (current setpoint(reference (1 + overshoot margin)) - current)
 *
 * The torque that the incoming phase builds up meanwhile, the BP-PID removes from the outgoing phase. When the outgoing
 * phase is depleted or no longer available, the BP-PID switches to the incoming phase, starting from its duty. Torque
 * missing beyond the outer band of DITC drives the incoming phase to the current limit.
 *
 * Source: the paper, with the modulation by duty instead of the switch states of DITC (ditc_hysteresis.h). Derived here
 * are margin and depletion. Overshoot margin: proportional control of the incoming current leaves an offset; without a
 * margin the outgoing phase would never be depleted. The margin needed decreases with the sampling rate.
 *
 * Depletion: below `depleted_torque` the BP-PID leaves the outgoing phase, because the current, proportional to the
 * square root of the torque, falls slower than that of the incoming phase rises. The torque that the BP-PID can take
 * over increases with the sampling rate: with the 40 kHz values, the torque of a machine with steep corners steps by a
 * ninth at 1 MHz. The threshold is at most an eighth of the reference, otherwise a drive without load would release a
 * phase that a load step needs, and at least 1/16 N m.
 *
 * The duty of a regulated phase acts from one to two periods after the sample. Below the current limit it is at most
 *
 *   ceiling_gain (ceiling - current) - duty that acts until then
 *
 * which at a low control rate leaves it below the trip (configure.c) and at a high one is above 1; above the limit 0.
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
    int32_t incoming_gain_q24;    /* duty per A of current error, Q7.24 */
    int32_t overshoot_margin_q32; /* share of the reference, Q0.32, 0..1/2 - 2^-32 */
    int32_t depleted_torque_q24;  /* upper limit of the depletion threshold, N m, Q7.24, >= 0 */
    int32_t band_outer_q24;       /* N m, Q7.24 */
    int32_t current_limit_q9;     /* A, Q7.9 */
    int32_t current_ceiling_q9;   /* of the regulated phase, >= limit, A, Q7.9 */
    int32_t ceiling_gain_q24;     /* inverse of a period's rise at full voltage below it, duty per A, Q7.24 */
    uint8_t torque_shift;         /* unit of the tables, 2^torque_shift of Q7.24 */
} pwm_ditc_parameters_t;

typedef struct {
    bp_pid_t pid;
    unsigned regulated; /* phase of the BP-PID; COMMUTATION_NONE before the first */
} pwm_ditc_t;

typedef struct {
    const int32_t *current_q9; /* A, Q7.9, by phase */
    const int32_t *torque;     /* by phase, unit of the tables */
    int32_t reference_q24;     /* N m, Q7.24, >= 0 */
    int32_t error_q24;         /* reference - total torque, N m, Q7.24 */
} pwm_ditc_sample_t;

/* Current setpoints of a machine for a crossover angle of 2^31..2^32 - 1, 2^-32 electrical rev. */
pwm_ditc_setpoints_t pwm_ditc_setpoints(const machine_tables_t *tables, uint32_t crossover_angle);

/* Current setpoint in A, Q7.9, for a torque in N m, Q7.24; interpolated linearly, rounded down. A negative torque, as
 * only a constant in a faulty memory makes it, is 0. */
int32_t pwm_ditc_setpoint_q9(const pwm_ditc_setpoints_t *setpoints, int32_t torque_q24);

/* Initial weights; no phase regulated. */
void pwm_ditc_reset(const pwm_ditc_parameters_t *parameters, pwm_ditc_t *ditc);

/* One sample: duty of each phase, Q1.15, -32768..32768, from its last ones. Torque sums saturate; the duty of the
 * incoming phase is clamped, its 32-bit product rounded to nearest. */
void pwm_ditc_step(const pwm_ditc_parameters_t *parameters, pwm_ditc_t *ditc, const commutation_t *commutation,
                   const pwm_ditc_sample_t *sample, int32_t duty_q15[HAL_PHASES_MAX]);

#endif
