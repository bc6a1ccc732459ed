#include "plant/phase_steps.h"

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "plant/link_steps.h"
#include "plant/magnetics_kernel.h"
#include "plant/min_max.h"
#include "plant/phase_samples.h"
#include "plant/phase_walk.h"
#include "plant/rotor_step.h"
#include "plant/units.h"

/* Limit at factor 1 of the feedback from the torque through the angle to the currents, which a step neglects but for
 * the correction at its end: (d psi / d theta)^2 h^2 / (L J). */
#define COUPLING_MAX 3e-5
/* Change of a current in a step, in limits of the common steps of all phases: 0.15 of saturation_A at factor 1. */
#define CURRENT_STEPS (0.15 / 0.09)

static inline bool conducts(const rotor_step_t *rotor, double current_A, unsigned on) {
    return current_A >= PLANT_CURRENT_NEGLIGIBLE_A || (on == 2 && rotor->driven);
}

static bool is_busy(const plant_t *plant, unsigned phase) {
    return plant->phase[phase].known || plant->edge_next[phase] < plant->pattern[phase].count;
}

/* Integrates the phases over a step of the rotor, one after the other. */
MAGNETICS_INLINE bool walk_apart(plant_t *plant, magnetics_form_t form, const rotor_step_t *rotor, sums_t *sums,
                                 phase_record_t *records) {
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        if (is_busy(plant, phase)) {
            walk_t walk;
            walk_start(plant, form, phase, rotor, &walk);
            while (walk.end_s < rotor->length_s) {
                if (walk_begin(plant, form, phase, rotor, NULL, &walk) &&
                    !walk_end(plant, form, phase, rotor, NULL, &walk, sums, records != NULL ? &records[phase] : NULL)) {
                    return false;
                }
            }
            walk_finish(plant, phase, rotor, &walk, sums);
        }
    }
    return true;
}

/* Ends a phase's step earlier, where the source or the chopper switch. */
static void cut(walk_t *walk, double end_s) {
    walk->end_s = end_s;
    walk->step_s = end_s - walk->at_s;
    walk->end_A = walk->current_A + walk->step_s * (walk->current_A_s + 0.5 * walk->step_s * walk->bend_A_s2);
    walk->corner = false;
}

/* Ends the phase's steps up to `at_s` and begins the next ones. False: as walk_end. */
MAGNETICS_INLINE bool walk_on(plant_t *plant, magnetics_form_t form, unsigned phase, const rotor_step_t *rotor,
                              link_t *link, double at_s, walk_t *walk, sums_t *sums, phase_record_t *records) {
    while (walk->end_s <= at_s) {
        phase_record_t *record = records != NULL ? &records[phase] : NULL;
        if (walk->active && !walk_end(plant, form, phase, rotor, link, walk, sums, record)) {
            return false;
        }
        if (walk->end_s >= rotor->length_s) {
            walk_finish(plant, phase, rotor, walk, sums);
            return true;
        }
        walk->active = walk_begin(plant, form, phase, rotor, link, walk);
    }
    return true;
}

/* The same with a link: in the order of time. */
MAGNETICS_INLINE bool walk_together(plant_t *plant, magnetics_form_t form, const rotor_step_t *rotor, link_t *link,
                                    sums_t *sums, phase_record_t *records) {
    walk_t walks[HAL_PHASES_MAX];
    unsigned phase_of[HAL_PHASES_MAX], count = 0;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        if (is_busy(plant, phase)) {
            walk_start(plant, form, phase, rotor, &walks[count]);
            walks[count].active = false;
            phase_of[count++] = phase;
        }
    }
    for (double at_s = 0.0;;) {
        double next_s = rotor->length_s;
        for (unsigned n = 0; n < count; n++) {
            if (!walk_on(plant, form, phase_of[n], rotor, link, at_s, &walks[n], sums, records)) {
                return false;
            }
            next_s = min_double(walks[n].end_s, next_s);
        }
        if (at_s >= rotor->length_s) {
            return true;
        }
        if (__builtin_expect(!link_advance(link, next_s), 0)) {
            for (unsigned n = 0; n < count; n++) {
                if (walks[n].active && walks[n].on != 1 && walks[n].end_s > link->at_s) {
                    cut(&walks[n], link->at_s);
                }
            }
        }
        at_s = link->at_s;
    }
}

/* Torque of the phases at the start of the rotor's step, its time derivative, and the feedback from it through the
 * angle to the currents. */
typedef struct {
    double torque_Nm, torque_Nm_s, coupling_1_s2;
} start_torque_t;

/* Prepares the phases. */
MAGNETICS_INLINE start_torque_t start_phases(plant_t *plant, magnetics_form_t form, const rotor_step_t *rotor) {
    const double speed_rad_s = rotor->speed_rad_s, angle_rad = rotor->angle_rad;
    start_torque_t start = {0.0, 0.0, 0.0};
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        plant_phase_t *state = &plant->phase[phase];
        const double current_A = plant->current_A[phase];
        const unsigned on = half_bridge_on(plant->switches[phase]);
        if (!conducts(rotor, current_A, on)) {
            state->known = false;
            state->current_A = state->flux_Wb = 0.0;
            continue;
        }
        if (!(state->known && state->current_A == current_A && state->angle_rad == angle_rad)) {
            state->current_A = current_A;
            magnetics_kernel(&plant->magnetics, form, angle_rad - phase * plant->phase_offset_rad, current_A,
                             rotor->ahead_rad, &state->point);
            state->inverse_1_H = 1.0 / state->point.incremental_inductance_H;
            state->flux_Wb = state->point.flux_linkage_Wb;
            state->known = true;
        }
        const double gradient_Wb_rad = state->point.flux_gradient_Wb_rad;
        const double current_A_s =
            (rotor->voltage_V[on] - plant->resistance_ohm[phase][on] * current_A - speed_rad_s * gradient_Wb_rad) *
            state->inverse_1_H;
        start.torque_Nm += state->point.torque_Nm;
        start.torque_Nm_s += state->point.torque_gradient_Nm_rad * speed_rad_s + gradient_Wb_rad * current_A_s;
        start.coupling_1_s2 += gradient_Wb_rad * gradient_Wb_rad * state->inverse_1_H;
    }
    start.coupling_1_s2 *= 1.0 / plant->inertia_kg_m2;
    return start;
}

/* Length of the rotor's step: a whole part of the time to `to_ns` within the limits. */
static inline uint64_t step_length_ns(const plant_t *plant, double coupling_1_s2, uint64_t to_ns) {
    const double speed_rad_s = fabs(plant->speed_rad_s);
    const plant_limits_t *limits = &plant->limits;
    double limit_s = limits->own_max_s;
    if (speed_rad_s * limit_s > limits->angle_rad) {
        limit_s = limits->angle_rad / speed_rad_s;
    }
    const double coupling_max = limits->factor * limits->factor * COUPLING_MAX;
    if (coupling_1_s2 * limit_s * limit_s > coupling_max) {
        limit_s = sqrt(coupling_max / coupling_1_s2);
    }
    const uint64_t length_ns = to_ns - plant->time_ns;
    if ((double)length_ns * S_PER_NS <= limit_s) {
        return length_ns;
    }
    const uint64_t steps = (uint64_t)ceil((double)length_ns * S_PER_NS / limit_s);
    return (length_ns + steps - 1) / steps;
}

/* Prepares the rotor's step and the phases at its start. */
MAGNETICS_INLINE void start_step(plant_t *plant, magnetics_form_t form, rotor_step_t *rotor, uint64_t to_ns) {
    const double speed_rad_s = plant->speed_rad_s, angle_rad = plant->rotor_angle_rad;
    const double inertia_1 = 1.0 / plant->inertia_kg_m2;
    for (unsigned on = 0; on < 3; on++) {
        rotor->voltage_V[on] = ((double)on - 1.0) * plant->bus_voltage_V - plant->drop_V[on];
    }
    rotor->driven = rotor->voltage_V[2] > 0.0;
    rotor->trip_current_A = plant->tripped ? INFINITY : plant->trip_current_A;
    rotor->current_step_A = CURRENT_STEPS * plant->limits.current_A;
    rotor->angle_rad = angle_rad;
    rotor->speed_rad_s = speed_rad_s;
    rotor->start_ns = (uint32_t)(plant->time_ns - plant->pattern_ns);
    rotor->ahead_rad = copysign(2.0 * MAGNETICS_SMOOTH_TOLERANCE_RAD, speed_rad_s);

    start_torque_t start = start_phases(plant, form, rotor);
    rotor->acceleration_rad_s2 =
        (start.torque_Nm - plant->friction_Nm_s * speed_rad_s - plant->load_torque_Nm) * inertia_1;
    rotor->jerk_rad_s3 = (start.torque_Nm_s - plant->friction_Nm_s * rotor->acceleration_rad_s2) * inertia_1;
    if (plant->held) {
        rotor->acceleration_rad_s2 = plant->held_acceleration_rad_s2;
        rotor->jerk_rad_s3 = start.coupling_1_s2 = 0.0;
    }
    rotor->half_rad_s2 = 0.5 * rotor->acceleration_rad_s2;
    rotor->half_rad_s3 = 0.5 * rotor->jerk_rad_s3;
    rotor->length_ns = step_length_ns(plant, start.coupling_1_s2, to_ns);
    rotor->length_s = (double)rotor->length_ns * S_PER_NS;
    /* A generous bound: beyond it a phase takes a corner's place for its own. */
    const double reach_rad =
        1.1 * rotor->length_s * (fabs(speed_rad_s) + 2.0 * fabs(rotor->acceleration_rad_s2) * rotor->length_s);
    rotor->least_rad = angle_rad - (speed_rad_s > 0.0 ? 0.1 : 1.0) * reach_rad;
    rotor->most_rad = angle_rad + (speed_rad_s < 0.0 ? 0.1 : 1.0) * reach_rad;
}

/* Adds the energies of a step: `turn_rad` and `gain_rad_s` are the changes of angle and speed. */
static void add_energies(plant_t *plant, const rotor_step_t *rotor, const sums_t *sums, bool linked, double turn_rad,
                         double gain_rad_s) {
    const double link_V = linked ? 1.0 : plant->bus_voltage_V; /* of charges */
    plant->energy_drawn_J += link_V * sums->link[2];
    plant->energy_returned_J += link_V * sums->link[0];
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        plant->energy_copper_J += sums->copper_J[phase];
        plant->energy_converter_J += sums->converter_J[phase];
        plant->phase_copper_J[phase] += sums->copper_J[phase];
        plant->phase_converter_J[phase] += sums->converter_J[phase];
    }
    /* Mean square of a speed whose course is a straight line. */
    const double speed2_rad2_s =
        turn_rad * turn_rad / rotor->length_s + rotor->length_s * gain_rad_s * gain_rad_s / 12.0;
    const double friction_J = plant->friction_Nm_s * speed2_rad2_s;
    plant->energy_friction_J += friction_J;
    if (plant->held) {
        /* The dynamometer and the load take what the rotor and its friction do not. */
        const double mechanical_J =
            rotor->speed_rad_s * sums->impulse_Nms +
            rotor->acceleration_rad_s2 * (rotor->length_s * sums->impulse_Nms - sums->moment_Nms2);
        plant->energy_load_J +=
            mechanical_J - friction_J - plant->inertia_kg_m2 * gain_rad_s * (rotor->speed_rad_s + 0.5 * gain_rad_s);
    } else {
        plant->energy_load_J += plant->load_torque_Nm * turn_rad;
    }
}

/* Changes of angle and speed over a step, from the torque's integrals. */
static void turn(const plant_t *plant, const rotor_step_t *rotor, const sums_t *sums, double predicted_rad,
                 double *turn_rad, double *gain_rad_s) {
    const double h = rotor->length_s, acceleration_rad_s2 = rotor->acceleration_rad_s2;
    if (plant->held) {
        *turn_rad = predicted_rad;
        *gain_rad_s = acceleration_rad_s2 * h;
        return;
    }
    const double inertia_1 = 1.0 / plant->inertia_kg_m2, friction_Nm_s = plant->friction_Nm_s;
    const double net_Nms = sums->impulse_Nms - plant->load_torque_Nm * h;
    /* The friction's moment from a parabola of the speed, whose end is that without the angle's correction. */
    const double bend_rad_s = (net_Nms - friction_Nm_s * predicted_rad) * inertia_1 - acceleration_rad_s2 * h;
    const double friction_Nms2 =
        friction_Nm_s * h * h *
        (0.5 * rotor->speed_rad_s + (1.0 / 6.0) * acceleration_rad_s2 * h + (1.0 / 12.0) * bend_rad_s);
    *turn_rad =
        h * rotor->speed_rad_s + (sums->moment_Nms2 - 0.5 * plant->load_torque_Nm * h * h - friction_Nms2) * inertia_1;
    *gain_rad_s = (net_Nms - friction_Nm_s * *turn_rad) * inertia_1;
}

/* The end of a step: the phase's flux linkage stays, and its current follows the correction of the angle. */
MAGNETICS_INLINE void correct(plant_phase_t *state, double end_rad, double correction_rad) {
    magnetics_point_t *point = &state->point;
    const double more_A = -point->flux_gradient_Wb_rad * state->inverse_1_H * correction_rad;
    if (state->current_A + more_A > 0.0) {
        state->current_A += more_A;
        point->torque_Nm += point->torque_gradient_Nm_rad * correction_rad + point->flux_gradient_Wb_rad * more_A;
        point->flux_gradient_Wb_rad +=
            point->flux_curvature_Wb_rad2 * correction_rad + point->inductance_gradient_H_rad * more_A;
    }
    state->angle_rad = end_rad;
}

void phase_steps_reset(plant_t *plant) {
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        plant->phase[phase] = (plant_phase_t){.smooth = SMOOTH_RANGE_EMPTY};
    }
}

/* Values of a step that its samples need. */
typedef struct {
    phase_record_t phases[HAL_PHASES_MAX];
    link_record_t link;
} records_t;

/* Walks the phases through the rotor's step. records NULL: not recorded. False: it does not apply. */
MAGNETICS_INLINE bool walk_phases(plant_t *plant, magnetics_form_t form, bool linked, const rotor_step_t *rotor,
                                  link_t *link, sums_t *sums, records_t *records) {
    phase_record_t *phases = NULL;
    if (records != NULL) {
        phases = records->phases;
        for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
            phases[phase].count = 0;
        }
        records->link.count = 0;
    }
    if (!linked) {
        return walk_apart(plant, form, rotor, sums, phases);
    }
    link_start(link, plant, records != NULL ? &records->link : NULL);
    return walk_together(plant, form, rotor, link, sums, phases) &&
           !(records != NULL && records->link.count > LINK_STEPS_MAX);
}

/* The end of the rotor's step becomes the present state. */
MAGNETICS_INLINE void finish(plant_t *plant, const rotor_step_t *rotor, const sums_t *sums, double turn_rad,
                             double gain_rad_s, double correction_rad) {
    plant->time_ns += rotor->length_ns;
    plant->rotor_angle_rad = rotor->angle_rad + turn_rad;
    plant->speed_rad_s = rotor->speed_rad_s + gain_rad_s;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        if (sums->walked >> phase & 1u) {
            plant->switches[phase] = sums->switches[phase];
            plant->edge_next[phase] = sums->edge_next[phase];
            if (plant->phase[phase].known) {
                correct(&plant->phase[phase], plant->rotor_angle_rad, correction_rad);
            }
        }
        plant->current_A[phase] = plant->phase[phase].current_A;
    }
}

MAGNETICS_INLINE bool advance_of(plant_t *plant, magnetics_form_t form, bool linked, uint64_t to_ns) {
    records_t records;
    rotor_step_t rotor;
    start_step(plant, form, &rotor, to_ns);
    const uint64_t end_ns = plant->time_ns + rotor.length_ns;
    const bool sampled = plant->observation.sample != NULL && plant->observation.next_ns < end_ns;
    link_t link;
    sums_t sums = {0};
    if (!walk_phases(plant, form, linked, &rotor, &link, &sums, sampled ? &records : NULL)) {
        phase_steps_reset(plant);
        return false;
    }
    double predicted_rad, predicted_rad_s, turn_rad, gain_rad_s;
    rotor_at(&rotor, rotor.length_s, &predicted_rad, &predicted_rad_s);
    predicted_rad -= rotor.angle_rad;
    turn(plant, &rotor, &sums, predicted_rad, &turn_rad, &gain_rad_s);
    if (sampled) {
        phase_samples_take(plant, &rotor, turn_rad - predicted_rad, records.phases, &records.link, end_ns);
    }
    add_energies(plant, &rotor, &sums, linked, turn_rad, gain_rad_s);
    if (linked) {
        link_finish(&link, plant);
    }
    finish(plant, &rotor, &sums, turn_rad, gain_rad_s, turn_rad - predicted_rad);
    return true;
}

MAGNETICS_INLINE bool advance_in(plant_t *plant, bool linked, uint64_t to_ns) {
    switch (plant->magnetics.form) {
    case MAGNETICS_LINEAR_COSINE:
        return advance_of(plant, MAGNETICS_LINEAR_COSINE, linked, to_ns);
    case MAGNETICS_LINEAR_TRAPEZOID:
        return advance_of(plant, MAGNETICS_LINEAR_TRAPEZOID, linked, to_ns);
    case MAGNETICS_SATURATING:
        return advance_of(plant, MAGNETICS_SATURATING, linked, to_ns);
    case MAGNETICS_MAP:
        return advance_of(plant, MAGNETICS_MAP, linked, to_ns);
    }
    return false;
}

/* Two functions, because the compiler allocates registers worse in one: 4 % more instructions. */
static __attribute__((noinline)) bool advance_without_link(plant_t *plant, uint64_t to_ns) {
    return advance_in(plant, false, to_ns);
}

static __attribute__((noinline)) bool advance_with_link(plant_t *plant, uint64_t to_ns) {
    return advance_in(plant, true, to_ns);
}

bool phase_steps_advance(plant_t *plant, uint64_t to_ns) {
    if (plant->faulted || plant->trip_ns != UINT64_MAX) {
        return false;
    }
    return plant_has_link(plant) ? advance_with_link(plant, to_ns) : advance_without_link(plant, to_ns);
}
