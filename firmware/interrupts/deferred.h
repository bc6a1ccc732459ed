/* Deferred step: the part of the control that need not be done within the period.
 *
 *   protect      deferred checks                                                           protection.h
 *   bandwidth    statistics of the innovation -> limits of the observer's trigger           observer_bandwidth.h
 *   moving load  trend of the innovation -> least bandwidth                                 moving_load.h
 *   speed law    speed error -> torque, without feed-forward                               speed_pi.h, speed_smc.h
 *   limit        speed -> limit of the currents of hysteresis control                      ditc_hysteresis.h
 *   torque mode  commanded torque -> torque                                                torque_mode.h
 *   conduction   torque, its shortfall, speed, voltage -> angles, largest torque            conduction.h
 *   offset       mean torque error -> torque reference                                     torque_offset.h
 *   periodic     load torque that repeats with every turn -> torque reference, observer    periodic_load.h
 *   learn        misalignment of each phase                                                misalignment.h
 *   network      sample of the BP-PID -> its gains                                          bp_tuner.h
 *   inertia      torque and acceleration in transients -> laws of the inertia              inertia.h
 *
 * The control interrupt ends with the hand-over of its values; the deferred interrupt makes the step, and its results
 * act in the next control period. When the step is not complete by then, the results of the previous one remain in
 * effect, and no input is handed over until it is: periods are skipped, which delays the results but does not change
 * their meaning. Checks and triggers cover the skipped periods, statistics and learning leave them out.
 */
#ifndef INTERRUPTS_DEFERRED_H
#define INTERRUPTS_DEFERRED_H

#include <stdbool.h>

#include "interrupts/control_step.h"

/* Periods per update of the jobs that take turns (deferred_jobs.def): learning of the phases; torque offset, mean load
 * and periodic load; learning of their common angle, inertia; conduction angles. */
#define DEFERRED_LEARNING_PERIODS 2
#define DEFERRED_SLOW_PERIODS 4
#define DEFERRED_COMMON_PERIODS 8
#define DEFERRED_CONDUCTION_PERIODS (CONDUCTION_STEPS * DEFERRED_SLOW_PERIODS)

/* Results in effect. [control interrupt, or background in a critical section] */
static inline const deferred_results_t *deferred_in_effect(const control_state_t *state) {
    return deferred_results(&state->deferred_request, &state->deferred.response);
}

/* Hands the values of this period over, or counts the period as skipped. run: in state RUN. [control interrupt] */
void deferred_hand_over(const control_parameters_t *parameters, control_state_t *state, const control_sample_t *sample,
                        const command_t *command, bool run);

/* Computes the results of the pending step; deferred_complete() then puts them into effect. The control interrupt may
 * pre-empt both. command: the last accepted one; the background, which alone changes it, waits for the step.
 * [deferred interrupt] */
void deferred_compute(const control_parameters_t *parameters, control_state_t *state, const command_t *command);

/* Resets for the next run: conduction angles of torque sharing.
 * [control interrupt, or background in a critical section] */
void deferred_reset_run(control_state_t *state);

/* Parts in which the speed law follows changed parameters, so that no interrupt waits for both. */
enum { DEFERRED_TUNE_INERTIA, DEFERRED_TUNE_LAWS, DEFERRED_TUNE_PARTS };

/* Makes the speed law follow changed parameters, all parts in their order; no other state follows from tunable ones
 * (parameters.h). [background, in a critical section] */
void deferred_tune(const control_parameters_t *parameters, control_state_t *state, unsigned part);

/* Resets with the observer: statistics of the innovation. [control interrupt] */
void deferred_reset_observer(control_state_t *state);

#endif
