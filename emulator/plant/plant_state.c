#include "plant/plant_state.h"

#include <math.h>

#include "plant/coupled.h"

double plant_current_A(const plant_t *plant, unsigned phase) {
    const double current_A = plant->current_A[phase];
    if (!plant->faulted || !plant_has_loop(plant, phase)) {
        return current_A;
    }
    return fmax(plant_path_terminal_A(&plant->path[phase], plant->bus_voltage_V, current_A), 0.0);
}

double plant_phase_angle_rad(const plant_t *plant, unsigned phase) {
    if (plant->coupled.present) {
        return plant->rotor_angle_rad - plant->coupled.offset_rad[phase];
    }
    return plant->rotor_angle_rad - phase * plant->phase_offset_rad;
}

/* Magnetics of the poles of a phase; without coupling, of the phase. */
static void evaluate(const plant_t *plant, unsigned phase, magnetics_point_t *point) {
    if (plant->coupled.present) {
        const double mmf_A = coupled_mmf_A(&plant->coupled, plant->current_A, phase);
        coupled_evaluate(&plant->magnetics, &plant->coupled, plant->rotor_angle_rad, phase, mmf_A, 0.0, point);
    } else {
        magnetics_evaluate(&plant->magnetics, plant_phase_angle_rad(plant, phase), plant->current_A[phase], point);
    }
}

double plant_torque_Nm(const plant_t *plant) {
    double torque_Nm = 0.0;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        if (plant->current_A[phase] > 0.0 || plant->coupled.present) {
            magnetics_point_t point;
            evaluate(plant, phase, &point);
            torque_Nm += point.torque_Nm;
        }
    }
    return torque_Nm;
}

double plant_shaft_torque_Nm(const plant_t *plant) {
    if (!plant->held) {
        return plant->load_torque_Nm;
    }
    return plant_torque_Nm(plant) - plant->friction_Nm_s * plant->speed_rad_s -
           plant->inertia_kg_m2 * plant->held_acceleration_rad_s2;
}

double plant_flux_linkage_Wb(const plant_t *plant, unsigned phase) {
    magnetics_point_t point;
    if (!plant->coupled.present) {
        evaluate(plant, phase, &point);
        return point.flux_linkage_Wb;
    }
    double flux_Wb = 0.0;
    for (unsigned pole = 0; pole < plant->machine->phases; pole++) {
        evaluate(plant, pole, &point);
        flux_Wb += plant->coupled.share[pole][phase] * point.flux_linkage_Wb;
    }
    return flux_Wb;
}

double plant_field_energy_J(const plant_t *plant) {
    double energy_J = 0.0;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        double current_A = plant->current_A[phase], gain = 1.0;
        if (plant->coupled.present) {
            current_A = fabs(coupled_mmf_A(&plant->coupled, plant->current_A, phase));
            gain = plant->coupled.gain[phase];
        }
        energy_J += gain * magnetics_field_energy_J(&plant->magnetics, plant_phase_angle_rad(plant, phase), current_A);
    }
    return energy_J;
}

double plant_kinetic_energy_J(const plant_t *plant) {
    return 0.5 * plant->inertia_kg_m2 * plant->speed_rad_s * plant->speed_rad_s;
}

double plant_link_energy_J(const plant_t *plant) {
    return 0.5 * plant->machine->dc_link.capacitance_F * plant->bus_voltage_V * plant->bus_voltage_V;
}
