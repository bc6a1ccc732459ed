#include "plant/common_steps.h"

#include <math.h>
#include <string.h>

#include "plant/coupled.h"
#include "plant/event_bracket.h"
#include "plant/faulted.h"
#include "plant/hermite.h"
#include "plant/integrator.h"
#include "plant/magnetics_kernel.h"
#include "plant/min_max.h"
#include "plant/units.h"

/* After an event, a DC-link voltage within this tolerance of its threshold is set to it. */
#define THRESHOLD_TOLERANCE_V 1e-6
/* After an event, a slower shaft with friction stands still. */
#define SPEED_TOLERANCE_RAD_S 1e-6

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
    setting->coupled = plant->coupled.present ? &plant->coupled : NULL;
    setting->inertia_kg_m2 = plant->inertia_kg_m2;
    setting->friction_Nm_s = plant->friction_Nm_s;
    setting->load_torque_Nm = plant->load_torque_Nm;
    setting->trip_current_A = plant->trip_ns == UINT64_MAX && !plant->tripped ? plant->trip_current_A : INFINITY;
    setting->held = plant->held;
    setting->held_acceleration_rad_s2 = plant->held_acceleration_rad_s2;
    setting->supply_voltage_V = plant->supply_voltage_V;
    setting->ahead_rad = copysign(2.0 * MAGNETICS_SMOOTH_TOLERANCE_RAD, plant->speed_rad_s);
    setting->link = false; /* until source and chopper are known */
    faulted_find_conducting(plant, setting);
    faulted_find_friction(plant, setting);
    setting->link = plant_has_link(plant);
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

/* A phase's current, not below 0 but in a loop of a coupled machine. */
static double least_current_A(const integrator_setting_t *setting, unsigned index, double current_A) {
    return setting->coupled != NULL && setting->loop[index] ? current_A : max_double(current_A, 0.0);
}

/* After a step that ended at an event: sets a current that reached zero, or a DC-link voltage that reached a threshold,
 * exactly to that value. */
static void snap_to_event(const integrator_setting_t *setting, integrator_state_t *end) {
    for (unsigned index = 0; index < setting->count; index++) {
        end->current_A[index] = least_current_A(setting, index, end->current_A[index]);
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

/* Takes the samples within a step that began `start_s` after plant->time_ns, before `limit_ns` and not after the end of
 * the step. */
static void sample_step(plant_t *plant, const integrator_setting_t *setting, const integrator_state_t *start,
                        const integrator_derivative_t *first, const integrator_state_t *end, double start_s,
                        double step_s, uint64_t limit_ns) {
    double at_s = (double)(plant->observation.next_ns - plant->time_ns) * S_PER_NS;
    if (plant->observation.next_ns >= limit_ns || at_s > start_s + step_s) {
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
        plant->time_ns = plant->observation.next_ns;
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
            plant->current_A[setting->phase[index]] = least_current_A(setting, index, at_A);
        }
        plant_take_sample(plant);
        at_s = (double)(plant->observation.next_ns - time_ns) * S_PER_NS;
    } while (plant->observation.next_ns < limit_ns && at_s <= start_s + step_s);
    plant->time_ns = time_ns;
    plant->rotor_angle_rad = angle_rad;
    plant->speed_rad_s = speed_rad_s;
    plant->bus_voltage_V = link_V;
    memcpy(plant->current_A, current_A, sizeof current_A);
}

/* Finds the range of rotor angles around the present one in which the magnetics of all phases are smooth. */
static void find_smooth_range(plant_t *plant) {
    double forward_rad = INFINITY, backward_rad = INFINITY;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        const double angle_rad = plant_phase_angle_rad(plant, phase);
        forward_rad = fmin(forward_rad, magnetics_smooth_distance_rad(&plant->magnetics, angle_rad, 1.0));
        backward_rad = fmin(backward_rad, magnetics_smooth_distance_rad(&plant->magnetics, angle_rad, -1.0));
    }
    plant->smooth.from_rad = plant->rotor_angle_rad - backward_rad;
    plant->smooth.to_rad = plant->rotor_angle_rad + forward_rad;
}

/* Longest step within the limits that does not cross a point where the magnetics are not smooth. */
MAGNETICS_INLINE double step_length_s(plant_t *plant, const integrator_setting_t *setting,
                                      const integrator_derivative_t *first, double remaining_s) {
    const double speed_rad_s = fabs(plant->speed_rad_s);
    double limit_s = plant->limits.common_max_s;
    if (speed_rad_s * limit_s > plant->limits.angle_rad) {
        limit_s = plant->limits.angle_rad / speed_rad_s;
    }
    for (unsigned index = 0; index < setting->count; index++) {
        const double slope_A_s = fabs(first->current_A_s[index]);
        if (slope_A_s * limit_s > plant->limits.current_A) {
            limit_s = plant->limits.current_A / slope_A_s;
        }
    }
    if (setting->coupled != NULL) {
        limit_s = min_double(limit_s, coupled_loop_step_s(plant, setting));
    }
    double step_s = remaining_s;
    if (remaining_s > limit_s) {
        step_s = remaining_s / ceil(remaining_s / limit_s);
    }
    if (setting->count == 0) {
        return step_s;
    }
    if (setting->coupled != NULL) {
        step_s = min_double(step_s, coupled_reversal_s(plant, setting, first));
    }

    const double angle_rad = plant->rotor_angle_rad, acceleration_rad_s2 = first->acceleration_rad_s2;
    if (!smooth_range_has(&plant->smooth, angle_rad)) {
        find_smooth_range(plant);
    }
    const double corner_rad = smooth_range_ahead_rad(&plant->smooth, plant->speed_rad_s, acceleration_rad_s2);
    smooth_range_shorten(angle_rad, plant->speed_rad_s, acceleration_rad_s2, corner_rad, &step_s);
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

/* Events in succession after steps as short as that come from a current that either side of zero drives back: an
 * earthed winding's, when the voltages of the others hold it there. A step of PASS_S then passes them, and leaves it at
 * zero or above. */
#define CHATTER_EVENTS 8u
#define CHATTER_STEP_S 1e-12
#define PASS_S 1e-7

/* A step, from `start`, where the derivatives are `first`, to `end`. */
typedef struct {
    integrator_setting_t setting;
    integrator_state_t start, end;
    integrator_derivative_t first;
    integrator_integrals_t integrals;
    double at_s, length_s; /* its start after plant->time_ns; how long it is */
    bool event, passes;    /* it ends at an event; it passes the events of a current that chatters */
    unsigned chatter;      /* events in succession */
} common_step_t;

static void start_from_plant(plant_t *plant, common_step_t *step) {
    find_setting(plant, &step->setting);
    step->start.angle_rad = plant->rotor_angle_rad;
    step->start.speed_rad_s = plant->speed_rad_s;
    step->start.bus_voltage_V = plant->bus_voltage_V;
    for (unsigned index = 0; index < step->setting.count; index++) {
        step->start.current_A[index] = plant->current_A[step->setting.phase[index]];
    }
}

/* Integrates the step, to the next event or for `remaining_s` at most. */
static void integrate(plant_t *plant, common_step_t *step, double remaining_s) {
    const integrator_setting_t *setting = &step->setting;
    integrator_differentiate(setting, &step->start, &step->first);
    double length_s = step_length_s(plant, setting, &step->first, remaining_s);
    step->passes = step->chatter >= CHATTER_EVENTS;
    length_s = step->passes ? min_double(length_s, PASS_S) : length_s;
    integrator_step(setting, &step->start, &step->first, length_s, &step->end, &step->integrals);
    step->event = !step->passes && distance_to_event(setting, &step->end) < 0.0;
    if (step->event) {
        length_s = step_to_event(setting, &step->start, &step->first, length_s, &step->end, &step->integrals);
    }
    if (step->event || step->passes) {
        snap_to_event(setting, &step->end);
    }
    step->chatter = step->event && length_s < CHATTER_STEP_S ? step->chatter + 1u : 0;
    step->length_s = length_s;
}

/* Books the energies of the step, and its end, which becomes the present state. */
static void finish(plant_t *plant, const common_step_t *step) {
    const integrator_setting_t *setting = &step->setting;
    faulted_add_energies(plant, setting, &step->integrals, step->length_s);
    add_shaft_energies(plant, &step->integrals, step->end.speed_rad_s - step->start.speed_rad_s);
    if (setting->link) {
        add_link_energies(plant, setting, &step->integrals, step->length_s);
    }
    plant->rotor_angle_rad = step->end.angle_rad;
    plant->speed_rad_s = step->end.speed_rad_s;
    plant->bus_voltage_V = step->end.bus_voltage_V;
    for (unsigned index = 0; index < setting->count; index++) {
        plant->current_A[setting->phase[index]] = step->end.current_A[index];
    }
}

void common_steps_advance(plant_t *plant, uint64_t to_ns) {
    double length_s = (double)(to_ns - plant->time_ns) * S_PER_NS;
    common_step_t step = {.chatter = 0};
    bool changed = true; /* the plant's setting */
    for (step.at_s = 0.0; step.at_s < length_s;) {
        if (changed) {
            start_from_plant(plant, &step);
        }
        integrate(plant, &step, length_s - step.at_s);
        if (plant->observation.sample != NULL) {
            sample_step(plant, &step.setting, &step.start, &step.first, &step.end, step.at_s, step.length_s, to_ns);
        }
        finish(plant, &step);
        step.at_s += step.length_s;
        if (step.event && distance_to_trip(&step.setting, &step.end) < TRIP_TOLERANCE_A) {
            plant->trip_ns = plant->time_ns + (uint64_t)ceil(step.at_s / S_PER_NS) + PLANT_TRIP_RESPONSE_NS;
            if (plant->trip_ns < to_ns) {
                to_ns = plant->trip_ns;
                length_s = (double)(to_ns - plant->time_ns) * S_PER_NS;
            }
        }
        step.start = step.end;
        changed = step.event || step.passes || step.setting.stuck;
    }
    plant->time_ns = to_ns;
}
