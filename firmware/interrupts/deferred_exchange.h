/* Data between the control interrupt and the deferred interrupt, which the former pre-empts at any instruction.
 *
 *   control interrupt    deferred_request_t     input of a deferred step; not written while the step is pending
 *   deferred interrupt   deferred_response_t    results in one of two buffers; one store selects the
 *                                                complete one
 *
 * Each structure is written by one of the two only, and read by the other. A deferred step is pending from its request
 * until its end. The control interrupt requests none in a period in which one is pending, and counts that period as
 * skipped.
 *
 * Resets: the control interrupt that resets something changes the generation, and uses its own initial results until
 * a step's with an input of the present generation arrive. So a late step cannot undo a reset. The deferred step
 * resets its own state when it sees another generation.
 */
#ifndef INTERRUPTS_DEFERRED_EXCHANGE_H
#define INTERRUPTS_DEFERRED_EXCHANGE_H

#include <stdbool.h>
#include <stdint.h>

#include "control/bp_pid.h"
#include "control/conduction.h"
#include "control/ditc_hysteresis.h"
#include "control/load_observer.h"
#include "control/observer_bandwidth.h"
#include "control/pwm_ditc.h"
#include "control/slow_counts.h"
#include "fixed/compiler.h"
#include "hal.h"

/* Generation: resets of a run in the lower half, of the observer in the upper one. */
#define DEFERRED_RUN_MASK UINT32_C(0x0000FFFF)
#define DEFERRED_OBSERVER_MASK UINT32_C(0xFFFF0000)
#define DEFERRED_OBSERVER_STEP UINT32_C(0x00010000)

/* Values of one control period. */
typedef struct {
    uint32_t generation;
    uint32_t periods;           /* since the input of the previous deferred step, from 1 */
    uint32_t encoder_angle;     /* start of the encoder count, 2^-32 rev */
    int32_t dc_link_voltage_q6; /* V, Q9.6 */
    uint32_t command_age_us;    /* time since the last accepted command */
    uint32_t angle;             /* observer, for the coming sample, 2^-32 rev */
    int32_t speed_q22;          /* likewise, rad/s, Q9.22 */
    /* With an adaptive bandwidth only. */
    observer_bandwidth_sample_t bandwidth;
    bool run;                     /* state RUN */
    int32_t torque_reference_q24; /* of this period, N m, Q7.24; 0 outside RUN */
    uint32_t electrical;          /* angle of phase 0, 2^-32 electrical rev */
    int32_t current_q9;           /* of the phase misalignment_t.phase_index, A, Q7.9 */
    /* With torque control by the duty of the BP-PID only: of the phase that it regulates. */
    uint32_t regulated_angle;     /* 2^-32 electrical rev */
    int32_t regulated_current_q9; /* A, Q7.9 */
    bp_pid_sample_t pid;          /* with a BP-PID only */
    /* With predictive torque control only. */
    int32_t load_torque_q24;      /* observer, N m, Q7.24 */
    int32_t speed_correction_q22; /* observer, rad/s, Q9.22 */
    int32_t torque_sum_q24;       /* of the sample, N m, Q7.24 */
    int32_t torque_shortfall_q24;
} deferred_input_t;

/* Results for torque control by flux linkage. */
typedef struct {
    unsigned conduction;                  /* index of the angles, conduction_angles() */
    int32_t misalignment[HAL_PHASES_MAX]; /* to subtract from the angle of each phase, 2^-32 electrical rev */
} deferred_predictive_results_t;

/* Results of the speed and torque laws; all zero outside RUN. */
typedef struct {
    int32_t speed_reference_q22;  /* after the ramp, rad/s, Q9.22; 0 in torque mode */
    int32_t speed_law_torque_q24; /* speed law, torque offset, periodic load, N m, Q7.24 */
    int32_t periodic_load_q24;    /* part that the observer is given as load, N m, Q7.24 */
    int32_t torque_min_q24;       /* limits of the torque reference, feed-forward included, N m, Q7.24; */
    int32_t torque_max_q24;       /* both are the reference in torque mode */
} deferred_speed_results_t;

/* Results that act from the next control period on. All zero means no effect, except for the conduction angles and the
 * inertia, which have initial values. Divided into parts small enough to be copied without a call of memcpy, which took
 * 79 instructions of a reset. */
typedef struct {
    uint32_t generation; /* of the input */
    uint32_t fault_mask; /* failed deferred checks, lower half of their FAULT_BITs */
    deferred_speed_results_t speed;
    observer_bandwidth_limits_t bandwidth; /* of the trigger */
    deferred_predictive_results_t predictive;
    load_observer_inertia_t observer; /* identified, inertia.h */
    slow_counts_results_t slow_counts;
    ditc_hysteresis_limit_t limit; /* without predictive torque control only */
    pwm_ditc_plan_t duty;          /* with torque control by the duty of the BP-PID only */
    /* With a BP-PID only: of bp_tuner_t; until the next step after a reset 0, with which it keeps its duty. */
    int32_t pid_gain_q24[BP_OUTPUTS];
} deferred_results_t;

typedef struct {
    uint32_t requests;   /* deferred steps, modulo 2^32 */
    uint32_t generation; /* lower half: run, upper half: observer */
    uint32_t skipped;    /* periods since the last request */
    uint32_t skipped_total;
    deferred_input_t input;
    deferred_results_t initial; /* in effect until a result of the present generation */
} deferred_request_t;

typedef struct {
    uint32_t completed; /* deferred steps, modulo 2^32 */
    uint32_t latest;    /* index of the results in effect, by its lowest bit */
    deferred_results_t results[2];
} deferred_response_t;

static inline bool deferred_pending(const deferred_request_t *request, const deferred_response_t *response) {
    return request->requests != response->completed;
}

/* Results in effect. [control interrupt, or background in a critical section] */
static inline const deferred_results_t *deferred_results(const deferred_request_t *request,
                                                         const deferred_response_t *response) {
    const deferred_results_t *results = &response->results[response->latest & 1u];
    IN_REGISTER(results);
    return results->generation == request->generation ? results : &request->initial;
}

/* Requests a step with the input, which has been written while none was pending. [control interrupt] */
static inline void deferred_request(deferred_request_t *request) {
    request->requests++;
    request->skipped = 0;
}

/* Counts a period in which a step is still pending. [control interrupt] */
static inline void deferred_skip(deferred_request_t *request) {
    request->skipped++;
    request->skipped_total++;
}

/* Buffer for the results of the pending step. [deferred interrupt] */
static inline deferred_results_t *deferred_buffer(deferred_response_t *response) {
    return &response->results[~response->latest & 1u];
}

/* Puts the buffer into effect and ends the step. The order of the stores matters. [deferred interrupt] */
static inline void deferred_complete(const deferred_request_t *request, deferred_response_t *response) {
    __atomic_signal_fence(__ATOMIC_RELEASE);
    *(volatile uint32_t *)&response->latest = response->latest ^ 1u;
    __atomic_signal_fence(__ATOMIC_RELEASE);
    *(volatile uint32_t *)&response->completed = request->requests;
}

#endif
