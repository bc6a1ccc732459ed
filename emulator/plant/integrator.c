#include "plant/integrator.h"

#include <stddef.h>

#include "plant/coupled.h"
#include "plant/integrator_shaft.h"
#include "plant/magnetics_kernel.h"

/* The functions ending in _of are inlined for each form of the magnetics and for one and two conducting phases, so that
 * the compiler removes the other forms and unrolls the loops. `form`, `link` and `count` are the setting's. */

MAGNETICS_INLINE void differentiate_of(const integrator_setting_t *setting, magnetics_form_t form, bool link,
                                       unsigned count, const integrator_state_t *state,
                                       integrator_derivative_t *derivative) {
    const double speed_rad_s = state->speed_rad_s;
    magnetics_point_t points[HAL_PHASES_MAX];
    double inverse_inductance_1_H[HAL_PHASES_MAX];
    double torque_Nm = 0.0, torque_Nm_s = 0.0, link_A = 0.0, link_A_s = 0.0;
    for (unsigned index = 0; index < count; index++) {
        magnetics_point_t *point = &points[index];
        magnetics_kernel(setting->magnetics, form, state->angle_rad - setting->angle_offset_rad[index],
                         state->current_A[index], setting->ahead_rad, point);
        inverse_inductance_1_H[index] = 1.0 / point->incremental_inductance_H;
        const double voltage_V = setting->link_sign[index] * state->bus_voltage_V - setting->drop_V[index];
        const double current_A_s = (voltage_V - setting->resistance_ohm[index] * state->current_A[index] -
                                    speed_rad_s * point->flux_gradient_Wb_rad) *
                                   inverse_inductance_1_H[index];
        derivative->current_A_s[index] = current_A_s;
        torque_Nm += point->torque_Nm;
        torque_Nm_s += point->torque_gradient_Nm_rad * speed_rad_s + point->flux_gradient_Wb_rad * current_A_s;
        if (link) {
            link_A += setting->link_sign[index] * state->current_A[index];
            link_A_s += setting->link_sign[index] * current_A_s;
        }
    }
    derivative->torque_Nm = torque_Nm;
    derivative->torque_Nm_s = torque_Nm_s;
    integrator_shaft(setting, speed_rad_s, derivative);
    const double acceleration_rad_s2 = derivative->acceleration_rad_s2;
    derivative->link_V_s = 0.0;
    derivative->link_V_s2 = 0.0;
    if (link) {
        integrator_link(setting, state, link_A, link_A_s, derivative);
    }
    for (unsigned index = 0; index < count; index++) {
        const magnetics_point_t *point = &points[index];
        const double current_A_s = derivative->current_A_s[index];
        double voltage_V_s = -setting->resistance_ohm[index] * current_A_s;
        if (link) {
            voltage_V_s += setting->link_sign[index] * derivative->link_V_s;
        }
        const double motional_V_s = acceleration_rad_s2 * point->flux_gradient_Wb_rad +
                                    speed_rad_s * (speed_rad_s * point->flux_curvature_Wb_rad2);
        const double inductance_H_s =
            2.0 * (speed_rad_s * point->inductance_gradient_H_rad) + point->inductance_slope_H_A * current_A_s;
        derivative->current_A_s2[index] =
            (voltage_V_s - motional_V_s - inductance_H_s * current_A_s) * inverse_inductance_1_H[index];
    }
}

MAGNETICS_INLINE void step_of(const integrator_setting_t *setting, magnetics_form_t form, bool coupled, bool link,
                              unsigned count, const integrator_state_t *start, const integrator_derivative_t *first,
                              double step_s, integrator_state_t *end, integrator_integrals_t *integrals) {
    integrator_state_t middle;
    integrator_derivative_t second;
    const double half_s = 0.5 * step_s, eighth_s2 = 0.125 * step_s * step_s, sixth_s2 = step_s * step_s * (1.0 / 6.0);
    middle.angle_rad = start->angle_rad + half_s * start->speed_rad_s + eighth_s2 * first->acceleration_rad_s2;
    middle.speed_rad_s = start->speed_rad_s + half_s * first->acceleration_rad_s2 + eighth_s2 * first->jerk_rad_s3;
    middle.bus_voltage_V = start->bus_voltage_V;
    if (link) {
        middle.bus_voltage_V += half_s * first->link_V_s + eighth_s2 * first->link_V_s2;
    }
    for (unsigned index = 0; index < count; index++) {
        middle.current_A[index] =
            start->current_A[index] + half_s * first->current_A_s[index] + eighth_s2 * first->current_A_s2[index];
    }
    if (coupled) {
        coupled_differentiate(setting, &middle, &second);
    } else {
        differentiate_of(setting, form, link, count, &middle, &second);
    }

    integrals->angle_rad =
        step_s * start->speed_rad_s + sixth_s2 * (first->acceleration_rad_s2 + 2.0 * second.acceleration_rad_s2);
    integrals->speed2_rad2_s = step_s * start->speed_rad_s * start->speed_rad_s +
                               sixth_s2 * (2.0 * start->speed_rad_s * first->acceleration_rad_s2 +
                                           4.0 * middle.speed_rad_s * second.acceleration_rad_s2);
    if (setting->held) {
        const double start_W_s =
            first->torque_Nm_s * start->speed_rad_s + first->torque_Nm * first->acceleration_rad_s2;
        const double middle_W_s =
            second.torque_Nm_s * middle.speed_rad_s + second.torque_Nm * second.acceleration_rad_s2;
        integrals->mechanical_J =
            step_s * first->torque_Nm * start->speed_rad_s + sixth_s2 * (start_W_s + 2.0 * middle_W_s);
    }
    end->angle_rad = start->angle_rad + integrals->angle_rad;
    end->speed_rad_s = start->speed_rad_s + step_s * first->acceleration_rad_s2 +
                       sixth_s2 * (first->jerk_rad_s3 + 2.0 * second.jerk_rad_s3);
    end->bus_voltage_V = start->bus_voltage_V;
    if (link) {
        const double start_V = start->bus_voltage_V, middle_V = middle.bus_voltage_V;
        end->bus_voltage_V += step_s * first->link_V_s + sixth_s2 * (first->link_V_s2 + 2.0 * second.link_V_s2);
        integrals->link_Vs = step_s * start_V + sixth_s2 * (first->link_V_s + 2.0 * second.link_V_s);
        integrals->link2_V2s = step_s * start_V * start_V +
                               sixth_s2 * (2.0 * start_V * first->link_V_s + 4.0 * middle_V * second.link_V_s);
    }
    for (unsigned index = 0; index < count; index++) {
        const double start_A = start->current_A[index], middle_A = middle.current_A[index];
        const double start_A_s = first->current_A_s[index], middle_A_s = second.current_A_s[index];
        integrals->charge_As[index] = step_s * start_A + sixth_s2 * (start_A_s + 2.0 * middle_A_s);
        integrals->current2_A2s[index] =
            step_s * start_A * start_A + sixth_s2 * (2.0 * start_A * start_A_s + 4.0 * middle_A * middle_A_s);
        end->current_A[index] =
            start_A + step_s * start_A_s + sixth_s2 * (first->current_A_s2[index] + 2.0 * second.current_A_s2[index]);
        if (link) {
            integrals->link_J[index] =
                step_s * start->bus_voltage_V * start_A +
                sixth_s2 * ((first->link_V_s * start_A + start->bus_voltage_V * start_A_s) +
                            2.0 * (second.link_V_s * middle_A + middle.bus_voltage_V * middle_A_s));
        }
    }
}

MAGNETICS_INLINE void differentiate_in(const integrator_setting_t *setting, magnetics_form_t form,
                                       const integrator_state_t *state, integrator_derivative_t *derivative) {
    if (setting->link) {
        differentiate_of(setting, form, true, setting->count, state, derivative);
    } else if (setting->count == 1) {
        differentiate_of(setting, form, false, 1, state, derivative);
    } else if (setting->count == 2) {
        differentiate_of(setting, form, false, 2, state, derivative);
    } else {
        differentiate_of(setting, form, false, setting->count, state, derivative);
    }
}

MAGNETICS_INLINE void step_in(const integrator_setting_t *setting, magnetics_form_t form,
                              const integrator_state_t *start, const integrator_derivative_t *first, double step_s,
                              integrator_state_t *end, integrator_integrals_t *integrals) {
    if (setting->link) {
        step_of(setting, form, false, true, setting->count, start, first, step_s, end, integrals);
    } else if (setting->count == 1) {
        step_of(setting, form, false, false, 1, start, first, step_s, end, integrals);
    } else if (setting->count == 2) {
        step_of(setting, form, false, false, 2, start, first, step_s, end, integrals);
    } else {
        step_of(setting, form, false, false, setting->count, start, first, step_s, end, integrals);
    }
}

void integrator_differentiate(const integrator_setting_t *setting, const integrator_state_t *state,
                              integrator_derivative_t *derivative) {
    if (setting->coupled != NULL) {
        coupled_differentiate(setting, state, derivative);
        return;
    }
    switch (setting->magnetics->form) {
    case MAGNETICS_LINEAR_COSINE:
        differentiate_in(setting, MAGNETICS_LINEAR_COSINE, state, derivative);
        break;
    case MAGNETICS_LINEAR_TRAPEZOID:
        differentiate_in(setting, MAGNETICS_LINEAR_TRAPEZOID, state, derivative);
        break;
    case MAGNETICS_SATURATING:
        differentiate_in(setting, MAGNETICS_SATURATING, state, derivative);
        break;
    case MAGNETICS_MAP:
        differentiate_in(setting, MAGNETICS_MAP, state, derivative);
        break;
    }
}

void integrator_step(const integrator_setting_t *setting, const integrator_state_t *start,
                     const integrator_derivative_t *first, double step_s, integrator_state_t *end,
                     integrator_integrals_t *integrals) {
    if (setting->coupled != NULL) {
        step_of(setting, setting->magnetics->form, true, setting->link, setting->count, start, first, step_s, end,
                integrals);
        return;
    }
    switch (setting->magnetics->form) {
    case MAGNETICS_LINEAR_COSINE:
        step_in(setting, MAGNETICS_LINEAR_COSINE, start, first, step_s, end, integrals);
        break;
    case MAGNETICS_LINEAR_TRAPEZOID:
        step_in(setting, MAGNETICS_LINEAR_TRAPEZOID, start, first, step_s, end, integrals);
        break;
    case MAGNETICS_SATURATING:
        step_in(setting, MAGNETICS_SATURATING, start, first, step_s, end, integrals);
        break;
    case MAGNETICS_MAP:
        step_in(setting, MAGNETICS_MAP, start, first, step_s, end, integrals);
        break;
    }
}
