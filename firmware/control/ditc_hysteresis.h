/* Direct instantaneous torque control (DITC) by hysteresis: three switch states per phase, (1) of the paper.
 *
 *   +1 both switches on (+Vdc), 0 one switch on (freewheeling), -1 both off (-Vdc)
 *
 * Rules, error = reference - total torque of all phases:
 *   single phase         +1 above +inner, 0 below -inner, -1 below -outer; unchanged between, 0 after -1
 *   two phases           outgoing: +1 above +inner, -1 below -inner, 0 when the error has returned through zero
 *                        incoming: +1 above +outer, 0 below zero; unchanged between, 0 after -1
 *   other phases         -1
 *
 * DITC: R. B. Inderka, R. W. De Doncker, "DITC - direct instantaneous torque control of switched reluctance drives",
 * IEEE Trans. Ind. Appl. 39(4), 2003. Assignment of the bands, chosen here: the outgoing phase, whose inductance is
 * large, moves the torque in small steps and has the inner band; the incoming phase, whose current rises several
 * amperes per period, supports it when its torque no longer suffices. With the bands exchanged, the incoming phase is
 * driven to the current limit before it has torque, and the torque ripple is 1.0 to 1.6 instead of 0.3 to 0.8 at 40
 * kHz.
 *
 * A phase above the current limit is not switched on: 0 instead of +1. While the rotor turns backwards, the phases
 * generate: a freewheeling current rises further, and faster than the limit provides for. The limit is then 3/4, or
 * less where the EMF adds as much as the DC link at the limit of the speed, and a phase above it is switched off: -1.
 * Below 0 it lets no current begin. Nothing overflows.
 */
#ifndef CONTROL_DITC_HYSTERESIS_H
#define CONTROL_DITC_HYSTERESIS_H

#include <stdbool.h>
#include <stdint.h>

#include "control/commutation.h"

typedef struct {
    int32_t band_inner_q24;   /* N m, Q7.24, >= 0 */
    int32_t band_outer_q24;   /* N m, Q7.24, >= inner */
    int32_t current_limit_q9; /* A, Q7.9 */
    /* Limit while the rotor turns backwards: at standstill, A, Q7.9, and by how much it is less per rad/s, A, Q12.19.
     */
    int32_t generating_limit_q9;
    int32_t generating_slope_q19;
} ditc_hysteresis_parameters_t;

/* Limit of the currents in effect. */
typedef struct {
    int32_t current_q9; /* A, Q7.9 */
    int32_t state;      /* highest state above it, a duty in Q1.15 */
} ditc_hysteresis_limit_t;

/* Limit at a speed against the order of the phases, rad/s, Q9.22, from 0. */
ditc_hysteresis_limit_t ditc_hysteresis_limit(const ditc_hysteresis_parameters_t *parameters, int32_t backwards_q22);

/* All phases -1. */
void ditc_hysteresis_reset(int32_t duty_q15[HAL_PHASES_MAX]);

/* One sample: new states from the last ones, the torque error (N m, Q7.24, any value) and the phase currents (A, Q7.9).
 * States are duties in Q1.15: -32768, 0, 32768. */
void ditc_hysteresis_step(const ditc_hysteresis_parameters_t *parameters, const commutation_t *commutation,
                          int32_t torque_error_q24, const int32_t *current_q9, ditc_hysteresis_limit_t limit,
                          int32_t duty_q15[HAL_PHASES_MAX]);

#endif
