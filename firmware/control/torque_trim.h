/* Trim of the torque reference by the BP-PID: what the predictive control leaves of the torque error.
 *
 * The error is the reference before the trim, of two samples ago (a period to compute, a period to act), less the
 * estimate: with the reference behind the trim, or not delayed, the integral drifts. The trim stays within +-limit. It
 * holds while voltage runs out: the error is not its own then.
 */
#ifndef CONTROL_TORQUE_TRIM_H
#define CONTROL_TORQUE_TRIM_H

#include <stdbool.h>
#include <stdint.h>

#include "control/bp_pid.h"

typedef struct {
    bp_pid_parameters_t pid; /* its output +-1 is +-limit; BP_PID_OFF: no trim */
    int32_t limit_q24;       /* N m, Q7.24, >= 0 */
} torque_trim_parameters_t;

typedef struct {
    bp_pid_t pid;
    int32_t reference_q24[2]; /* of the last sample and the one before */
    int32_t trim_q24;         /* N m, Q7.24 */
} torque_trim_t;

/* No trim, initial weights; starts at a reference in N m, Q7.24. */
void torque_trim_reset(const torque_trim_parameters_t *parameters, torque_trim_t *trim, int32_t reference_q24);

/* One sample: the reference with its trim, N m, Q7.24, saturated. `torque_q24` is the estimate of the machine's torque
 * at the sample; hold: voltage ran out. */
int32_t torque_trim_step(const torque_trim_parameters_t *parameters, torque_trim_t *trim, int32_t reference_q24,
                         int32_t torque_q24, bool hold);

#endif
