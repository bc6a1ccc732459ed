/* Derivatives of shaft and DC link, the same whatever the magnetics of the phases. Inline, as in integrator.c the
 * setting's members are constants of the loop. */
#ifndef PLANT_INTEGRATOR_SHAFT_H
#define PLANT_INTEGRATOR_SHAFT_H

#include "plant/integrator.h"
#include "plant/magnetics_kernel.h"

/* Sets the derivatives of the speed from torque_Nm and torque_Nm_s of the derivative. */
MAGNETICS_INLINE void integrator_shaft(const integrator_setting_t *setting, double speed_rad_s,
                                       integrator_derivative_t *derivative) {
    const double friction_Nm_s = setting->friction_Nm_s, inverse_inertia = 1.0 / setting->inertia_kg_m2;
    derivative->acceleration_rad_s2 =
        setting->held
            ? setting->held_acceleration_rad_s2
            : (derivative->torque_Nm - friction_Nm_s * speed_rad_s - setting->load_torque_Nm) * inverse_inertia;
    derivative->jerk_rad_s3 =
        setting->held ? 0.0
                      : (derivative->torque_Nm_s - friction_Nm_s * derivative->acceleration_rad_s2) * inverse_inertia;
}

/* Current that phases draw from the DC link, its first derivative at a constant voltage of the link, and its derivative
 * by that voltage, where some have shorted turns or eddy currents; link_A stays the current at the present voltage less
 * the conductance times that voltage. */
static inline void integrator_terminal_currents(const integrator_setting_t *setting, const integrator_state_t *state,
                                                const integrator_derivative_t *derivative, double *link_A,
                                                double *link_A_s, double *conductance_S) {
    *link_A = *link_A_s = *conductance_S = 0.0;
    for (unsigned index = 0; index < setting->count; index++) {
        const double by_current =
            setting->terminal_gain[index] - setting->terminal_S[index] * setting->resistance_ohm[index];
        const double sign = setting->terminal_sign[index];
        *link_A += sign * (by_current * state->current_A[index] - setting->terminal_S[index] * setting->drop_V[index]);
        *link_A_s += sign * by_current * derivative->current_A_s[index];
        *conductance_S += sign * setting->terminal_S[index] * setting->link_sign[index];
    }
}

/* Sets the derivatives of the DC-link voltage; link_A and link_A_s: current that the phases draw. */
MAGNETICS_INLINE void integrator_link(const integrator_setting_t *setting, const integrator_state_t *state,
                                      double link_A, double link_A_s, integrator_derivative_t *derivative) {
    const dc_link_t *dc_link = &setting->machine->dc_link;
    double conductance_S = 0.0;
    if (setting->shorted) {
        integrator_terminal_currents(setting, state, derivative, &link_A, &link_A_s, &conductance_S);
    }
    if (setting->source_conducts) {
        const double source_S = 1.0 / dc_link->source_resistance_ohm;
        conductance_S += source_S;
        link_A -= setting->supply_voltage_V * source_S;
    }
    if (setting->chopper_on) {
        conductance_S += 1.0 / dc_link->chopper_resistance_ohm;
    }
    derivative->link_V_s = -(conductance_S * state->bus_voltage_V + link_A) / dc_link->capacitance_F;
    derivative->link_V_s2 = -(conductance_S * derivative->link_V_s + link_A_s) / dc_link->capacitance_F;
}

#endif
