#include "plant/plant.h"

#include <math.h>
#include <string.h>

#include "plant/event_bracket.h"
#include "plant/faulted.h"
#include "plant/hermite.h"
#include "plant/integrator.h"
#include "plant/magnetics_kernel.h"
#include "plant/phase_steps.h"

/* Limits of a step at factor 1, chosen for errors of currents, torque and speed below 1e-6 of their range (measured
 * against SciPy's DOP853 at a tolerance of 1e-12: 9e-7) at the speeds and currents of a drive. A control period at
 * 40 kHz without an event is one step. */
#define STEP_MAX_S 25e-6
/* Fraction of saturation_A of the magnetics: limits the change of the incremental inductance. */
#define STEP_CURRENT_FRACTION 0.09
#define STEP_ANGLE_PITCHES 0.0015

/* Fraction of the shortest time constant, among them those of a winding at its smallest inductance and of the free
 * rotor: where resistance or friction is large, longer Runge-Kutta steps lose accuracy, and beyond 2.8 stability. */
#define STEP_TIME_CONSTANTS 0.05

/* With a DC link, where each phase has its own steps: fraction of the time constant sqrt(L C) of a phase that is
 * connected to it, with its present incremental inductance, and the capacitor. */
#define LINK_STEP 0.0175
/* And of that of the source's resistance and the capacitor. */
#define LINK_SOURCE_STEP 0.5

/* Accuracy of event times: end of conduction of a diode, switching of supply and chopper. */
/* After an event, a DC-link voltage within this tolerance of its threshold is set to it. */
#define THRESHOLD_TOLERANCE_V 1e-6
/* After an event, a slower shaft with friction stands still. */
#define SPEED_TOLERANCE_RAD_S 1e-6

/* Below 0 C: where the resistance of copper, extrapolated, is 0. */
#define COPPER_ZERO_C 235.0

static const double NS_S = 1e-9;

static bool has_link(const plant_t *plant) {
    return plant->machine->dc_link.capacitance_F > 0.0;
}

void plant_init(plant_t *plant, const machine_t *machine, double initial_angle_rad) {
    memset(plant, 0, sizeof *plant);
    plant->machine = machine;
    plant->rotor_angle_rad = initial_angle_rad;
    plant->supply_voltage_V = machine->supply_voltage_V;
    plant->bus_voltage_V = machine->supply_voltage_V;
    plant->minimum_pulse_ns = machine->converter.minimum_pulse_ns;
    plant->step_factor = 1.0;
    plant->trip_current_A = INFINITY;
    plant->trip_ns = UINT64_MAX;
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        plant->winding_gain[phase] = 1.0;
    }
    plant_set_gains(plant, &(plant_gains_t){1.0, 1.0, 1.0, 1.0});
    plant->phase_offset_rad = plant->magnetics.pitch_rad / machine->phases;
    /* Empty range: the first step computes it. */
    plant->smooth_from_rad = INFINITY;
    plant->smooth_to_rad = -INFINITY;
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
    plant_set_step_factor(plant, plant->step_factor);
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
    if (!has_link(plant)) {
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
    plant->step_max_s = factor * fmin(STEP_MAX_S, STEP_TIME_CONSTANTS * time_constant_s);
    if (has_link(plant)) {
        const dc_link_t *link = &plant->machine->dc_link;
        const double source_s = link->source_resistance_ohm * link->capacitance_F;
        plant->step_max_s = fmin(plant->step_max_s, factor * LINK_SOURCE_STEP * source_s);
        plant->link_swing_s2_H = factor * factor * LINK_STEP * LINK_STEP * link->capacitance_F;
        time_constant_s = fmin(time_constant_s, link->source_resistance_ohm * link->capacitance_F);
        if (link->chopper_resistance_ohm > 0.0) {
            time_constant_s = fmin(time_constant_s, link->chopper_resistance_ohm * link->capacitance_F);
        }
    }
    if (plant->faulted) {
        time_constant_s = fmin(time_constant_s, faulted_time_constant_s(plant));
    }
    plant->step_factor = factor;
    plant->together_step_max_s = factor * fmin(STEP_MAX_S, STEP_TIME_CONSTANTS * time_constant_s);
    plant->step_angle_rad = factor * STEP_ANGLE_PITCHES * plant->magnetics.pitch_rad;
    plant->step_current_A = factor * STEP_CURRENT_FRACTION * plant->magnetics.saturation_A;
}

void plant_set_faults(plant_t *plant, const plant_faults_t *faults) {
    double sum = faults->winding_open + faults->switch_open.upper + faults->switch_open.lower +
                 faults->switch_shorted.upper + faults->switch_shorted.lower + faults->diode_open.upper +
                 faults->diode_open.lower + faults->chopper_open + faults->coulomb_Nm + faults->static_Nm;
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        sum += faults->shorted_turns[phase] + faults->earth_ohm[phase];
    }
    plant->faults = *faults;
    plant->faulted = sum > 0.0;
    plant_set_step_factor(plant, plant->step_factor);
}

/* --- Switches --- */

void plant_set_switches(plant_t *plant, const hal_pwm_compare_t *compare, uint16_t period_ticks) {
    const bool other =
        period_ticks != plant->pattern_period_ticks || !(plant->minimum_pulse_ns == plant->pattern_minimum_pulse_ns);
    const uint32_t shortest_ticks = other ? half_bridge_shortest_ticks(plant->minimum_pulse_ns) : plant->shortest_ticks;
    plant->pattern_ns = plant->time_ns;
    plant->pattern_period_ticks = period_ticks;
    plant->pattern_minimum_pulse_ns = plant->minimum_pulse_ns;
    plant->shortest_ticks = shortest_ticks;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        const uint16_t upper = compare->upper[phase], lower = compare->lower[phase];
        if (other || upper != plant->pattern_compare.upper[phase] || lower != plant->pattern_compare.lower[phase]) {
            half_bridge_pattern(&plant->pattern[phase], upper, lower, period_ticks, shortest_ticks);
            plant->pattern_compare.upper[phase] = upper;
            plant->pattern_compare.lower[phase] = lower;
        }
        plant->edge_next[phase] = 0;
        plant->switches[phase] = plant->pattern[phase].first;
    }
}

uint64_t plant_follow_edges(plant_t *plant, uint64_t to_ns) {
    uint64_t next_ns = to_ns;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        const half_bridge_pattern_t *pattern = &plant->pattern[phase];
        for (; plant->edge_next[phase] < pattern->count; plant->edge_next[phase]++) {
            const uint64_t edge_ns = plant->pattern_ns + pattern->delay_ns[plant->edge_next[phase]];
            if (edge_ns > plant->time_ns) {
                next_ns = edge_ns < next_ns ? edge_ns : next_ns;
                break;
            }
            plant->switches[phase] = pattern->switches[plant->edge_next[phase]];
        }
    }
    return next_ns;
}

void plant_open_all(plant_t *plant) {
    plant->pattern_period_ticks = 0;
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        plant->switches[phase] = plant->pattern[phase].count = plant->edge_next[phase] = 0;
    }
}

void plant_set_trip(plant_t *plant, double trip_current_A) {
    plant->trip_current_A = trip_current_A;
}

void plant_clear_trip(plant_t *plant) {
    plant->tripped = false;
}

/* --- One step --- */

/* Determines the conduction states of supply and chopper. At exactly the voltage at which the supply's rectifier begins
 * to conduct, the current of half bridges and chopper decides. */
static void find_link(plant_t *plant, integrator_setting_t *setting) {
    double drawn_A = 0.0;
    for (unsigned index = 0; index < setting->count; index++) {
        drawn_A += setting->terminal_sign[index] * plant_current_A(plant, setting->phase[index]);
    }
    const dc_link_t *link = &plant->machine->dc_link;
    const double link_V = plant->bus_voltage_V, supply_V = plant->supply_voltage_V;
    setting->chopper = link->chopper_resistance_ohm > 0.0 && !plant->faults.chopper_open;
    if (!setting->chopper || link_V <= link->chopper_off_V) {
        plant->chopper_on = false;
    } else if (link_V >= link->chopper_on_V) {
        plant->chopper_on = true;
    }
    drawn_A += plant->chopper_on ? link_V / link->chopper_resistance_ohm : 0.0;
    setting->chopper_on = plant->chopper_on;
    setting->source_conducts = link_V < supply_V || (link_V == supply_V && drawn_A >= 0.0);
}

static void find_setting(plant_t *plant, integrator_setting_t *setting) {
    setting->machine = plant->machine;
    setting->magnetics = &plant->magnetics;
    setting->inertia_kg_m2 = plant->inertia_kg_m2;
    setting->friction_Nm_s = plant->friction_Nm_s;
    setting->load_torque_Nm = plant->load_torque_Nm;
    setting->trip_current_A = plant->trip_ns == UINT64_MAX && !plant->tripped ? plant->trip_current_A : INFINITY;
    setting->held = plant->held;
    setting->held_acceleration_rad_s2 = plant->held_acceleration_rad_s2;
    setting->supply_voltage_V = plant->supply_voltage_V;
    setting->ahead_rad = copysign(2.0 * MAGNETICS_SMOOTH_TOLERANCE_RAD, plant->speed_rad_s);
    faulted_find_conducting(plant, setting);
    faulted_find_friction(plant, setting);
    setting->link = has_link(plant);
    setting->source_conducts = setting->chopper_on = setting->chopper = false;
    if (setting->link) {
        find_link(plant, setting);
    }
}

/* Nearest DC-link voltages at which supply or chopper switch: with rising and with falling voltage. */
typedef struct {
    double rising_V, falling_V;
} thresholds_t;

static thresholds_t thresholds_of(const integrator_setting_t *setting) {
    const dc_link_t *link = &setting->machine->dc_link;
    thresholds_t thresholds = {INFINITY, -INFINITY};
    if (setting->source_conducts) {
        thresholds.rising_V = setting->supply_voltage_V;
    } else {
        thresholds.falling_V = setting->supply_voltage_V;
    }
    if (setting->chopper_on) {
        thresholds.falling_V = fmax(thresholds.falling_V, link->chopper_off_V);
    } else if (setting->chopper) {
        thresholds.rising_V = fmin(thresholds.rising_V, link->chopper_on_V);
    }
    return thresholds;
}

/* Distance of a state from a comparator's response; negative: past it. */
static double distance_to_trip(const integrator_setting_t *setting, const integrator_state_t *state) {
    if (setting->shorted) {
        return faulted_distance_to_trip(setting, state);
    }
    double nearest_A = INFINITY;
    for (unsigned index = 0; index < setting->count; index++) {
        const double distance_A = setting->trip_current_A - state->current_A[index];
        if (setting->link_sign[index] >= 0.0 && distance_A < nearest_A) { /* a switch conducts */
            nearest_A = distance_A;
        }
    }
    return nearest_A;
}

/* Distance of a state from the next event: minimum of the currents that are not driven and of the distances between
 * DC-link voltage and thresholds, and between currents and comparators (V and A with equal weight). Negative: past the
 * event. */
static double distance_to_event(const integrator_setting_t *setting, const integrator_state_t *state) {
    double nearest = fmin(distance_to_trip(setting, state), faulted_distance_to_event(setting, state));
    for (unsigned index = 0; index < setting->count; index++) {
        if (!setting->driven[index] && state->current_A[index] < nearest) {
            nearest = state->current_A[index];
        }
    }
    if (setting->link) {
        const thresholds_t thresholds = thresholds_of(setting);
        nearest = fmin(nearest,
                       fmin(thresholds.rising_V - state->bus_voltage_V, state->bus_voltage_V - thresholds.falling_V));
    }
    return nearest;
}

/* Shortens a step that contains an event to the time of the event; returns the length. Illinois variant of the false
 * position method on the result of the step: the distance is nearly linear in time, so few iterations suffice. The
 * length is never zero, so that time advances. */
static double step_to_event(const integrator_setting_t *setting, const integrator_state_t *start,
                            const integrator_derivative_t *first, double step_s, integrator_state_t *end,
                            integrator_integrals_t *integrals) {
    event_bracket_t bracket = {0.0, fmax(distance_to_event(setting, start), 0.0), step_s,
                               distance_to_event(setting, end), 0};
    double at_s = step_s;
    for (unsigned iteration = 0; iteration < EVENT_ITERATIONS; iteration++) {
        const double previous_s = at_s;
        at_s = event_bracket_time_s(&bracket);
        integrator_step(setting, start, first, at_s, end, integrals);
        const double at = distance_to_event(setting, end);
        if (at == 0.0 || fabs(at_s - previous_s) < EVENT_TOLERANCE_S) {
            break;
        }
        event_bracket_narrow(&bracket, at_s, at);
    }
    return at_s;
}

/* After a step that ended at an event: sets a current that reached zero, or a DC-link voltage that reached a threshold,
 * exactly to that value. */
static void snap_to_event(const integrator_setting_t *setting, integrator_state_t *end) {
    for (unsigned index = 0; index < setting->count; index++) {
        end->current_A[index] = fmax(end->current_A[index], 0.0);
    }
    if (setting->friction_sign != 0.0 && fabs(end->speed_rad_s) < SPEED_TOLERANCE_RAD_S) {
        end->speed_rad_s = 0.0;
    }
    if (setting->link) {
        const thresholds_t thresholds = thresholds_of(setting);
        if (fabs(end->bus_voltage_V - thresholds.rising_V) < THRESHOLD_TOLERANCE_V) {
            end->bus_voltage_V = thresholds.rising_V;
        } else if (fabs(end->bus_voltage_V - thresholds.falling_V) < THRESHOLD_TOLERANCE_V) {
            end->bus_voltage_V = thresholds.falling_V;
        }
    }
}

/* --- Observation --- */

static void sample_now(plant_t *plant) {
    plant->sample(plant->sample_context, plant);
    plant->sample_next_ns += plant->sample_step_ns;
}

/* Takes the samples within a step that began `start_s` after plant->time_ns, before `limit_ns` and not after the end of
 * the step. */
static void sample_step(plant_t *plant, const integrator_setting_t *setting, const integrator_state_t *start,
                        const integrator_derivative_t *first, const integrator_state_t *end, double start_s,
                        double step_s, uint64_t limit_ns) {
    double at_s = (double)(plant->sample_next_ns - plant->time_ns) * NS_S;
    if (plant->sample_next_ns >= limit_ns || at_s > start_s + step_s) {
        return;
    }
    integrator_derivative_t last;
    integrator_differentiate(setting, end, &last);
    const uint64_t time_ns = plant->time_ns;
    const double angle_rad = plant->rotor_angle_rad, speed_rad_s = plant->speed_rad_s, link_V = plant->bus_voltage_V;
    double current_A[HAL_PHASES_MAX];
    memcpy(current_A, plant->current_A, sizeof current_A);
    do {
        const double x = (at_s - start_s) / step_s;
        plant->time_ns = plant->sample_next_ns;
        plant->rotor_angle_rad =
            hermite(x, step_s, start->angle_rad, start->speed_rad_s, end->angle_rad, end->speed_rad_s);
        plant->speed_rad_s = hermite(x, step_s, start->speed_rad_s, first->acceleration_rad_s2, end->speed_rad_s,
                                     last.acceleration_rad_s2);
        if (setting->link) {
            plant->bus_voltage_V =
                hermite(x, step_s, start->bus_voltage_V, first->link_V_s, end->bus_voltage_V, last.link_V_s);
        }
        for (unsigned index = 0; index < setting->count; index++) {
            const double at_A = hermite(x, step_s, start->current_A[index], first->current_A_s[index],
                                        end->current_A[index], last.current_A_s[index]);
            plant->current_A[setting->phase[index]] = at_A > 0.0 ? at_A : 0.0;
        }
        sample_now(plant);
        at_s = (double)(plant->sample_next_ns - time_ns) * NS_S;
    } while (plant->sample_next_ns < limit_ns && at_s <= start_s + step_s);
    plant->time_ns = time_ns;
    plant->rotor_angle_rad = angle_rad;
    plant->speed_rad_s = speed_rad_s;
    plant->bus_voltage_V = link_V;
    memcpy(plant->current_A, current_A, sizeof current_A);
}

void plant_observe(plant_t *plant, uint64_t first_ns, uint64_t step_ns, plant_sample_t sample, void *context) {
    plant->sample = step_ns > 0 ? sample : NULL;
    plant->sample_context = context;
    plant->sample_step_ns = step_ns;
    plant->sample_next_ns = first_ns;
    if (step_ns > 0 && first_ns < plant->time_ns) {
        plant->sample_next_ns += (plant->time_ns - first_ns + step_ns - 1) / step_ns * step_ns;
    }
}

/* --- Time --- */

/* Finds the range of rotor angles around the present one in which the magnetics of all phases are smooth. */
static void find_smooth_range(plant_t *plant) {
    double forward_rad = INFINITY, backward_rad = INFINITY;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        const double angle_rad = plant_phase_angle_rad(plant, phase);
        forward_rad = fmin(forward_rad, magnetics_smooth_distance_rad(&plant->magnetics, angle_rad, 1.0));
        backward_rad = fmin(backward_rad, magnetics_smooth_distance_rad(&plant->magnetics, angle_rad, -1.0));
    }
    plant->smooth_from_rad = plant->rotor_angle_rad - backward_rad;
    plant->smooth_to_rad = plant->rotor_angle_rad + forward_rad;
}

/* Longest step within the limits that does not cross a point where the magnetics are not smooth. */
MAGNETICS_INLINE double step_length_s(plant_t *plant, const integrator_setting_t *setting,
                                      const integrator_derivative_t *first, double remaining_s) {
    const double speed_rad_s = fabs(plant->speed_rad_s);
    double limit_s = plant->together_step_max_s;
    if (speed_rad_s * limit_s > plant->step_angle_rad) {
        limit_s = plant->step_angle_rad / speed_rad_s;
    }
    for (unsigned index = 0; index < setting->count; index++) {
        const double slope_A_s = fabs(first->current_A_s[index]);
        if (slope_A_s * limit_s > plant->step_current_A) {
            limit_s = plant->step_current_A / slope_A_s;
        }
    }
    double step_s = remaining_s;
    if (remaining_s > limit_s) {
        step_s = remaining_s / ceil(remaining_s / limit_s);
    }
    if (setting->count == 0) {
        return step_s;
    }

    const double angle_rad = plant->rotor_angle_rad;
    if (angle_rad < plant->smooth_from_rad + MAGNETICS_SMOOTH_TOLERANCE_RAD ||
        angle_rad > plant->smooth_to_rad - MAGNETICS_SMOOTH_TOLERANCE_RAD) {
        find_smooth_range(plant);
    }
    /* The acceleration matters: from standstill it alone moves the rotor to that point. */
    const double acceleration_rad_s2 = first->acceleration_rad_s2;
    const bool forward = plant->speed_rad_s > 0.0 || (plant->speed_rad_s == 0.0 && acceleration_rad_s2 > 0.0);
    const double distance_rad = forward ? plant->smooth_to_rad - angle_rad : angle_rad - plant->smooth_from_rad;
    const double along_rad_s2 = forward ? acceleration_rad_s2 : -acceleration_rad_s2;
    if (step_s * (speed_rad_s + 0.5 * along_rad_s2 * step_s) > distance_rad) {
        step_s =
            2.0 * distance_rad / (speed_rad_s + sqrt(speed_rad_s * speed_rad_s + 2.0 * along_rad_s2 * distance_rad));
    }
    return step_s;
}

/* The dynamometer takes what the machine gives and neither load, friction nor the rotor's kinetic energy takes. */
static double dynamometer_J(const plant_t *plant, const integrator_integrals_t *integrals, double speed_change_rad_s) {
    const double mean_rad_s = plant->speed_rad_s + 0.5 * speed_change_rad_s;
    return integrals->mechanical_J - plant->load_torque_Nm * integrals->angle_rad -
           plant->friction_Nm_s * integrals->speed2_rad2_s - plant->inertia_kg_m2 * speed_change_rad_s * mean_rad_s;
}

MAGNETICS_INLINE void add_shaft_energies(plant_t *plant, const integrator_integrals_t *integrals,
                                         double speed_change_rad_s) {
    plant->energy_load_J += plant->load_torque_Nm * integrals->angle_rad;
    if (plant->held) {
        plant->energy_load_J += dynamometer_J(plant, integrals, speed_change_rad_s);
    }
    plant->energy_friction_J += plant->friction_Nm_s * integrals->speed2_rad2_s;
}

/* Adds the energies of source and chopper: Vs (Vs - Vdc) / Rs, (Vs - Vdc)^2 / Rs and Vdc^2 / Rc, integrated. */
MAGNETICS_INLINE void add_link_energies(plant_t *plant, const integrator_setting_t *setting,
                                        const integrator_integrals_t *integrals, double step_s) {
    const dc_link_t *link = &plant->machine->dc_link;
    if (setting->source_conducts) {
        const double supply_V = plant->supply_voltage_V;
        plant->energy_supplied_J += supply_V * (supply_V * step_s - integrals->link_Vs) / link->source_resistance_ohm;
        plant->energy_source_J += (supply_V * (supply_V * step_s - 2.0 * integrals->link_Vs) + integrals->link2_V2s) /
                                  link->source_resistance_ohm;
    }
    if (setting->chopper_on) {
        plant->energy_chopper_J += integrals->link2_V2s / link->chopper_resistance_ohm;
    }
}

/* Within this distance of its threshold a comparator responds. */
#define TRIP_TOLERANCE_A 1e-6

/* Events in succession after steps as short as that are those of a current that either side of zero drives back: an
 * earthed winding's, when the voltages of the others hold it there. A step of PASS_S then passes them, and leaves it at
 * zero or above. */
#define CHATTER_EVENTS 8u
#define CHATTER_STEP_S 1e-12
#define PASS_S 1e-7

/* Integrates from time_ns to `to_ns` with constant switch states, or to the time at which a comparator opens them. */
static void integrate(plant_t *plant, uint64_t to_ns) {
    double length_s = (double)(to_ns - plant->time_ns) * NS_S;
    integrator_setting_t setting;
    integrator_state_t start, end;
    bool find = true;
    unsigned chatter = 0;
    for (double at_s = 0.0; at_s < length_s;) {
        integrator_derivative_t first;
        integrator_integrals_t integrals;
        if (find) {
            find_setting(plant, &setting);
            start.angle_rad = plant->rotor_angle_rad;
            start.speed_rad_s = plant->speed_rad_s;
            start.bus_voltage_V = plant->bus_voltage_V;
            for (unsigned index = 0; index < setting.count; index++) {
                start.current_A[index] = plant->current_A[setting.phase[index]];
            }
        }
        integrator_differentiate(&setting, &start, &first);
        double step_s = step_length_s(plant, &setting, &first, length_s - at_s);
        const bool passes = chatter >= CHATTER_EVENTS;
        step_s = passes && step_s > PASS_S ? PASS_S : step_s;
        integrator_step(&setting, &start, &first, step_s, &end, &integrals);
        const bool event = !passes && distance_to_event(&setting, &end) < 0.0;
        if (passes) {
            snap_to_event(&setting, &end);
        }
        chatter = event ? chatter : 0;
        if (event) {
            step_s = step_to_event(&setting, &start, &first, step_s, &end, &integrals);
            snap_to_event(&setting, &end);
            chatter = step_s < CHATTER_STEP_S ? chatter + 1u : 0;
        }
        if (plant->sample != NULL) {
            sample_step(plant, &setting, &start, &first, &end, at_s, step_s, to_ns);
        }
        faulted_add_energies(plant, &setting, &integrals, step_s);
        add_shaft_energies(plant, &integrals, end.speed_rad_s - start.speed_rad_s);
        if (setting.link) {
            add_link_energies(plant, &setting, &integrals, step_s);
        }
        plant->rotor_angle_rad = end.angle_rad;
        plant->speed_rad_s = end.speed_rad_s;
        plant->bus_voltage_V = end.bus_voltage_V;
        for (unsigned index = 0; index < setting.count; index++) {
            plant->current_A[setting.phase[index]] = end.current_A[index];
        }
        at_s += step_s;
        if (event && distance_to_trip(&setting, &end) < TRIP_TOLERANCE_A) {
            plant->trip_ns = plant->time_ns + (uint64_t)ceil(at_s / NS_S) + PLANT_TRIP_RESPONSE_NS;
            if (plant->trip_ns < to_ns) {
                to_ns = plant->trip_ns;
                length_s = (double)(to_ns - plant->time_ns) * NS_S;
            }
        }
        start = end;
        find = event || passes || setting.stuck;
    }
    plant->time_ns = to_ns;
}

void plant_advance(plant_t *plant, uint64_t to_ns) {
    while (plant->time_ns < to_ns) {
        if (plant->trip_ns <= plant->time_ns) {
            plant->trip_ns = UINT64_MAX;
            plant->tripped = true;
            plant_open_all(plant);
        }
        if (plant->sample != NULL && plant->sample_next_ns == plant->time_ns) {
            sample_now(plant);
        }
        if (phase_steps_advance(plant, to_ns)) {
            continue;
        }
        const uint64_t edge_ns = plant_follow_edges(plant, to_ns);
        integrate(plant, plant->trip_ns < edge_ns ? plant->trip_ns : edge_ns);
        plant_follow_edges(plant, to_ns);
    }
    if (plant->sample != NULL && plant->sample_next_ns == plant->time_ns) {
        sample_now(plant);
    }
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
