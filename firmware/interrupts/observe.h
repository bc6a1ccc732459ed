/* Observation step of the control interrupt: rotor angle, speed and load torque. */
#ifndef INTERRUPTS_OBSERVE_H
#define INTERRUPTS_OBSERVE_H

#include "interrupts/control_step.h"

/* Corrects the observer with the measurement of this period and predicts the coming sample, with the periodic load of
 * the deferred step; the bandwidth follows the innovation. */
void observe(const control_parameters_t *parameters, control_state_t *state, const deferred_results_t *deferred);

/* Outside a run, once a period in which the state stays, after observe(): finds an observer that slips, and restarts it
 * at the encoder's angle and its speed in half a millisecond. From late interrupts, a jump or a stuck encoder a speed
 * may be left at which the innovation, limited as it is, has no mean that would correct it; as over-speed it would keep
 * a drive in its fault. A faster rotor than one of 60,000 r/min would alias. periods_per_ms: at least 20. */
void observe_recover(control_state_t *state, uint32_t periods_per_ms);

/* Restarts the observer without a load, with its maximum bandwidth; angle and speed are kept. */
void observe_forget_load(control_state_t *state);

#endif
