/* Flux observer: flux linkage of a phase by integration of the voltage, corrected by the current model.
 *
 *   psi += gain (psi(theta, i) - psi)              at the sample, psi(theta, i) from the machine tables
 *   psi(k+1) = psi(k) + Ts (v - R i)               over the period that starts with the sample
 *
 * Faraday's law in forward-Euler form, combined with the current model by a complementary filter: the integral has no
 * measurement noise, the table no drift. Derived here: with gain g and exact v and R an error of the estimate decays as
 * (1 - g)^k. Flux linkage is clamped at 0, because the diodes block reverse current.
 */
#ifndef CONTROL_FLUX_OBSERVER_H
#define CONTROL_FLUX_OBSERVER_H

#include <stdint.h>

typedef struct {
    int32_t gain_q30;              /* 0..1 - 2^-30, Q1.30 */
    int32_t resistance_period_q40; /* R Ts in ohm s, Q-9.40: below 2 ms ohm */
} flux_observer_parameters_t;

/* One sample of one phase: corrects *flux_q29 (Wb, Q2.29) and advances it to the next sample. table_q29: flux linkage
 * from the tables at the measured current, Wb, Q2.29; 0 without current. applied_q29: volt-seconds of the duty that
 * acts in this period, Wb, Q2.29. current_q9: A, Q7.9, 0..2^18. Returns R i Ts in Wb, Q2.29. The correction is rounded
 * to 4 LSB, the drop to 1; sums saturate. */
int32_t flux_observer_step(const flux_observer_parameters_t *parameters, int32_t *flux_q29, int32_t table_q29,
                           int32_t applied_q29, int32_t current_q9);

#endif
