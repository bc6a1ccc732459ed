/* PID whose gains a BP network gives, incremental form: torque error to duty.
 *
 *   u(k) = u(k-1) + kp (e - e1) + ki e + kd (e - 2 e1 + e2)     (15) as in (25); printed with e(k) thrice
 *
 * with kp, ki, kd the network's outputs (0..1) times their scales. The error enters as e / error_scale, held within
 * +-1, as do its first and second difference; they are the network's inputs too, in the order of (15) (the paper does
 * not name its inputs). Learning pauses while the duty is saturated or the errors are at their limits: the gradient
 * says nothing then, and learning from it drives the weights away.
 */
#ifndef CONTROL_BP_PID_H
#define CONTROL_BP_PID_H

#include <stdbool.h>
#include <stdint.h>

#include "control/bp_network.h"

typedef enum {
    BP_PID_OFF,     /* no PID: whoever uses it falls back to hysteresis */
    BP_PID_FIXED,   /* gains at half their scales */
    BP_PID_FROZEN,  /* gains from the network, weights as they are */
    BP_PID_LEARNING /* gains from the network, which learns */
} bp_pid_mode_t;

typedef struct {
    bp_pid_mode_t mode;
    uint32_t seed;                   /* of the initial weights */
    int32_t error_scale_inverse_q24; /* 1/(N m), Q7.24, 0 < scale_inverse <= 64 */
    int32_t scale_q28[BP_OUTPUTS];   /* of kp, ki, kd: duty per scaled error, Q3.28, 0..4 */
    bp_network_parameters_t network;
} bp_pid_parameters_t;

typedef struct {
    bp_network_t network;
    int32_t error_q16;            /* e(k-1), scaled */
    int32_t rise_q16;             /* e(k-1) - e(k-2), within +-2 */
    int32_t duty_q23;             /* u, Q8.23, within +-1 */
    int32_t gain_q24[BP_OUTPUTS]; /* kp, ki, kd in use, Q7.24, 0..4; for display */
} bp_pid_t;

/* Weights from the seed, no error, duty 0. */
void bp_pid_reset(const bp_pid_parameters_t *parameters, bp_pid_t *pid);

/* Continues from another duty (Q1.15, -32768..32768) when the PID takes over a phase. */
void bp_pid_preset(bp_pid_t *pid, int32_t duty_q15);

/* Duty and gains 0, for who displays them, of a PID that is not in use; the rest as it was until the next reset. */
void bp_pid_show_none(bp_pid_t *pid);

/* One sample: duty in Q1.15, -32768..32768, from the torque error in N m, Q7.24, any value. */
int32_t bp_pid_step(const bp_pid_parameters_t *parameters, bp_pid_t *pid, int32_t torque_error_q24);

#endif
