#include "plant/coupled.h"

#include <math.h>
#include <string.h>

#include "plant/integrator_shaft.h"
#include "plant/units.h"

/* A step ends where a magnetomotive force changes its sign, but within this time: the second derivative of the
 * magnetics jumps there. */
#define REVERSAL_LEAST_S 1e-9

_Static_assert(MACHINE_PHASES_MAX == HAL_PHASES_MAX, "phases");

/* Longest step of an open winding's eddy currents, in their time constant at the least inductance: they are small, and
 * without current the iron is not saturated. */
#define LOOP_TIME_CONSTANTS 0.3

void coupled_prepare(coupled_t *coupled, const machine_t *machine, double pitch_rad) {
    const circuit_t *circuit = &machine->circuit;
    memset(coupled, 0, sizeof *coupled);
    coupled->phases = machine->phases;
    coupled->eddy_S = circuit->eddy_conductance_S;
    coupled->present = coupled->eddy_S > 0.0;
    for (unsigned phase = 0; phase < machine->phases; phase++) {
        const unsigned next = (phase + 1) % machine->phases;
        coupled->share[phase][phase] = 1.0;
        coupled->share[phase][next] = coupled->share[next][phase] = circuit->coupling[phase];
        coupled->gain[phase] = 1.0 + circuit->flux_deviation[phase];
        coupled->offset_rad[phase] =
            phase * (pitch_rad / machine->phases) + circuit->angle_deviation_deg[phase] * PI / 180.0;
        coupled->mutual |= circuit->coupling[phase] != 0.0;
        coupled->present |=
            coupled->mutual || circuit->flux_deviation[phase] != 0.0 || circuit->angle_deviation_deg[phase] != 0.0;
    }
}

double coupled_mmf_A(const coupled_t *coupled, const double current_A[HAL_PHASES_MAX], unsigned phase) {
    double mmf_A = 0.0;
    for (unsigned from = 0; from < coupled->phases; from++) {
        mmf_A += coupled->share[phase][from] * current_A[from];
    }
    return mmf_A;
}

void coupled_evaluate(const magnetics_model_t *model, const coupled_t *coupled, double rotor_angle_rad, unsigned phase,
                      double mmf_A, double ahead_rad, magnetics_point_t *point) {
    magnetics_kernel(model, model->form, rotor_angle_rad - coupled->offset_rad[phase], fabs(mmf_A), ahead_rad, point);
    const double even = coupled->gain[phase], odd = copysign(even, mmf_A);
    point->flux_linkage_Wb *= odd;
    point->incremental_inductance_H *= even;
    point->flux_gradient_Wb_rad *= odd;
    point->torque_Nm *= even;
    point->inductance_slope_H_A *= odd;
    point->inductance_gradient_H_rad *= even;
    point->flux_curvature_Wb_rad2 *= odd;
    point->torque_gradient_Nm_rad *= even;
}

double coupled_loop_step_s(const plant_t *plant, const integrator_setting_t *setting) {
    for (unsigned index = 0; plant->coupled.eddy_S > 0.0 && index < setting->count; index++) {
        if (setting->isolated[index]) {
            return plant->limits.factor * LOOP_TIME_CONSTANTS * plant->coupled.eddy_S *
                   plant->magnetics.unaligned_inductance_H;
        }
    }
    return INFINITY;
}

double coupled_reversal_s(const plant_t *plant, const integrator_setting_t *setting,
                          const integrator_derivative_t *first) {
    const coupled_t *coupled = &plant->coupled;
    double nearest_s = INFINITY;
    for (unsigned pole = 0; coupled->mutual && pole < coupled->phases; pole++) {
        double mmf_A = 0.0, rate_A_s = 0.0, bend_A_s2 = 0.0;
        for (unsigned index = 0; index < setting->count; index++) {
            const double share = coupled->share[pole][setting->phase[index]];
            mmf_A += share * plant->current_A[setting->phase[index]];
            rate_A_s += share * first->current_A_s[index];
            bend_A_s2 += share * first->current_A_s2[index];
        }
        if (mmf_A * rate_A_s < 0.0) {
            double at_s = -mmf_A / rate_A_s;
            const double end_A_s = rate_A_s + bend_A_s2 * at_s;
            if (end_A_s * rate_A_s > 0.0) {
                at_s -= 0.5 * bend_A_s2 * at_s * at_s / end_A_s;
            }
            if (at_s > REVERSAL_LEAST_S) {
                nearest_s = fmin(nearest_s, at_s);
            }
        }
    }
    return nearest_s;
}

/* Solves matrix x = x, which is symmetric and positive definite, by Gauss's elimination. */
static void solve(double matrix[HAL_PHASES_MAX][HAL_PHASES_MAX], unsigned count, double x[HAL_PHASES_MAX]) {
    for (unsigned pivot = 0; pivot < count; pivot++) {
        for (unsigned row = pivot + 1; row < count; row++) {
            const double factor = matrix[row][pivot] / matrix[pivot][pivot];
            for (unsigned column = pivot + 1; column < count; column++) {
                matrix[row][column] -= factor * matrix[pivot][column];
            }
            x[row] -= factor * x[pivot];
        }
    }
    for (unsigned row = count; row-- > 0;) {
        for (unsigned column = row + 1; column < count; column++) {
            x[row] -= matrix[row][column] * x[column];
        }
        x[row] /= matrix[row][row];
    }
}

/* The poles at a state, and their shares of the conducting phases' currents. */
typedef struct {
    unsigned poles, count;
    double share[HAL_PHASES_MAX][HAL_PHASES_MAX]; /* [pole][conducting phase] */
    magnetics_point_t point[HAL_PHASES_MAX];
} poles_t;

static void find_poles(const integrator_setting_t *setting, const integrator_state_t *state, poles_t *poles) {
    const coupled_t *coupled = setting->coupled;
    poles->poles = coupled->phases;
    poles->count = setting->count;
    for (unsigned pole = 0; pole < poles->poles; pole++) {
        double mmf_A = 0.0;
        for (unsigned index = 0; index < poles->count; index++) {
            poles->share[pole][index] = coupled->share[pole][setting->phase[index]];
            mmf_A += poles->share[pole][index] * state->current_A[index];
        }
        coupled_evaluate(setting->magnetics, coupled, state->angle_rad, pole, mmf_A, setting->ahead_rad,
                         &poles->point[pole]);
    }
}

/* Rates of the currents at which the flux rates of the windings are `volts`, of which the poles' `other` flux rates
 * are one part. */
static void solve_rates(const poles_t *poles, const double other_V[HAL_PHASES_MAX], double volts[HAL_PHASES_MAX]) {
    double inductance_H[HAL_PHASES_MAX][HAL_PHASES_MAX] = {{0.0}};
    for (unsigned pole = 0; pole < poles->poles; pole++) {
        const double pole_H = poles->point[pole].incremental_inductance_H;
        for (unsigned row = 0; row < poles->count; row++) {
            const double by_row_H = poles->share[pole][row] * pole_H;
            volts[row] -= poles->share[pole][row] * other_V[pole];
            for (unsigned column = 0; column < poles->count; column++) {
                inductance_H[row][column] += by_row_H * poles->share[pole][column];
            }
        }
    }
    solve(inductance_H, poles->count, volts);
}

static double mmf_rate_A_s(const poles_t *poles, const double rate[HAL_PHASES_MAX], unsigned pole) {
    double sum = 0.0;
    for (unsigned index = 0; index < poles->count; index++) {
        sum += poles->share[pole][index] * rate[index];
    }
    return sum;
}

void coupled_differentiate(const integrator_setting_t *setting, const integrator_state_t *state,
                           integrator_derivative_t *derivative) {
    const unsigned count = setting->count;
    const double speed_rad_s = state->speed_rad_s;
    poles_t poles;
    find_poles(setting, state, &poles);
    double other_V[HAL_PHASES_MAX] = {0.0}, rate_A_s[HAL_PHASES_MAX];
    for (unsigned index = 0; index < count; index++) {
        derivative->current_A_s[index] = setting->link_sign[index] * state->bus_voltage_V - setting->drop_V[index] -
                                         setting->resistance_ohm[index] * state->current_A[index];
    }
    for (unsigned pole = 0; pole < poles.poles; pole++) {
        other_V[pole] = speed_rad_s * poles.point[pole].flux_gradient_Wb_rad;
    }
    solve_rates(&poles, other_V, derivative->current_A_s);

    double link_A = 0.0, link_A_s = 0.0;
    derivative->torque_Nm = derivative->torque_Nm_s = 0.0;
    for (unsigned pole = 0; pole < poles.poles; pole++) {
        const magnetics_point_t *point = &poles.point[pole];
        rate_A_s[pole] = mmf_rate_A_s(&poles, derivative->current_A_s, pole);
        derivative->torque_Nm += point->torque_Nm;
        derivative->torque_Nm_s +=
            point->torque_gradient_Nm_rad * speed_rad_s + point->flux_gradient_Wb_rad * rate_A_s[pole];
    }
    for (unsigned index = 0; index < count; index++) {
        link_A += setting->link_sign[index] * state->current_A[index];
        link_A_s += setting->link_sign[index] * derivative->current_A_s[index];
    }
    integrator_shaft(setting, speed_rad_s, derivative);
    derivative->link_V_s = derivative->link_V_s2 = 0.0;
    if (setting->link) {
        integrator_link(setting, state, link_A, link_A_s, derivative);
    }

    for (unsigned pole = 0; pole < poles.poles; pole++) {
        const magnetics_point_t *point = &poles.point[pole];
        const double motional_V_s = derivative->acceleration_rad_s2 * point->flux_gradient_Wb_rad +
                                    speed_rad_s * (speed_rad_s * point->flux_curvature_Wb_rad2);
        const double inductance_H_s =
            2.0 * (speed_rad_s * point->inductance_gradient_H_rad) + point->inductance_slope_H_A * rate_A_s[pole];
        other_V[pole] = motional_V_s + inductance_H_s * rate_A_s[pole];
    }
    for (unsigned index = 0; index < count; index++) {
        derivative->current_A_s2[index] = setting->link_sign[index] * derivative->link_V_s -
                                          setting->resistance_ohm[index] * derivative->current_A_s[index];
    }
    solve_rates(&poles, other_V, derivative->current_A_s2);
}

double coupled_blocking_V(const integrator_setting_t *setting, const integrator_state_t *state,
                          const integrator_derivative_t *derivative, unsigned index) {
    poles_t poles;
    find_poles(setting, state, &poles);
    double induced_V = 0.0;
    for (unsigned pole = 0; pole < poles.poles; pole++) {
        const magnetics_point_t *point = &poles.point[pole];
        const double pole_V = state->speed_rad_s * point->flux_gradient_Wb_rad +
                              point->incremental_inductance_H * mmf_rate_A_s(&poles, derivative->current_A_s, pole);
        induced_V += setting->coupled->share[pole][setting->open[index]] * pole_V;
    }
    return induced_V - (setting->open_sign[index] * state->bus_voltage_V - setting->open_drop_V[index]);
}
