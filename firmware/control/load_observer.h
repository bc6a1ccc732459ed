/* Observer for rotor angle, speed and load torque, from the encoder and the estimated machine torque.
 *
 * Model: d(angle)/dt = w, J dw/dt = T - B w - T_L, dT_L/dt = 0. A predictor with output feedback, all three poles at
 * q = e^(-w0 Ts):
 *
 *   l1 = 1 - q^3,  l2 = 1.5 (1 - q)^2 (1 + q) / Ts,  l3 = (1 - q)^3 / Ts^2
 *
 * The paper takes T_L as known; a drive does not know it.
 */
#ifndef CONTROL_LOAD_OBSERVER_H
#define CONTROL_LOAD_OBSERVER_H

#include <stdint.h>

/* What the bandwidth sets. */
typedef struct {
    int32_t angle_gain_q28; /* l1 */
    int32_t speed_gain_q24; /* l2: rad/s Q9.22 per 2^-32 turn, in Q24 */
    int32_t load_gain_q28;  /* -J l3: N m Q7.24 per 2^-32 turn, in Q28, over the factor */
    int32_t load_factor_q4; /* 1, unless the gain needs a greater power of two */
} load_observer_gains_t;

/* What the machine and the control rate set. */
typedef struct {
    int32_t acceleration_q32; /* Ts / J: rad/s Q9.22 per N m Q7.24, in Q32 */
    int32_t friction_q30;     /* B, N m s */
    int32_t angle_step_q32;   /* Ts: 2^-32 turn per rad/s Q9.22, in Q32 */
} load_observer_model_t;

typedef struct {
    uint64_t angle_q64;      /* mechanical, 2^-64 turn, wraps */
    int32_t speed_q22;       /* rad/s, Q9.22, saturates */
    int32_t load_torque_q24; /* N m, Q7.24, saturates at +-64 N m */
    int32_t correction_q22;  /* of the speed in the last sample, l2 times the innovation: rad/s, Q9.22 */
} load_observer_t;

/* Gains for a bandwidth w0 in rad/s (100..10000), a control rate in Hz (20000..1000000) and an inertia in kg m^2, Q1.30
 * (from 10^-4). Integer arithmetic; each gain within 0.1 percent and 1 LSB where w0 is at least a thousandth of the
 * rate, the torque's within 2 percent down to a ten thousandth. */
load_observer_gains_t load_observer_gains(uint32_t bandwidth_rad_s, uint32_t control_rate_hz, int32_t inertia_q30);

/* The model for a control rate, an inertia and a friction in N m s, Q1.30. */
load_observer_model_t load_observer_model(uint32_t control_rate_hz, int32_t inertia_q30, int32_t friction_q30);

/* Starts at an angle (2^-32 turn), at rest, without load. A rotor that turns is caught within 10 / w0 (20 / w0 when it
 * is faster than 2 w0). */
void load_observer_reset(load_observer_t *observer, uint32_t angle);

/* Innovation: how far a measured angle is from the expected one, 2^-32 turn, modulo a turn; held within +-2^27 (a 32nd
 * of a turn), so that it can be multiplied. */
int32_t load_observer_innovation(const load_observer_t *observer, uint32_t angle);

/* One sample: corrects with its innovation (-2^27..2^27-1), then predicts one period on with the machine's torque (N
 * m, Q7.24). Afterwards angle, speed and load are the estimate for the coming sample. 64-bit products; the speed's
 * correction and the friction are rounded down, the other parts to nearest; speed and load saturate. */
void load_observer_step(const load_observer_model_t *model, const load_observer_gains_t *gains,
                        load_observer_t *observer, int32_t innovation, int32_t torque_q24);

#endif
