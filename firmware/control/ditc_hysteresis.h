/* Direct instantaneous torque control by hysteresis: three switch states a phase.
 *
 *   +1 both switches on (+Vdc), 0 one on (freewheeling), -1 both off (-Vdc)      (1) of the paper
 *
 * Rules, error = reference - torque of all phases:
 *   one phase at work    +1 above +inner, 0 below -inner, -1 below -outer; unchanged between, 0 after -1
 *   two phases at work   outgoing: +1 above +inner, -1 below -inner, 0 when the error has returned through zero
 *                        incoming: +1 above +outer, 0 below zero; unchanged between, 0 after -1
 *   other phases         -1
 *
 * The outgoing phase, large in inductance, moves the torque in small steps and so gets the inner band; the incoming
 * one, where a period at full voltage is several amperes, comes in when the outgoing one no longer suffices. The other
 * way round (incoming first) the incoming phase is pumped to the current limit before it has any torque, and the ripple
 * is 1.0 to 1.6 instead of 0.3 to 0.8 at 40 kHz. A phase above the current limit is not switched on.
 */
#ifndef CONTROL_DITC_HYSTERESIS_H
#define CONTROL_DITC_HYSTERESIS_H

#include <stdint.h>

#include "control/commutation.h"

typedef struct {
    int32_t band_inner_q24;   /* N m, Q7.24, >= 0 */
    int32_t band_outer_q24;   /* N m, Q7.24, >= inner */
    int32_t current_limit_q9; /* A, Q7.9 */
} ditc_hysteresis_parameters_t;

typedef struct {
    int8_t state[HAL_PHASES_MAX]; /* +1, 0, -1 */
} ditc_hysteresis_t;

/* All phases -1. */
void ditc_hysteresis_reset(ditc_hysteresis_t *ditc);

/* One sample: new states from the torque error (N m, Q7.24) and the phase currents (A, Q7.9). */
void ditc_hysteresis_step(const ditc_hysteresis_parameters_t *parameters, ditc_hysteresis_t *ditc,
                          const commutation_t *commutation, int32_t torque_error_q24, const int32_t *current_q9);

#endif
