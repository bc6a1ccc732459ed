// Machines of tools/machines with analytic magnetics, for tests of the plant.
#ifndef EMULATOR_MACHINES_H
#define EMULATOR_MACHINES_H

extern "C" {
#include "plant/machine.h"
}

inline machine_t machine_of(magnetics_form_t form) {
    machine_t machine = {};
    machine.name = "test";
    machine.stator_poles = 6;
    machine.rotor_poles = 4;
    machine.phases = 3;
    machine.resistance_ohm = 0.05;
    machine.inertia_kg_m2 = 0.02;
    machine.friction_Nm_s = 0.02;
    machine.supply_voltage_V = 240.0;
    machine.sensors.current_gain = 1.0;
    machine.sensors.current_limit_A = 1000.0;
    machine.ranges = {80.0, 512.0, 64.0};
    machine.magnetics.form = form;
    machine.magnetics.unaligned_inductance_H = 0.676e-3;
    machine.magnetics.aligned_inductance_H = 23.6e-3;
    if (form == MAGNETICS_LINEAR_TRAPEZOID) {
        machine.magnetics.flat_deg = 1.0;
        machine.magnetics.blend_deg = 2.0;
    }
    if (form == MAGNETICS_SATURATING) {
        machine.magnetics.unaligned_inductance_H = 0.67e-3;
        machine.magnetics.saturated_inductance_H = 0.15e-3;
        machine.magnetics.flux_linkage_max_Wb = 0.486;
        machine.magnetics.current_at_flux_linkage_max_A = 450.0;
    }
    return machine;
}

inline const char *form_name(magnetics_form_t form) {
    return form == MAGNETICS_LINEAR_COSINE      ? "linear_cosine"
           : form == MAGNETICS_LINEAR_TRAPEZOID ? "linear_trapezoid"
                                                : "saturating";
}

#endif
