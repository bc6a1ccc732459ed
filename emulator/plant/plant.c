#include "plant/plant.h"

#include <math.h>
#include <string.h>

#include "plant/common_steps.h"
#include "plant/coupled.h"
#include "plant/faulted.h"
#include "plant/min_max.h"
#include "plant/phase_steps.h"

/* Limits of a step at factor 1, chosen for errors of currents, torque and speed below 1e-6 of their range (measured
 * against SciPy's DOP853 at a tolerance of 1e-12: 9e-7) at the speeds and currents of a drive. A control period at
 * 40 kHz without an event is one step. */
#define STEP_MAX_S 25e-6
/* Fraction of saturation_A of the magnetics: limits the change of the incremental inductance. */
#define STEP_CURRENT_FRACTION 0.09
#define STEP_ANGLE_PITCHES 0.0015

/* Fraction of the shortest time constant, among them a winding's at its smallest inductance and the free
 * rotor's: where resistance or friction is large, longer Runge-Kutta steps lose accuracy, and beyond 2.8 stability. */
#define STEP_TIME_CONSTANTS 0.05

/* With a DC link, where each phase has its own steps: fraction of the time constant sqrt(L C) of a phase that is
 * connected to it, with its present incremental inductance, and the capacitor. */
#define LINK_STEP 0.0175
/* Fraction likewise of the time constant of the source's resistance and the capacitor. */
#define LINK_SOURCE_STEP 0.5

/* Below 0 C: where the resistance of copper, extrapolated, is 0. */
#define COPPER_ZERO_C 235.0

void plant_init(plant_t *plant, const machine_t *machine, double initial_angle_rad) {
    memset(plant, 0, sizeof *plant);
    plant->machine = machine;
    plant->rotor_angle_rad = initial_angle_rad;
    plant->supply_voltage_V = machine->supply_voltage_V;
    plant->bus_voltage_V = machine->supply_voltage_V;
    plant->minimum_pulse_ns = machine->converter.minimum_pulse_ns;
    plant->limits.factor = 1.0;
    plant->trip_current_A = INFINITY;
    plant->trip_ns = UINT64_MAX;
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        plant->winding_gain[phase] = 1.0;
    }
    plant_set_gains(plant, &(plant_gains_t){1.0, 1.0, 1.0, 1.0});
    plant->phase_offset_rad = plant->magnetics.pitch_rad / machine->phases;
    coupled_prepare(&plant->coupled, machine, plant->magnetics.pitch_rad);
    plant->faulted = plant->coupled.present;
    plant_set_step_factor(plant, 1.0);
    plant->smooth = SMOOTH_RANGE_EMPTY;
}

/* The resistances by gain and temperature, and the limits of the steps that depend on them. */
static void set_resistances(plant_t *plant) {
    const machine_t *machine = plant->machine;
    const converter_t *converter = &machine->converter;
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        plant->winding_ohm[phase] = plant->gains.resistance * machine->resistance_ohm * plant->winding_gain[phase];
        for (unsigned on = 0; on < 3; on++) {
            plant->resistance_ohm[phase][on] = plant->winding_ohm[phase] + on * converter->switch_resistance_ohm +
                                               (2 - on) * converter->diode_resistance_ohm;
        }
    }
    plant_set_step_factor(plant, plant->limits.factor);
}

void plant_set_gains(plant_t *plant, const plant_gains_t *gains) {
    const machine_t *machine = plant->machine;
    plant->gains = *gains;
    plant->inertia_kg_m2 = gains->inertia * machine->inertia_kg_m2;
    plant->friction_Nm_s = gains->friction * machine->friction_Nm_s;
    magnetics_prepare(&plant->magnetics, &machine->magnetics, machine->rotor_poles);
    magnetics_scale(&plant->magnetics, gains->flux_linkage);
    phase_steps_reset(plant);
    for (unsigned on = 0; on < 3; on++) {
        const converter_t *converter = &machine->converter;
        plant->drop_V[on] = on * converter->switch_drop_V + (2 - on) * converter->diode_drop_V;
    }
    set_resistances(plant);
}

void plant_set_winding_temperatures(plant_t *plant, const double temperature_C[HAL_PHASES_MAX]) {
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        plant->winding_gain[phase] = (COPPER_ZERO_C + temperature_C[phase]) / (COPPER_ZERO_C + PLANT_RESISTANCE_C);
    }
    set_resistances(plant);
}

void plant_set_supply_voltage(plant_t *plant, double voltage_V) {
    plant->supply_voltage_V = voltage_V;
    if (!plant_has_link(plant)) {
        plant->bus_voltage_V = voltage_V;
    }
}

void plant_hold(plant_t *plant, double speed_rad_s, double acceleration_rad_s2) {
    plant->held = true;
    plant->speed_rad_s = speed_rad_s;
    plant->held_acceleration_rad_s2 = acceleration_rad_s2;
}

void plant_lock(plant_t *plant) {
    plant->energy_fault_J += plant_kinetic_energy_J(plant);
    plant_hold(plant, 0.0, 0.0);
}

void plant_release(plant_t *plant) {
    plant->held = false;
}

void plant_set_step_factor(plant_t *plant, double factor) {
    double resistance_ohm = 0.0;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        const double *of_phase_ohm = plant->resistance_ohm[phase];
        resistance_ohm = fmax(resistance_ohm, fmax(of_phase_ohm[0], of_phase_ohm[2]));
    }
    double time_constant_s =
        fmin(plant->magnetics.inductance_min_H / resistance_ohm, plant->inertia_kg_m2 / plant->friction_Nm_s);
    plant->limits.own_max_s = factor * fmin(STEP_MAX_S, STEP_TIME_CONSTANTS * time_constant_s);
    if (plant_has_link(plant)) {
        const dc_link_t *link = &plant->machine->dc_link;
        const double source_s = link->source_resistance_ohm * link->capacitance_F;
        plant->limits.own_max_s = fmin(plant->limits.own_max_s, factor * LINK_SOURCE_STEP * source_s);
        plant->limits.link_swing_s2_H = factor * factor * LINK_STEP * LINK_STEP * link->capacitance_F;
        time_constant_s = fmin(time_constant_s, link->source_resistance_ohm * link->capacitance_F);
        if (link->chopper_resistance_ohm > 0.0) {
            time_constant_s = fmin(time_constant_s, link->chopper_resistance_ohm * link->capacitance_F);
        }
    }
    if (plant->faulted) {
        time_constant_s = fmin(time_constant_s, faulted_time_constant_s(plant));
    }
    plant->limits.factor = factor;
    plant->limits.common_max_s = factor * fmin(STEP_MAX_S, STEP_TIME_CONSTANTS * time_constant_s);
    plant->limits.angle_rad = factor * STEP_ANGLE_PITCHES * plant->magnetics.pitch_rad;
    plant->limits.current_A = factor * STEP_CURRENT_FRACTION * plant->magnetics.saturation_A;
}

void plant_set_faults(plant_t *plant, const plant_faults_t *faults) {
    double sum = faults->winding_open + faults->switch_open.upper + faults->switch_open.lower +
                 faults->switch_shorted.upper + faults->switch_shorted.lower + faults->diode_open.upper +
                 faults->diode_open.lower + faults->chopper_open + faults->coulomb_Nm + faults->static_Nm;
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        sum += faults->shorted_turns[phase] + faults->earth_ohm[phase];
    }
    plant->faults = *faults;
    plant->faulted = sum > 0.0 || plant->coupled.present;
    plant_set_step_factor(plant, plant->limits.factor);
}

/* --- Switches --- */

void plant_set_trip(plant_t *plant, double trip_current_A) {
    plant->trip_current_A = trip_current_A;
}

void plant_clear_trip(plant_t *plant) {
    plant->tripped = false;
}

/* --- Observation --- */

void plant_observe(plant_t *plant, uint64_t first_ns, uint64_t step_ns, plant_sample_t sample, void *context) {
    plant->observation.sample = step_ns > 0 ? sample : NULL;
    plant->observation.context = context;
    plant->observation.step_ns = step_ns;
    plant->observation.next_ns = first_ns;
    if (step_ns > 0 && first_ns < plant->time_ns) {
        plant->observation.next_ns += (plant->time_ns - first_ns + step_ns - 1) / step_ns * step_ns;
    }
}

/* --- Time --- */

void plant_advance(plant_t *plant, uint64_t to_ns) {
    while (plant->time_ns < to_ns) {
        if (plant->trip_ns <= plant->time_ns) {
            plant->trip_ns = UINT64_MAX;
            plant->tripped = true;
            plant_open_all(plant);
        }
        if (plant->observation.sample != NULL && plant->observation.next_ns == plant->time_ns) {
            plant_take_sample(plant);
        }
        if (phase_steps_advance(plant, to_ns)) {
            continue;
        }
        const uint64_t edge_ns = plant_follow_edges(plant, to_ns);
        common_steps_advance(plant, min_u64(plant->trip_ns, edge_ns));
        plant_follow_edges(plant, to_ns);
    }
    if (plant->observation.sample != NULL && plant->observation.next_ns == plant->time_ns) {
        plant_take_sample(plant);
    }
}
