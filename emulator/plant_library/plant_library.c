/* Plant for callers without the layout of plant_t, such as ctypes in Python: only in libsalient_plant.so. Complements
 * plant_set_switches, plant_open_all, plant_advance, plant_observe, plant_set_step_factor, plant_set_faults and
 * plant_lock, which have plain arguments, to the whole interface of plant.h. */
#include <stdlib.h>
#include <string.h>

#include "plant/plant.h"

/* Output of plant_library_read. */
typedef struct {
    double time_s;
    double speed_rad_s;
    double rotor_angle_rad;
    double torque_Nm;
    double current_A[HAL_PHASES_MAX];
    double flux_linkage_Wb[HAL_PHASES_MAX];
    double energy_drawn_J, energy_returned_J, energy_copper_J, energy_load_J, energy_friction_J;
    double field_energy_J, kinetic_energy_J;
    double bus_voltage_V;
    double energy_converter_J, energy_supplied_J, energy_source_J, energy_chopper_J;
    double link_energy_J;
    double energy_fault_J;
    double energy_iron_J;
} plant_library_state_t;

plant_t *plant_library_create(const machine_t *machine, double initial_angle_rad);
void plant_library_destroy(plant_t *plant);
void plant_library_set_inputs(plant_t *plant, double load_torque_Nm, double supply_voltage_V);
void plant_library_set_motion(plant_t *plant, double speed_rad_s, double rotor_angle_rad);
void plant_library_set_current(plant_t *plant, unsigned phase, double current_A);
void plant_library_read(const plant_t *plant, plant_library_state_t *state);
void plant_library_evaluate(const machine_t *machine, double phase_angle_rad, double current_A,
                            magnetics_point_t *point);

/* Creates a plant by plant_init; plant_library_destroy frees it. `machine` must outlive it. NULL when out of memory. */
plant_t *plant_library_create(const machine_t *machine, double initial_angle_rad) {
    plant_t *plant = malloc(sizeof *plant);
    if (plant != NULL) {
        plant_init(plant, machine, initial_angle_rad);
    }
    return plant;
}

void plant_library_destroy(plant_t *plant) {
    free(plant);
}

void plant_library_set_inputs(plant_t *plant, double load_torque_Nm, double supply_voltage_V) {
    plant->load_torque_Nm = load_torque_Nm;
    plant_set_supply_voltage(plant, supply_voltage_V);
}

/* Sets angle and speed of the rotor as initial values: not part of the energy balance, so call it before the first
 * advance. */
void plant_library_set_motion(plant_t *plant, double speed_rad_s, double rotor_angle_rad) {
    plant->speed_rad_s = speed_rad_s;
    plant->rotor_angle_rad = rotor_angle_rad;
}

/* Sets the current (>= 0) of a phase as an initial value; not part of the energy balance either. */
void plant_library_set_current(plant_t *plant, unsigned phase, double current_A) {
    plant->current_A[phase] = current_A;
}

void plant_library_read(const plant_t *plant, plant_library_state_t *state) {
    memset(state, 0, sizeof *state);
    state->time_s = (double)plant->time_ns * 1e-9;
    state->speed_rad_s = plant->speed_rad_s;
    state->rotor_angle_rad = plant->rotor_angle_rad;
    state->torque_Nm = plant_torque_Nm(plant);
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        state->current_A[phase] = plant_current_A(plant, phase);
        state->flux_linkage_Wb[phase] = plant_flux_linkage_Wb(plant, phase);
    }
    state->energy_drawn_J = plant->energy_drawn_J;
    state->energy_returned_J = plant->energy_returned_J;
    state->energy_copper_J = plant->energy_copper_J;
    state->energy_load_J = plant->energy_load_J;
    state->energy_friction_J = plant->energy_friction_J;
    state->field_energy_J = plant_field_energy_J(plant);
    state->kinetic_energy_J = plant_kinetic_energy_J(plant);
    state->bus_voltage_V = plant->bus_voltage_V;
    state->energy_converter_J = plant->energy_converter_J;
    state->energy_supplied_J = plant->energy_supplied_J;
    state->energy_source_J = plant->energy_source_J;
    state->energy_chopper_J = plant->energy_chopper_J;
    state->link_energy_J = plant_link_energy_J(plant);
    state->energy_fault_J = plant->energy_fault_J;
    state->energy_iron_J = plant->energy_iron_J;
}

/* magnetics_evaluate for a machine. */
void plant_library_evaluate(const machine_t *machine, double phase_angle_rad, double current_A,
                            magnetics_point_t *point) {
    magnetics_model_t model;
    magnetics_prepare(&model, &machine->magnetics, machine->rotor_poles);
    magnetics_evaluate(&model, phase_angle_rad, current_A, point);
}
