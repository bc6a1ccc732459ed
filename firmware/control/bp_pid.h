/* BP-PID: PID in incremental form whose gains a BP network tunes (bp_tuner.h); torque error to duty.
 *
 *   u(k) = u(k-1) + kp (e - e1) + ki e + kd (e - 2 e1 + e2)     (15) of the paper, in the form of its (25): (15) is
 *                                                               published with e(k) three times
 *
 * e is the torque error / error_scale, saturated at +-1, as are its first and second difference.
 */
#ifndef CONTROL_BP_PID_H
#define CONTROL_BP_PID_H

#include <stdbool.h>
#include <stdint.h>

#include "control/bp_network.h"

typedef enum {
    BP_PID_OFF,     /* no PID: the caller uses hysteresis */
    BP_PID_FIXED,   /* gains at half their scales */
    BP_PID_FROZEN,  /* gains from the network, weights constant */
    BP_PID_LEARNING /* gains from the network, learning online */
} bp_pid_mode_t;

typedef struct {
    bp_pid_mode_t mode;
    uint32_t seed;                   /* seed of the initial weights */
    int32_t error_scale_inverse_q24; /* 1 / error_scale, 1/(N m), Q7.24, 0 < inverse <= 64 */
    int32_t scale_q28[BP_OUTPUTS];   /* scales of kp, ki, kd: duty per scaled error, Q3.28, 0..4 */
    bp_network_parameters_t network;
} bp_pid_parameters_t;

/* Sample of the PID from which the network learns. */
typedef struct {
    int32_t term_q31[BP_OUTPUTS]; /* of kp, ki, kd: e - e1, e, e - 2 e1 + e2, scaled, Q0.31 */
    bool learns;                  /* neither duty nor error is saturated */
} bp_pid_sample_t;

typedef struct {
    bp_pid_sample_t sample;       /* the last one */
    int32_t error_q16;            /* e(k-1), scaled, Q1.16 */
    int32_t error_difference_q16; /* e(k-1) - e(k-2), within +-2, Q16 */
    int32_t duty_q23;             /* u, Q8.23, within +-1 */
    int32_t gain_q24[BP_OUTPUTS]; /* kp, ki, kd of the last sample, Q7.24, 0..4; telemetry */
} bp_pid_t;

/* Error and duty 0. */
void bp_pid_reset(bp_pid_t *pid);

/* Sets the duty u(k-1), Q1.15, clamped to -32768..32768, for a bumpless transfer to another phase. */
void bp_pid_preset(bp_pid_t *pid, int32_t duty_q15);

/* Sets the last error e(k-1) in N m, Q7.24, any value, where the caller scales errors by a factor that has changed. */
void bp_pid_set_error(const bp_pid_parameters_t *parameters, bp_pid_t *pid, int32_t torque_error_q24);

/* Sets duty and gains, which telemetry reports, to 0 while the PID is not in use. */
void bp_pid_clear_telemetry(bp_pid_t *pid);

/* One sample: duty in Q1.15, -32768..32768, from the gains kp, ki, kd in duty per scaled error, Q7.24, 0..4, and the
 * torque error in N m, Q7.24, any value. 32-bit accumulator in Q8.23, within 1 + 3 * 4, products rounded to nearest;
 * the duty saturates at +-1 and is rounded to nearest. */
int32_t bp_pid_step(const bp_pid_parameters_t *parameters, bp_pid_t *pid, const int32_t gain_q24[BP_OUTPUTS],
                    int32_t torque_error_q24);

#endif
