/* Load observer: rotor angle, speed and load torque from the encoder and the estimated machine torque.
 *
 * Luenberger observer (D. G. Luenberger, "An introduction to observers", IEEE Trans. Autom. Control 16(6), 1971) of
 *
 *   d(angle)/dt = w,   J dw/dt = T - B w - T_L,   dT_L/dt = 0
 *
 * Each sample corrects with its innovation e, angle += l1 e, w += l2 e, T_L -= J l3 e, and predicts the next sample.
 * Three equal real poles at q = e^(-w0 Ts) give
 *
 *   l1 = 1 - q^3,   l2 = 1.5 (1 - q)^2 (1 + q) / Ts,   l3 = (1 - q)^3 / Ts^2
 *
 * Derived here for B = 0, by equating coefficients of the characteristic polynomial:
 *   z^3 + (l1 + l2 Ts + l3 Ts^2 / 2 - 3) z^2 + (3 - 2 l1 - l2 Ts + l3 Ts^2 / 2) z + l1 - 1 = (z - q)^3
 *
 * The paper assumes T_L to be known, which it is not in a drive.
 */
#ifndef CONTROL_LOAD_OBSERVER_H
#define CONTROL_LOAD_OBSERVER_H

#include <stdint.h>

/* Set by the bandwidth. */
typedef struct {
    int32_t angle_gain_q28; /* l1 */
    int32_t speed_gain_q24; /* l2: rad/s Q9.22 per 2^-32 rev, in Q24 */
    int32_t load_gain_q28;  /* -J l3 / factor: N m Q7.24 per 2^-32 rev, in Q28 */
    int32_t load_factor_q4; /* 1, or the power of two that the range of the gain needs */
} load_observer_gains_t;

/* Set by machine and control rate. */
typedef struct {
    int32_t acceleration_q32; /* Ts / J: rad/s Q9.22 per N m Q7.24, in Q32 */
    int32_t friction_q30;     /* B, N m s, Q1.30 */
    int32_t angle_step_q32;   /* Ts: 2^-32 rev per rad/s Q9.22, in Q32 */
} load_observer_model_t;

/* Set by the identified inertia J 2^-k, k = -2..2. */
typedef struct {
    int32_t acceleration_q32; /* 2^k Ts / J */
    int32_t load_shift;       /* 2 + k: the load gain is divided by 2^k */
} load_observer_inertia_t;

typedef struct {
    uint64_t angle_q64;           /* mechanical, 2^-64 rev, wraps */
    int32_t speed_q22;            /* rad/s, Q9.22, saturates */
    int32_t load_torque_q24;      /* N m, Q7.24, saturates at +-64 N m */
    int32_t speed_correction_q22; /* l2 e of the last sample, rad/s, Q9.22 */
} load_observer_t;

/* Gains for a bandwidth w0 in rad/s (100..10000), a control rate in Hz (20000..1000000) and an inertia in kg m^2, Q1.30
 * (from 10^-4). Error of each gain: 0.1 percent and 1 LSB for w0 >= rate / 1000; of the load gain 2 percent down to
 * rate / 10000. 64-bit integer arithmetic. */
load_observer_gains_t load_observer_gains(uint32_t bandwidth_rad_s, uint32_t control_rate_hz, int32_t inertia_q30);

/* Gains for q = 0 at a rate of 100 to 1000 samples a second: three samples determine the estimate. */
load_observer_gains_t load_observer_deadbeat_gains(uint32_t sample_rate_hz, int32_t inertia_q30);

/* Model for a control rate in Hz, an inertia in kg m^2, Q1.30, and a viscous friction in N m s, Q1.30. */
load_observer_model_t load_observer_model(uint32_t control_rate_hz, int32_t inertia_q30, int32_t friction_q30);

/* For k = -2..2; the acceleration saturates. */
load_observer_inertia_t load_observer_inertia(const load_observer_model_t *model, int32_t k);

/* Acceleration in rad/s^2 (2^speed_exponent of SI, as every speed) by a torque (N m, Q7.24) on an inertia (kg m^2,
 * Q1.30), rounded towards zero: 19 bits for 40 N m on 10^-4 kg m^2. */
int64_t load_observer_acceleration(int32_t torque_q24, int32_t inertia_q30);

/* Estimate: given angle (2^-32 rev), speed 0, load torque 0. The estimate converges to a spinning rotor within 10 / w0
 * (20 / w0 above 2 w0 rad/s). */
void load_observer_reset(load_observer_t *observer, uint32_t angle);

/* Innovation: measured angle less predicted angle, 2^-32 rev, modulo a revolution, saturated to -2^27..2^27 - 1 (1/32
 * rev). Unsaturated, a jump of the encoder would show as overspeed. */
int32_t load_observer_innovation(const load_observer_t *observer, uint32_t angle);

/* One sample: corrects with its innovation (-2^27..2^27 - 1), then predicts one period ahead with the machine torque (N
 * m, Q7.24). Afterwards angle, speed and load torque are the estimate for the coming sample. 64-bit products and angle
 * accumulator. Speed correction, friction torque and half of the speed change are rounded down, the speed change to
 * nearest, the load correction to nearest before its factor and down after it; speed and load torque saturate, the
 * speed correction to within 16 LSB of the end. */
void load_observer_step(const load_observer_model_t *model, const load_observer_gains_t *gains,
                        const load_observer_inertia_t *inertia, load_observer_t *observer, int32_t innovation,
                        int32_t torque_q24);

#endif
