#include "fmi/fmu_model.h"

#include <string.h>

/* Any period would do: switches are fully on or off over a step, without edges. */
#define PERIOD_TICKS 1

static void set_switches(fmu_model_t *model) {
    hal_pwm_compare_t compare;
    memset(&compare, 0, sizeof compare);
    for (unsigned phase = 0; phase < model->machine.phases; phase++) {
        compare.upper[phase] = model->values.upper[phase] ? PERIOD_TICKS : 0;
        compare.lower[phase] = model->values.lower[phase] ? PERIOD_TICKS : 0;
    }
    plant_set_switches(&model->plant, &compare, PERIOD_TICKS);
}

static void update_outputs(fmu_model_t *model) {
    fmu_values_t *values = &model->values;
    const plant_t *plant = &model->plant;
    values->bus_voltage_V = plant->bus_voltage_V;
    values->bus_current_A = 0.0;
    for (unsigned phase = 0; phase < model->machine.phases; phase++) {
        values->current_A[phase] = plant->current_A[phase];
        if (values->upper[phase] == values->lower[phase]) {
            values->bus_current_A += values->upper[phase] ? plant->current_A[phase] : -plant->current_A[phase];
        }
    }
    values->torque_Nm = plant_torque_Nm(plant);
    values->speed_rad_s = plant->speed_rad_s;
    values->rotor_angle_rad = plant->rotor_angle_rad;
    values->energy_drawn_J = plant->energy_drawn_J;
    values->energy_returned_J = plant->energy_returned_J;
    values->energy_copper_J = plant->energy_copper_J;
    values->energy_converter_J = plant->energy_converter_J;
}

void fmu_model_reset(fmu_model_t *model) {
    memset(model, 0, sizeof *model);
    for (size_t index = 0; index < fmu_variable_count; index++) {
        const fmu_variable_t *variable = &fmu_variables[index];
        void *member = (char *)&model->values + variable->offset;
        if (variable->type == FMU_BOOLEAN) {
            *(bool *)member = variable->start != 0.0;
        } else {
            *(double *)member = variable->start;
        }
    }
    fmu_model_restart(model);
}

void fmu_model_restart(fmu_model_t *model) {
    const fmu_values_t *values = &model->values;
    model->machine = machine_plant;
    model->machine.resistance_ohm = values->resistance_ohm;
    model->machine.inertia_kg_m2 = values->inertia_kg_m2;
    model->machine.friction_Nm_s = values->friction_Nm_s;
    model->machine.supply_voltage_V = values->supply_voltage_V; /* initial voltage of the DC link */
    plant_init(&model->plant, &model->machine, values->initial_angle_rad);
    model->plant.speed_rad_s = values->initial_speed_rad_s;
    update_outputs(model);
}

void fmu_model_advance(fmu_model_t *model, uint64_t to_ns) {
    set_switches(model);
    model->plant.load_torque_Nm = model->values.load_torque_Nm;
    plant_set_supply_voltage(&model->plant, model->values.supply_voltage_V);
    plant_advance(&model->plant, to_ns);
    update_outputs(model);
}

void fmu_model_rebind(fmu_model_t *model) {
    model->plant.machine = &model->machine;
}
