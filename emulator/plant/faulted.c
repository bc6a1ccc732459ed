#include "plant/faulted.h"

#include <math.h>

#include "plant/coupled.h"

/* An open phase whose voltage is below what is induced by less than this conducts: after the event of its beginning. */
#define CONDUCTION_TOLERANCE_V 1e-6

/* Devices that carry the current of one end of a winding. */
typedef struct {
    bool rail; /* the end is where a switch that is on would put it */
    double drop_V, resistance_ohm, breakdown_V;
} end_t;

static double breakdown_V(const plant_t *plant) {
    return FAULTED_BREAKDOWN * plant->machine->supply_voltage_V;
}

static end_t end_of(const plant_t *plant, bool on, bool diode_open) {
    const converter_t *converter = &plant->machine->converter;
    if (on) {
        return (end_t){true, converter->switch_drop_V, converter->switch_resistance_ohm, 0.0};
    }
    if (!diode_open) {
        return (end_t){false, converter->diode_drop_V, converter->diode_resistance_ohm, 0.0};
    }
    return (end_t){true, 0.0, converter->switch_resistance_ohm, breakdown_V(plant)};
}

static bool bit(unsigned mask, unsigned phase) {
    return (mask >> phase) & 1u;
}

/* Path of a phase while current flows at its terminals. */
static plant_path_t conducting_path(const plant_t *plant, unsigned phase) {
    const plant_faults_t *faults = &plant->faults;
    const unsigned switches = plant->switches[phase];
    const bool upper = ((switches & HALF_BRIDGE_UPPER) != 0 && !bit(faults->switch_open.upper, phase)) ||
                       bit(faults->switch_shorted.upper, phase);
    const bool lower = ((switches & HALF_BRIDGE_LOWER) != 0 && !bit(faults->switch_open.lower, phase)) ||
                       bit(faults->switch_shorted.lower, phase);
    end_t ends[2] = {
        end_of(plant, upper, bit(faults->diode_open.lower, phase)),
        end_of(plant, lower, bit(faults->diode_open.upper, phase)),
    };
    const double earth_ohm = faults->earth_ohm[phase];
    if (earth_ohm > 0.0 && !lower) {
        ends[1] = (end_t){true, 0.0, earth_ohm, 0.0};
    }
    const double shorted = faults->shorted_turns[phase], winding_ohm = plant->winding_ohm[phase];
    plant_path_t path = {
        .sign = (double)ends[0].rail + (double)ends[1].rail - 1.0,
        .device_V = ends[0].drop_V + ends[1].drop_V,
        .device_ohm = ends[0].resistance_ohm + ends[1].resistance_ohm,
        .breakdown_V = ends[0].breakdown_V + ends[1].breakdown_V,
    };
    if (bit(faults->winding_open, phase)) {
        path.breakdown_V += breakdown_V(plant);
    }
    path.terminal_gain = 1.0 / (1.0 - shorted);
    path.terminal_S = shorted > 0.0 ? shorted / (winding_ohm * (1.0 - shorted)) : 0.0;
    const double eddy_S = plant->coupled.eddy_S;
    path.terminal_S += eddy_S * path.terminal_gain;
    const double divider = 1.0 / (1.0 + path.device_ohm * path.terminal_S + winding_ohm * eddy_S);
    path.link_gain = divider * path.sign;
    path.drop_V = divider * (path.device_V + path.breakdown_V);
    path.resistance_ohm = divider * (winding_ohm + path.device_ohm * path.terminal_gain);
    return path;
}

/* The loops of shorted turns and eddy currents alone. */
static plant_path_t isolated_path(const plant_t *plant, unsigned phase) {
    const double shorted = plant->faults.shorted_turns[phase], eddy_S = plant->coupled.eddy_S;
    const double ohm =
        eddy_S > 0.0 ? 1.0 / (shorted / plant->winding_ohm[phase] + eddy_S) : plant->winding_ohm[phase] / shorted;
    return (plant_path_t){.resistance_ohm = ohm};
}

/* Adds a phase to the conducting ones. */
static void conduct(plant_t *plant, integrator_setting_t *setting, unsigned phase, plant_path_t path, bool driven) {
    const unsigned at = setting->count++;
    const bool loop = plant_has_loop(plant, phase);
    setting->path[at] = path;
    setting->isolated[at] =
        loop && !driven && plant_path_terminal_A(&path, plant->bus_voltage_V, plant->current_A[phase]) <= 0.0;
    if (setting->isolated[at]) {
        path = isolated_path(plant, phase);
    }
    plant->path[phase] = path;
    setting->shorted |= loop;
    setting->loop[at] = loop;
    setting->turns[at] = plant->faults.shorted_turns[phase];
    setting->phase[at] = phase;
    /* Where it cannot end; the end of a loop's conduction: faulted_distance_to_event. */
    setting->driven[at] = (driven && !plant->coupled.mutual) || loop;
    setting->angle_offset_rad[at] = phase * plant->phase_offset_rad;
    setting->link_sign[at] = path.link_gain;
    setting->drop_V[at] = path.drop_V;
    setting->resistance_ohm[at] = path.resistance_ohm;
    setting->terminal_sign[at] = path.sign;
    setting->terminal_gain[at] = path.terminal_gain;
    setting->terminal_S[at] = path.terminal_S;
}

/* Makes open phases of a coupled machine conduct, whose voltage exceeds what the conducting ones induce; each of them
 * changes that. */
static void find_induced(plant_t *plant, integrator_setting_t *setting, const plant_path_t *paths) {
    for (bool found = true; found && setting->open_count > 0;) {
        integrator_state_t state = {plant->rotor_angle_rad, plant->speed_rad_s, plant->bus_voltage_V, {0.0}};
        for (unsigned index = 0; index < setting->count; index++) {
            state.current_A[index] = plant->current_A[setting->phase[index]];
        }
        integrator_derivative_t derivative;
        coupled_differentiate(setting, &state, &derivative);
        double least_V = CONDUCTION_TOLERANCE_V;
        unsigned least = 0;
        for (unsigned index = 0; index < setting->open_count; index++) {
            const double blocking_V = coupled_blocking_V(setting, &state, &derivative, index);
            if (blocking_V < least_V) {
                least_V = blocking_V;
                least = index;
            }
        }
        found = least_V < CONDUCTION_TOLERANCE_V;
        if (found) {
            conduct(plant, setting, setting->open[least], paths[setting->open[least]], false);
            setting->open_count--;
            for (unsigned index = least; index < setting->open_count; index++) {
                setting->open[index] = setting->open[index + 1];
                setting->open_sign[index] = setting->open_sign[index + 1];
                setting->open_drop_V[index] = setting->open_drop_V[index + 1];
            }
        }
    }
}

void faulted_find_conducting(plant_t *plant, integrator_setting_t *setting) {
    plant_path_t paths[HAL_PHASES_MAX];
    const bool mutual = plant->coupled.mutual;
    setting->count = setting->open_count = 0;
    setting->shorted = false;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        const double current_A = plant->current_A[phase];
        const plant_path_t path = paths[phase] = conducting_path(plant, phase);
        const bool unbroken = !bit(plant->faults.winding_open, phase);
        const bool driven = path.link_gain * plant->bus_voltage_V > path.drop_V && unbroken;
        plant->path[phase] = (plant_path_t){0};
        const bool either_sign = mutual && plant_has_loop(plant, phase); /* what the neighbours induce in its loop */
        if (either_sign || current_A >= PLANT_CURRENT_NEGLIGIBLE_A || (driven && !mutual)) {
            conduct(plant, setting, phase, path, driven);
            continue;
        }
        plant->current_A[phase] = 0.0;
        if (mutual && unbroken && path.sign >= 0.0) {
            setting->open[setting->open_count] = phase;
            setting->open_sign[setting->open_count] = path.link_gain;
            setting->open_drop_V[setting->open_count++] = path.drop_V;
        }
    }
    if (mutual) {
        find_induced(plant, setting, paths);
    }
}

void faulted_find_friction(plant_t *plant, integrator_setting_t *setting) {
    const double coulomb_Nm = plant->faults.coulomb_Nm, static_Nm = plant->faults.static_Nm;
    setting->friction_sign = 0.0;
    setting->stuck = false;
    if (plant->held || (coulomb_Nm == 0.0 && static_Nm == 0.0)) {
        return;
    }
    double drive = plant->speed_rad_s;
    if (drive == 0.0) {
        drive = plant_torque_Nm(plant) - plant->load_torque_Nm;
        setting->stuck = fabs(drive) <= fmax(coulomb_Nm, static_Nm);
    }
    if (setting->stuck) {
        setting->held = true;
        setting->held_acceleration_rad_s2 = 0.0;
    } else {
        setting->friction_sign = copysign(1.0, drive);
        setting->load_torque_Nm += setting->friction_sign * coulomb_Nm;
        setting->ahead_rad = copysign(setting->ahead_rad, drive);
    }
}

double faulted_distance_to_event(const integrator_setting_t *setting, const integrator_state_t *state) {
    double nearest = INFINITY;
    if (setting->friction_sign != 0.0) {
        nearest = setting->friction_sign * state->speed_rad_s;
    }
    for (unsigned index = 0; index < setting->count; index++) {
        if (setting->loop[index]) {
            const double at_A =
                plant_path_terminal_A(&setting->path[index], state->bus_voltage_V, state->current_A[index]);
            nearest = fmin(nearest, setting->isolated[index] ? -at_A : at_A);
        }
    }
    if (setting->open_count > 0) {
        integrator_derivative_t derivative;
        coupled_differentiate(setting, state, &derivative);
        for (unsigned index = 0; index < setting->open_count; index++) {
            nearest = fmin(nearest, coupled_blocking_V(setting, state, &derivative, index));
        }
    }
    return nearest;
}

double faulted_distance_to_trip(const integrator_setting_t *setting, const integrator_state_t *state) {
    double nearest_A = INFINITY;
    for (unsigned index = 0; index < setting->count; index++) {
        if (setting->terminal_sign[index] >= 0.0 && !setting->isolated[index]) {
            const double at_A =
                plant_path_terminal_A(&setting->path[index], state->bus_voltage_V, state->current_A[index]);
            nearest_A = fmin(nearest_A, setting->trip_current_A - at_A);
        }
    }
    return nearest_A;
}

void faulted_add_energies(plant_t *plant, const integrator_setting_t *setting, const integrator_integrals_t *integrals,
                          double step_s) {
    const double link_V = plant->bus_voltage_V;
    const double link_Vs = setting->link ? integrals->link_Vs : link_V * step_s;
    const double link2_V2s = setting->link ? integrals->link2_V2s : link_V * link_V * step_s;
    for (unsigned index = 0; index < setting->count; index++) {
        /* Integrals of current i_m, flux rate e and DC-link voltage Vdc, and of their products. */
        const double a = setting->link_sign[index], b = setting->drop_V[index], r = setting->resistance_ohm[index];
        const double i = integrals->charge_As[index], i2 = integrals->current2_A2s[index];
        const double v_i = setting->link ? integrals->link_J[index] : link_V * i;
        const double e = a * link_Vs - b * step_s - r * i;
        const double i_e = a * v_i - b * i - r * i2;
        const double v_e = a * link2_V2s - b * link_Vs - r * v_i;
        const double e2 = a * v_e - b * e - r * i_e;
        /* The same of the current at the terminals. */
        const double gain = setting->terminal_gain[index], S = setting->terminal_S[index];
        const double charge_As = gain * i + S * e;
        const double current2_A2s = gain * gain * i2 + 2.0 * gain * S * i_e + S * S * e2;
        const double energy_J = setting->terminal_sign[index] * (gain * v_i + S * v_e);
        if (energy_J > 0.0) {
            plant->energy_drawn_J += energy_J;
        } else {
            plant->energy_returned_J -= energy_J;
        }
        const plant_path_t *path = &setting->path[index];
        const double k = setting->turns[index], winding_ohm = plant->winding_ohm[setting->phase[index]];
        const double loop_J = k > 0.0 ? k / winding_ohm * e2 : 0.0;
        plant->energy_iron_J += plant->coupled.eddy_S * e2;
        const double copper_J = (1.0 - k) * winding_ohm * current2_A2s + loop_J;
        const double converter_J = path->device_V * charge_As + path->device_ohm * current2_A2s;
        plant->energy_copper_J += copper_J;
        plant->energy_converter_J += converter_J;
        plant->phase_copper_J[setting->phase[index]] += copper_J;
        plant->phase_converter_J[setting->phase[index]] += converter_J;
        plant->energy_fault_J += path->breakdown_V * charge_As;
    }
    if (setting->friction_sign != 0.0) {
        plant->energy_friction_J += plant->faults.coulomb_Nm * fabs(integrals->angle_rad);
    }
}

double faulted_time_constant_s(const plant_t *plant) {
    const double capacitance_F = plant->machine->dc_link.capacitance_F;
    double time_constant_s = INFINITY;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        const double k = plant->faults.shorted_turns[phase];
        if (k > 0.0) {
            time_constant_s = fmin(time_constant_s, plant->magnetics.inductance_min_H * k / plant->winding_ohm[phase]);
            if (capacitance_F > 0.0) {
                time_constant_s = fmin(time_constant_s, capacitance_F * plant->winding_ohm[phase] * (1.0 - k) / k);
            }
        }
    }
    return time_constant_s;
}
