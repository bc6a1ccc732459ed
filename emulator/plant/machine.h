/* A machine with its converter's supply, as its machine file (tools/machines) says. */
#ifndef PLANT_MACHINE_H
#define PLANT_MACHINE_H

#include "plant/magnetics.h"

typedef struct {
    const char *name;
    unsigned stator_poles;
    unsigned rotor_poles;
    unsigned phases; /* 1..HAL_PHASES_MAX */
    double resistance_ohm;
    double inertia_kg_m2;
    double friction_Nm_s;
    double supply_voltage_V;
    magnetics_t magnetics;
} machine_t;

/* The machine this executable was built for; generated from the machine file. */
extern const machine_t machine_plant;

#endif
