/* Plant with the variables of a functional mock-up unit: inputs, outputs and steps. Independent of FMI. */
#ifndef FMI_FMU_MODEL_H
#define FMI_FMU_MODEL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "hal.h"
#include "plant/plant.h"

/* One member for each variable; tools/src/salient/generate/fmu.py defines their meaning, limits and start values. */
typedef struct {
    double time_s;

    /* Inputs, constant over a step. */
    bool upper[HAL_PHASES_MAX], lower[HAL_PHASES_MAX];
    double load_torque_Nm, supply_voltage_V;

    /* Parameters, fixed after initialisation. */
    double initial_angle_rad, initial_speed_rad_s;
    double resistance_ohm, inertia_kg_m2, friction_Nm_s;

    /* Outputs, at the end of the last step. */
    double current_A[HAL_PHASES_MAX];
    double torque_Nm, speed_rad_s, rotor_angle_rad;
    double bus_voltage_V, bus_current_A;
    double energy_drawn_J, energy_returned_J, energy_copper_J, energy_converter_J;
} fmu_values_t;

typedef enum { FMU_FLOAT64, FMU_BOOLEAN } fmu_type_t;
typedef enum { FMU_INDEPENDENT, FMU_INPUT, FMU_PARAMETER, FMU_OUTPUT } fmu_causality_t;

/* Variable; its value reference is its index in fmu_variables. */
typedef struct {
    const char *name;
    fmu_type_t type;
    fmu_causality_t causality;
    size_t offset; /* offset of its member in fmu_values_t */
    double start;
    double minimum, maximum; /* inclusive; infinite: any finite number */
} fmu_variable_t;

/* Generated together with modelDescription.xml. */
extern const fmu_variable_t fmu_variables[];
extern const size_t fmu_variable_count;
extern const char fmu_instantiation_token[];

typedef struct {
    fmu_values_t values;
    machine_t machine; /* machine of the plant, with the parameters applied */
    plant_t plant;
} fmu_model_t;

/* Sets all variables to their start values, and the machine to rest at time 0. */
void fmu_model_reset(fmu_model_t *model);

/* Restarts with the present parameters and inputs: plant at time 0, outputs updated. */
void fmu_model_restart(fmu_model_t *model);

/* Advances the plant to to_ns with the present inputs and updates the outputs. */
void fmu_model_advance(fmu_model_t *model, uint64_t to_ns);

/* Makes a copy of the struct independent of the original; call it on every copy. */
void fmu_model_rebind(fmu_model_t *model);

#endif
