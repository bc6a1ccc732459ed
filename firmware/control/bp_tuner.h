/* Tuner of the BP-PID: the network learns from a sample of the PID, then gives the gains of the coming one.
 *
 *   kp, ki, kd (k+1) = scales * network outputs (0..1) for the inputs e, e - e1, e - 2 e1 + e2 of sample k, in the
 * order of (15) (the paper does not name its inputs)
 *
 * What it learns from sample k is by the forward pass that had the gains of that sample. The paper has gains and duty
 * of the same sample; the gains change little in a period, and the network, three quarters of a BP-PID's instructions,
 * is left to the deferred interrupt. Learning is suspended while duty or error is saturated: the output then does not
 * depend on the gains, and learning from the error would drive the weights away.
 */
#ifndef CONTROL_BP_TUNER_H
#define CONTROL_BP_TUNER_H

#include <stdbool.h>
#include <stdint.h>

#include "control/bp_pid.h"

typedef struct {
    bp_network_t network;
    int32_t input_q31[BP_INPUTS]; /* of the last forward pass, Q0.31 */
    bool passed;                  /* there has been one */
    int32_t gain_q24[BP_OUTPUTS]; /* kp, ki, kd, duty per scaled error, Q7.24, 0..4 */
} bp_tuner_t;

/* Initial weights from the seed, gains at half of their scales: the gains of an error of 0. [deferred interrupt] */
void bp_tuner_reset(const bp_pid_parameters_t *parameters, bp_tuner_t *tuner);

/* One sample of the PID, which is handed over once. Gains are rounded to nearest. [deferred interrupt] */
void bp_tuner_step(const bp_pid_parameters_t *parameters, bp_tuner_t *tuner, const bp_pid_sample_t *sample);

#endif
