/* One step of the plant's differential equations (plant.h) with constant switch states.
 *
 * Method: the explicit two-derivative Runge-Kutta method of fourth order with two stages (R. P. K. Chan, A. Y. J. Tsai,
 * "On explicit two-derivative Runge-Kutta methods", Numerical Algorithms 53, 2010), y' = f, y'' = g:
 *
 *   Y = y + h/2 f(y) + h^2/8 g(y),   y(t + h) = y + h f(y) + h^2/6 (g(y) + 2 g(Y))
 *
 * The second derivatives follow from the magnetics' derivatives. A step evaluates the magnetics, which dominate its
 * execution time, twice instead of four times as the classical method does. Energies are integrated by the same method.
 *
 * All states step together: with faults and where a comparator responds (common_steps.h). phase_steps.h has the other
 * way to step, and the reason for two.
 */
#ifndef PLANT_INTEGRATOR_H
#define PLANT_INTEGRATOR_H

#include <stdbool.h>

#include "hal.h"
#include "plant/machine.h"
#include "plant/magnetics.h"
#include "plant/plant_state.h"

/* Constants of a step. Arrays are indexed by conducting phase, 0..count - 1. */
typedef struct {
    const machine_t *machine;
    const magnetics_model_t *magnetics;
    double inertia_kg_m2, friction_Nm_s;
    double load_torque_Nm, supply_voltage_V;
    double trip_current_A; /* of the comparators; INFINITY: none */
    bool held;             /* the acceleration is imposed */
    double held_acceleration_rad_s2;
    double ahead_rad; /* small angle in the direction of motion, see magnetics_kernel_trapezoid */
    bool link;        /* the DC link has a capacitor: its voltage is a state */
    bool source_conducts, chopper_on;
    bool chopper; /* there is one that works */
    unsigned count;
    unsigned phase[HAL_PHASES_MAX];
    bool driven[HAL_PHASES_MAX]; /* by a positive voltage: the current cannot reach zero */
    double angle_offset_rad[HAL_PHASES_MAX];
    double link_sign[HAL_PHASES_MAX];      /* +1 both switches on, 0 one, -1 none */
    double drop_V[HAL_PHASES_MAX];         /* of the two devices that carry the current */
    double resistance_ohm[HAL_PHASES_MAX]; /* of winding and devices */
    /* See coupled.h: */
    const coupled_t *coupled; /* NULL: the phases' magnetics are independent and equal */
    unsigned open_count;      /* phases without current that a voltage might make conduct, their voltages as above */
    unsigned open[HAL_PHASES_MAX];
    double open_sign[HAL_PHASES_MAX], open_drop_V[HAL_PHASES_MAX];
    /* See faulted.h: */
    bool shorted;         /* a phase has shorted turns or eddy currents: currents of the link by terminal_* */
    bool stuck;           /* friction holds the shaft; the next step may be another setting */
    double friction_sign; /* of the motion that Coulomb or static friction will stop; 0: none */
    double terminal_sign[HAL_PHASES_MAX], terminal_gain[HAL_PHASES_MAX], terminal_S[HAL_PHASES_MAX];
    double turns[HAL_PHASES_MAX]; /* shorted fraction */
    bool loop[HAL_PHASES_MAX];    /* shorted turns or eddy currents */
    bool isolated[HAL_PHASES_MAX];
    plant_path_t path[HAL_PHASES_MAX]; /* while current flows at the terminals */
} integrator_setting_t;

typedef struct {
    double angle_rad, speed_rad_s, bus_voltage_V;
    double current_A[HAL_PHASES_MAX];
} integrator_state_t;

/* First and second time derivatives; the first of the angle is the speed of the state. */
typedef struct {
    double acceleration_rad_s2, jerk_rad_s3;
    double torque_Nm, torque_Nm_s; /* of the machine: itself and its first derivative */
    double link_V_s, link_V_s2;
    double current_A_s[HAL_PHASES_MAX], current_A_s2[HAL_PHASES_MAX];
} integrator_derivative_t;

/* Integrals over a step, for the energy balance. */
typedef struct {
    double angle_rad;                    /* speed */
    double speed2_rad2_s;                /* speed^2 */
    double mechanical_J;                 /* torque of the machine times speed; only of a held shaft */
    double charge_As[HAL_PHASES_MAX];    /* current */
    double current2_A2s[HAL_PHASES_MAX]; /* current^2 */
    /* Only with a capacitor: */
    double link_J[HAL_PHASES_MAX]; /* DC-link voltage times current */
    double link_Vs, link2_V2s;     /* DC-link voltage, and its square */
} integrator_integrals_t;

/* Computes the derivatives at a state. */
void integrator_differentiate(const integrator_setting_t *setting, const integrator_state_t *state,
                              integrator_derivative_t *derivative);

/* Integrates over step_s from `start`, whose derivatives are `first`. */
void integrator_step(const integrator_setting_t *setting, const integrator_state_t *start,
                     const integrator_derivative_t *first, double step_s, integrator_state_t *end,
                     integrator_integrals_t *integrals);

#endif
