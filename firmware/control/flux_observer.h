/* Flux linkage of each phase: what the voltage integrates to, corrected by what the current says.
 *
 *   psi += gain (psi(theta, i) - psi)              at the sample, psi(theta, i) by the machine's tables
 *   psi(k+1) = psi(k) + Ts (v - R i)               over the period that starts with the sample
 *
 * The integral carries no noise and the table no drift. Flux linkage is never negative: the diodes block.
 */
#ifndef CONTROL_FLUX_OBSERVER_H
#define CONTROL_FLUX_OBSERVER_H

#include <stdint.h>

typedef struct {
    int32_t gain_q15;              /* 0..32768 */
    int32_t resistance_period_q40; /* R Ts in ohm s, Q-9.40: below 2 ms ohm */
} flux_observer_parameters_t;

/* One sample of one phase: corrects *flux_q29 (Wb, Q2.29) and advances it to the next sample. table_q29: by the tables
 * at the measured current, 0 for none. applied_q29: the volt seconds, Wb, Q2.29, of the duty that acts in this period.
 * current_q9: A, Q7.9, 0..2^18. Returns R i Ts in Wb, Q2.29. 64-bit products, rounded; sums saturate. */
int32_t flux_observer_step(const flux_observer_parameters_t *parameters, int32_t *flux_q29, int32_t table_q29,
                           int32_t applied_q29, int32_t current_q9);

#endif
