/* The plant behind the variables of a functional mock-up unit: what is set and read, and what a step does. No FMI here.
 */
#ifndef FMI_FMU_MODEL_H
#define FMI_FMU_MODEL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "hal.h"
#include "plant/plant.h"

/* One member for each variable; their meaning, limits and start values stand in tools/src/salient/fmu.py. */
typedef struct {
    double time_s;

    /* Inputs, held over a step. */
    bool upper[HAL_PHASES_MAX], lower[HAL_PHASES_MAX];
    double load_torque_Nm, supply_voltage_V;

    /* Parameters, fixed once the first step may be taken. */
    double initial_angle_rad, initial_speed_rad_s;
    double resistance_ohm, inertia_kg_m2, friction_Nm_s;

    /* Outputs, of the end of the last step. */
    double current_A[HAL_PHASES_MAX];
    double torque_Nm, speed_rad_s, rotor_angle_rad;
    double bus_voltage_V, bus_current_A;
    double energy_drawn_J, energy_returned_J, energy_copper_J, energy_converter_J;
} fmu_values_t;

typedef enum { FMU_FLOAT64, FMU_BOOLEAN } fmu_type_t;
typedef enum { FMU_INDEPENDENT, FMU_INPUT, FMU_PARAMETER, FMU_OUTPUT } fmu_causality_t;

/* A variable; its value reference is its place in fmu_variables. */
typedef struct {
    const char *name;
    fmu_type_t type;
    fmu_causality_t causality;
    size_t offset; /* of its member in fmu_values_t */
    double start;
    double minimum, maximum; /* allowed too; infinite: any finite number */
} fmu_variable_t;

/* Generated together with modelDescription.xml. */
extern const fmu_variable_t fmu_variables[];
extern const size_t fmu_variable_count;
extern const char fmu_instantiation_token[];

typedef struct {
    fmu_values_t values;
    machine_t machine; /* the plant's, with the parameters in it */
    plant_t plant;
} fmu_model_t;

/* Every variable at its start value, the machine at rest at time 0. */
void fmu_model_reset(fmu_model_t *model);

/* Begins anew from the parameters and inputs as they are: plant at time 0, outputs to match. */
void fmu_model_restart(fmu_model_t *model);

/* Advances the plant to to_ns with the inputs as they are, and brings the outputs up to date. */
void fmu_model_advance(fmu_model_t *model, uint64_t to_ns);

/* To be called on a copy of the whole struct, so that it shares nothing with the original. */
void fmu_model_rebind(fmu_model_t *model);

#endif
