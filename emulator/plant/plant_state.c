#include "plant/plant_state.h"

#include <math.h>

double plant_current_A(const plant_t *plant, unsigned phase) {
    const double current_A = plant->current_A[phase];
    if (!plant->faulted || plant->faults.shorted_turns[phase] == 0.0) {
        return current_A;
    }
    return fmax(plant_path_terminal_A(&plant->path[phase], plant->bus_voltage_V, current_A), 0.0);
}

double plant_phase_angle_rad(const plant_t *plant, unsigned phase) {
    return plant->rotor_angle_rad - phase * plant->phase_offset_rad;
}

double plant_torque_Nm(const plant_t *plant) {
    double torque_Nm = 0.0;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        if (plant->current_A[phase] > 0.0) {
            magnetics_point_t point;
            magnetics_evaluate(&plant->magnetics, plant_phase_angle_rad(plant, phase), plant->current_A[phase], &point);
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
    magnetics_evaluate(&plant->magnetics, plant_phase_angle_rad(plant, phase), plant->current_A[phase], &point);
    return point.flux_linkage_Wb;
}

double plant_field_energy_J(const plant_t *plant) {
    double energy_J = 0.0;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        energy_J +=
            magnetics_field_energy_J(&plant->magnetics, plant_phase_angle_rad(plant, phase), plant->current_A[phase]);
    }
    return energy_J;
}

double plant_kinetic_energy_J(const plant_t *plant) {
    return 0.5 * plant->inertia_kg_m2 * plant->speed_rad_s * plant->speed_rad_s;
}

double plant_link_energy_J(const plant_t *plant) {
    return 0.5 * plant->machine->dc_link.capacitance_F * plant->bus_voltage_V * plant->bus_voltage_V;
}
