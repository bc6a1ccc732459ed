/* Heat of windings and switches by thermal models of the measured currents (I2t), one of first order for each winding
 * and for the switches of each phase:
 *
 *   d load / dt = ((i / i_c)^2 - load) / tau
 *
 * i_c is the continuous current, tau the time constant; the load is the temperature rise as a part of that at i_c. The
 * switches of a phase are taken to carry its whole current, which they do but for the time in which its diodes do.
 *
 * Above THERMAL_DERATE the limit of the torque falls linearly, down to 0 at the load 1, which is a fault until the load
 * is below THERMAL_DERATE again.
 *
 * The background samples the currents. Its calls are not synchronous with the commutation, and many in a stroke, so
 * that the mean of their squares is without bias; samples of a step of 1 ms or more count alike. The models start cold.
 */
#ifndef MONITORS_THERMAL_H
#define MONITORS_THERMAL_H

#include <stdbool.h>
#include <stdint.h>

#include "hal.h"
#include "storage/parameters.h"

#define THERMAL_STEP_US 1000u
/* A longer step counts as one of this length. */
#define THERMAL_STEP_MAX_US 100000u

/* Loads in Q16; 1 is the limit. */
#define THERMAL_LIMIT_Q16 (1 << 16)
#define THERMAL_DERATE_Q16 58982 /* 0.9 */

/* Time constant of the switches against their heat sink. */
#define THERMAL_SWITCH_TIME_CONSTANT_S 1

/* Squares above this many times the square of the continuous current count as this. */
#define THERMAL_SQUARE_MAX 64

/* One model. */
typedef struct {
    uint32_t inverse_q48; /* 1 / i_c^2, of i_c in the LSB of Q7.9 */
    uint32_t rate_q48;    /* step of 1 us / tau */
} thermal_model_t;

typedef struct {
    thermal_model_t winding, switches;
    int32_t torque_max_q24; /* N m, Q7.24 */
} thermal_parameters_t;

typedef struct {
    uint64_t square_q18[HAL_PHASES_MAX]; /* sum of the samples of the present step, A^2 */
    uint32_t samples;                    /* of the present step */
    uint32_t step_us;                    /* its beginning */
    int64_t winding_q56[HAL_PHASES_MAX]; /* loads, below 64 */
    int64_t switches_q56[HAL_PHASES_MAX];
    bool winding_hot, switches_hot; /* the faults */
} thermal_t;

/* Derives the parameters: any values within the limits of the table. */
thermal_parameters_t thermal_configure(const int32_t *values);

/* The same heat beside other continuous currents. `before`: all zero when there are none yet. [background] */
void thermal_reconfigure(const thermal_parameters_t *before, const thermal_parameters_t *now, thermal_t *thermal);

/* Samples the currents, in A, Q7.9, 0..2^16-1, and moves the models when a step is over. True in a call that has moved
 * them. [background] */
bool thermal_sample(const thermal_parameters_t *parameters, thermal_t *thermal, const int32_t *current_q9,
                    uint32_t time_us);

/* Largest load of a winding or of switches, Q16, at most 64. */
uint32_t thermal_winding_load_q16(const thermal_t *thermal);
uint32_t thermal_switch_load_q16(const thermal_t *thermal);

/* Limit of the magnitude of the torque reference, N m, Q7.24: 0..torque_max_q24. */
int32_t thermal_torque_limit_q24(const thermal_parameters_t *parameters, const thermal_t *thermal);

/* Fault mask of the overloads. */
uint32_t thermal_faults(const thermal_t *thermal);

#endif
