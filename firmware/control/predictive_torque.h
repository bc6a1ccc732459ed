/* Predictive torque control: each phase gets the voltage that brings its flux linkage to where it makes its share of
 * the torque at the end of the coming period.
 *
 *   sample k          flux linkage now, and at k + 1 by the voltage that already acts (flux_observer)
 *   reference         at the angle of k + 2: share of the torque -> current -> flux linkage, by the machine's tables
 *   voltage           duty = (psi*(k+2) - psi(k+1) + R i Ts) / (Vdc Ts), acts from k + 1 to k + 2
 *
 * A phase can only be moved by +-Vdc Ts. Where a reference is out of that reach, the phase goes as far as it can, and
 * the torque that is then missing (or too much) is given to the others in DITC's order: what is missing first to the
 * incoming phase, then to the active, then to the outgoing one; what is too much is taken off the outgoing one first.
 * Every phase stays in the states (+1, 0) or (-1, 0).
 *
 * Torque of either sign at either direction of rotation: a phase makes positive torque in the half of its pitch from
 * unaligned to aligned and negative torque in the other, where everything is asked at the mirror image.
 *
 * A phase that brakes carries no more flux linkage than -Vdc takes away until the phase is unaligned. Where the speed
 * voltage exceeds Vdc, its current would otherwise rise against full -Vdc as the inductance falls, beyond any limit.
 *
 * With a reserve the two halves work against each other: positive and negative torque of at least the reserve in sum,
 * so that a load step finds flux linkage that only needs to be let go, which -Vdc does at once in any position. It
 * costs copper loss all the time.
 *
 * Torque that stays missing moves the conduction windows towards earlier angles (torque_share.h), within 100 ms, and
 * torque that does not moves them back within a second.
 */
#ifndef CONTROL_PREDICTIVE_TORQUE_H
#define CONTROL_PREDICTIVE_TORQUE_H

#include <stdbool.h>
#include <stdint.h>

#include "control/flux_observer.h"
#include "control/machine_tables.h"
#include "control/phase_map.h"
#include "control/torque_share.h"
#include "hal.h"

typedef struct {
    flux_observer_parameters_t flux;
    torque_share_parameters_t share;
    torque_share_window_t late; /* without advance */
    int32_t period_q40;         /* Ts in s, Q-9.40 */
    int32_t current_limit_q9;   /* A, Q7.9 */
    int32_t reserve_q24;        /* N m, Q7.24, >= 0 */
    int32_t advance_q30;        /* a period with torque missing, Q1.30 */
    int32_t return_q30;         /* a period without */
} predictive_torque_parameters_t;

typedef struct {
    int32_t flux_q29[HAL_PHASES_MAX]; /* predicted for the coming sample, Wb, Q2.29 */
    int32_t duty_q15[HAL_PHASES_MAX]; /* that acts from the coming sample on, Q1.15 */
    int32_t advance_q30;              /* 0..1 */
    int32_t missing_q24;              /* torque reference less what the voltage allows, beyond 1/64 N m; N m, Q7.24 */
    uint8_t column[HAL_PHASES_MAX];   /* of the tables, where a phase was planned to be */
} predictive_torque_t;

typedef struct {
    const int32_t *current_q9; /* A, Q7.9, by phase, at the sample */
    const int32_t *flux_q29;   /* Wb, Q2.29, by the tables, by phase, at the sample */
    const uint32_t *angle;     /* of each phase two periods after the sample, 2^-32 pitch */
    int32_t bus_voltage_q6;    /* V, Q9.6 */
    int32_t torque_q24;        /* reference, N m, Q7.24 */
    bool backwards;            /* the rotor turns that way */
    uint32_t turn;             /* how far in a period, 2^-32 pitch, either way */
} predictive_torque_sample_t;

/* No flux linkage, no duty, no advance. */
void predictive_torque_reset(predictive_torque_t *control);

/* One sample: duty of each phase, Q1.15, -32768..32768. Saturating everywhere; the division's quotient is within 2^-14
 * of full duty. */
void predictive_torque_step(const predictive_torque_parameters_t *parameters, predictive_torque_t *control,
                            const machine_tables_t *tables, const predictive_torque_sample_t *sample,
                            int32_t duty_q15[HAL_PHASES_MAX]);

#endif
