/* Direct instantaneous torque control with the BP-PID's output as duty: the paper's controller at a real sampling rate.
 *
 * One phase is regulated: the PID turns the error of the total torque into its duty, from -1 (both switches off) over 0
 * (freewheeling) to +1 (both on). At turn-on of the next phase the PID stays with the outgoing one, which is large in
 * torque and slow, while the incoming phase, still without torque, is brought to the current that will carry the
 * reference at the hand-over angle; what torque it makes meanwhile, the PID takes off the outgoing phase. When nothing
 * is left to take off, or the outgoing phase must go, the PID moves on to the incoming phase, starting from its duty.
 * DITC's outer band stays in force: torque missing beyond it sends the incoming phase to the current limit.
 *
 * The incoming phase aims at a surplus above the reference, because its proportional control falls short of the aim and
 * the outgoing phase would never be spent. And the PID leaves an outgoing phase that still has some torque, because the
 * last of it goes slower than the incoming phase rises: current goes with the square root of torque. How much surplus
 * is needed falls with the sampling rate, and how much torque the PID can take over rises with it; with those of 40 kHz
 * the torque of a machine of steep corners jumps by a ninth at 1 MHz. Spent is less than `spent_torque`, but at most an
 * eighth of the reference, or a drive without load would let go a phase that a load step needs; and 1/16 N m always.
 */
#ifndef CONTROL_DITC_DUTY_H
#define CONTROL_DITC_DUTY_H

#include <stdbool.h>
#include <stdint.h>

#include "control/bp_pid.h"
#include "control/commutation.h"
#include "control/machine_tables.h"

/* Current that carries a torque at the hand-over angle, A, Q7.9: entry 4 m + n is of 2^m (1 + n / 4) - 1 sixteenths of
 * a N m, the first of no torque, the last of the largest in Q7.24. */
#define DITC_DUTY_AIMS 46
typedef struct {
    uint16_t current_q9[DITC_DUTY_AIMS];
} ditc_duty_aims_t;

typedef struct {
    bp_pid_parameters_t pid;
    ditc_duty_aims_t aims;
    int32_t incoming_gain_q24; /* duty per A of the incoming phase's current error, Q7.24 */
    int32_t surplus_q32;       /* of the reference, 0..1/2 - 2^-32: see above */
    int32_t spent_torque_q24;  /* of the outgoing phase: see above; N m, Q7.24, >= 0 */
    int32_t band_outer_q24;    /* N m, Q7.24 */
    int32_t current_limit_q9;  /* A, Q7.9 */
} ditc_duty_parameters_t;

typedef struct {
    bp_pid_t pid;
    unsigned regulated; /* the PID's phase; COMMUTATION_NONE before the first */
} ditc_duty_t;

typedef struct {
    const int32_t *current_q9; /* A, Q7.9, by phase */
    const int32_t *torque_q24; /* N m, Q7.24, by phase */
    int32_t reference_q24;     /* N m, Q7.24, >= 0 */
    int32_t error_q24;         /* reference - sum of the torques */
} ditc_duty_sample_t;

/* The aims of a machine for a hand-over angle of 2^31..2^32-1, 2^-32 pitch. */
ditc_duty_aims_t ditc_duty_aims(const machine_tables_t *tables, uint32_t hand_over_angle);

/* The aim for a torque >= 0 in N m, Q7.24: current in A, Q7.9, linear between the table's torques. */
int32_t ditc_duty_aim_q9(const ditc_duty_aims_t *aims, int32_t torque_q24);

/* Initial weights, no phase regulated. */
void ditc_duty_reset(const ditc_duty_parameters_t *parameters, ditc_duty_t *ditc);

/* One sample: duty of each phase, Q1.15, -32768..32768. */
void ditc_duty_step(const ditc_duty_parameters_t *parameters, ditc_duty_t *ditc, const commutation_t *commutation,
                    const ditc_duty_sample_t *sample, int32_t duty_q15[HAL_PHASES_MAX]);

#endif
