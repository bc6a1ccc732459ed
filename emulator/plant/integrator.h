/* One step of the plant's differential equations with the switches as they are (equations: plant.h).
 *
 * Method: the explicit two-derivative Runge-Kutta method of fourth order with two stages (R. P. K. Chan, A. Y. J. Tsai,
 * "On explicit two-derivative Runge-Kutta methods", Numerical Algorithms 53, 2010), y' = f, y'' = g:
 *
 *   Y = y + h/2 f(y) + h^2/8 g(y),   y(t + h) = y + h f(y) + h^2/6 (g(y) + 2 g(Y))
 *
 * Its second derivatives come from the magnetics' own, so that a step costs two evaluations of them instead of the
 * classical method's four, and they are what a step costs. Energies are integrated by the same method.
 */
#ifndef PLANT_INTEGRATOR_H
#define PLANT_INTEGRATOR_H

#include <stdbool.h>

#include "hal.h"
#include "plant/machine.h"
#include "plant/magnetics.h"

/* What stays the same during a step. Arrays: by index of the conducting phases. */
typedef struct {
    const machine_t *machine;
    const magnetics_model_t *magnetics;
    double inertia_kg_m2, friction_Nm_s;
    double load_torque_Nm, supply_voltage_V;
    double ahead_rad; /* a little angle in the direction of motion, see magnetics_kernel_trapezoid */
    bool link;        /* there is a capacitor: the bus voltage is a state */
    bool source_conducts, chopper_on;
    unsigned count;
    unsigned phase[HAL_PHASES_MAX];
    bool driven[HAL_PHASES_MAX]; /* by a positive voltage, so that the current cannot end */
    double angle_offset_rad[HAL_PHASES_MAX];
    double link_sign[HAL_PHASES_MAX];      /* +1 both switches on, 0 one, -1 none */
    double drop_V[HAL_PHASES_MAX];         /* of the two devices that carry the current */
    double resistance_ohm[HAL_PHASES_MAX]; /* of winding and devices */
} integrator_setting_t;

typedef struct {
    double angle_rad, speed_rad_s, bus_voltage_V;
    double current_A[HAL_PHASES_MAX];
} integrator_state_t;

/* First and second derivative by the time; that of the angle is the state's speed. */
typedef struct {
    double acceleration_rad_s2, jerk_rad_s3;
    double bus_V_s, bus_V_s2;
    double current_A_s[HAL_PHASES_MAX], current_A_s2[HAL_PHASES_MAX];
} integrator_derivative_t;

/* Integrals over a step, for the energy ledger. */
typedef struct {
    double angle_rad;                    /* of the speed */
    double speed2_rad2_s;                /* of its square */
    double charge_As[HAL_PHASES_MAX];    /* of the currents */
    double current2_A2s[HAL_PHASES_MAX]; /* of their squares */
    /* Only with a link: */
    double link_J[HAL_PHASES_MAX]; /* of bus voltage times current */
    double bus_Vs, bus2_V2s;       /* of the bus voltage and its square */
} integrator_integrals_t;

/* Derivatives at a state. */
void integrator_differentiate(const integrator_setting_t *setting, const integrator_state_t *state,
                              integrator_derivative_t *derivative);

/* From `start`, whose derivatives `first` are, over step_s. */
void integrator_step(const integrator_setting_t *setting, const integrator_state_t *start,
                     const integrator_derivative_t *first, double step_s, integrator_state_t *end,
                     integrator_integrals_t *integrals);

#endif
