/* Torque trim: correction of the torque reference by the BP-PID, for the torque error that predictive control leaves.
 *
 *   output(k) = reference(k) + trim(k),   trim(k) = limit * BP-PID(reference(k-2) - torque(k))
 *
 * Derived here: a reference acts two samples later (one period to compute, one to act), so that the untrimmed reference
 * of two samples ago is the torque due now. With the trimmed or an undelayed reference in its place the integral part
 * drifts. The trim is constant while the voltage is limited, because the error is then not one that the trim can
 * remove.
 */
#ifndef CONTROL_TORQUE_TRIM_H
#define CONTROL_TORQUE_TRIM_H

#include <stdbool.h>
#include <stdint.h>

#include "control/bp_pid.h"

typedef struct {
    bp_pid_parameters_t pid; /* output +-1 is +-limit; BP_PID_OFF: no trim */
    int32_t limit_q24;       /* N m, Q7.24, >= 0 */
} torque_trim_parameters_t;

typedef struct {
    bp_pid_t pid;
    int32_t reference_q24[2]; /* untrimmed, of the last sample and of the one before, N m, Q7.24 */
    int32_t trim_q24;         /* N m, Q7.24 */
} torque_trim_t;

/* Trim 0; past references: the given one, N m, Q7.24. */
void torque_trim_reset(torque_trim_t *trim, int32_t reference_q24);

/* torque_trim_step() of a trim that is not off. */
int32_t torque_trim_correct(const torque_trim_parameters_t *parameters, torque_trim_t *trim,
                            const int32_t gain_q24[BP_OUTPUTS], int32_t reference_q24, int32_t torque_q24,
                            bool voltage_limited);

/* One sample: trimmed reference in N m, Q7.24; without trim the reference. gain_q24: of the BP-PID, bp_pid_step().
 * Reference and estimated torque at the sample in N m, Q7.24, any value; voltage_limited keeps the trim constant. Sums
 * saturate, the 64-bit product is rounded to nearest. */
static inline int32_t torque_trim_step(const torque_trim_parameters_t *parameters, torque_trim_t *trim,
                                       const int32_t gain_q24[BP_OUTPUTS], int32_t reference_q24, int32_t torque_q24,
                                       bool voltage_limited) {
    if (parameters->pid.mode == BP_PID_OFF) {
        return reference_q24;
    }
    return torque_trim_correct(parameters, trim, gain_q24, reference_q24, torque_q24, voltage_limited);
}

#endif
