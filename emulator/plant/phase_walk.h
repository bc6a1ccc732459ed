/* One phase on its way through a step of the rotor: its own steps, from edge to edge (phase_steps.h). Inline, for the
 * form of the magnetics and the link to be constants of the loop. */
#ifndef PLANT_PHASE_WALK_H
#define PLANT_PHASE_WALK_H

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "plant/hermite.h"
#include "plant/link_steps.h"
#include "plant/magnetics_kernel.h"
#include "plant/min_max.h"
#include "plant/phase_samples.h"
#include "plant/plant_state.h"
#include "plant/rotor_step.h"
#include "plant/smooth_range.h"
#include "plant/units.h"

/* Shortest last step before a current ends. */
#define STEP_MIN_S 1e-13
#define END_ITERATIONS 4
/* With a link, a step in which a current is expected to end is longer by this. */
#define END_MARGIN 1.01

/* Integrals of a step of the rotor over all phases. */
typedef struct {
    double impulse_Nms, moment_Nms2; /* of the torque: moment about the end of the step */
    double link[3]; /* by the number of switches that are on: charge; with a link, energy at its voltage */
    double copper_J[HAL_PHASES_MAX], converter_J[HAL_PHASES_MAX]; /* losses of each phase */
    unsigned walked;                                              /* phases that had current or edges: bits */
    uint8_t switches[HAL_PHASES_MAX], edge_next[HAL_PHASES_MAX];  /* theirs at the end */
} sums_t;

/* Shortens a step so that it ends where the phase's magnetics are not smooth; true if it does. */
static bool end_at_corner(const plant_t *plant, unsigned phase, const rotor_step_t *rotor, plant_phase_t *state,
                          double at_s, double angle_rad, double speed_rad_s, double *step_s) {
    if (!smooth_range_has(&state->smooth, angle_rad)) {
        const double phase_rad = angle_rad - phase * plant->phase_offset_rad;
        state->smooth.to_rad = angle_rad + magnetics_smooth_distance_rad(&plant->magnetics, phase_rad, 1.0);
        state->smooth.from_rad = angle_rad - magnetics_smooth_distance_rad(&plant->magnetics, phase_rad, -1.0);
    }
    const double acceleration_rad_s2 = rotor->acceleration_rad_s2;
    const double corner_rad = smooth_range_ahead_rad(&state->smooth, speed_rad_s, acceleration_rad_s2);
    if (!smooth_range_shorten(angle_rad, speed_rad_s, acceleration_rad_s2, corner_rad, step_s)) {
        return false;
    }
    /* The jerk's part of the angle. */
    double end_rad, end_rad_s;
    rotor_at(rotor, at_s + *step_s, &end_rad, &end_rad_s);
    const double missing_rad = corner_rad - end_rad;
    if (fabs(end_rad_s) * *step_s > fabs(missing_rad)) {
        *step_s += missing_rad / end_rad_s;
    }
    return true;
}

/* Shortens a step of a phase that is not driven to the time at which its flux linkage and current end. */
MAGNETICS_INLINE double end_of_current_s(double voltage_V, double ohm, double flux_Wb, const course_t *current,
                                         double step_s) {
    if (voltage_V >= 0.0) {
        return step_s; /* without drops a current decays to what is negligible, and stops there */
    }
    double end_s = fmin(flux_Wb / (0.5 * ohm * current->start - voltage_V), step_s);
    const double bend_A_s = (1.0 / 12.0) * (current->start_1_s - current->end_1_s);
    for (unsigned iteration = 0; iteration < END_ITERATIONS; iteration++) {
        const double rest_Wb = flux_Wb + end_s * (voltage_V - ohm * (0.5 * current->start + end_s * bend_A_s));
        end_s -= rest_Wb / (voltage_V - ohm * (0.5 * current->start + 2.0 * end_s * bend_A_s));
    }
    return fmin(fmax(end_s, STEP_MIN_S), step_s);
}

/* A phase on its way through a step of the rotor. */
typedef struct {
    const half_bridge_pattern_t *pattern;
    plant_phase_t *kept;
    double offset_rad;
    bool corners;     /* within the rotor's step there may be angles where its magnetics are not smooth */
    bool known;       /* as of plant_phase_t; these and the members up to `speed` are at the start of a step */
    uint8_t switches; /* that are on */
    unsigned on;      /* their number */
    unsigned edge;    /* the next one */
    unsigned count;   /* of its steps */
    double current_A, flux_Wb, inverse_1_H;
    magnetics_point_t point;
    double angle_rad, speed_rad_s;
    double impulse_Nms;    /* of its torque */
    double own_A2s, own_J; /* integral of the square of the current; losses */
    /* Present step: */
    double at_s, step_s, end_s;
    bool active; /* it has current */
    bool corner; /* it ends at one */
    double voltage_V, current_A_s, torque_Nm_s;
    double end_A; /* predicted */
    /* Present step with a link: */
    double bend_A_s2;       /* second derivative of the current that the link takes from the capacitor */
    double link_V, area_Vs; /* of the link at its start */
} walk_t;

static const double link_signs[3] = {-1.0, 0.0, 1.0};

MAGNETICS_INLINE void walk_start(plant_t *plant, magnetics_form_t form, unsigned phase, const rotor_step_t *rotor,
                                 walk_t *walk) {
    plant_phase_t *kept = &plant->phase[phase];
    walk->pattern = &plant->pattern[phase];
    walk->kept = kept;
    walk->offset_rad = phase * plant->phase_offset_rad;
    walk->corners = (form == MAGNETICS_SATURATING || form == MAGNETICS_LINEAR_TRAPEZOID) &&
                    !(rotor->least_rad > kept->smooth.from_rad + MAGNETICS_SMOOTH_TOLERANCE_RAD &&
                      rotor->most_rad < kept->smooth.to_rad - MAGNETICS_SMOOTH_TOLERANCE_RAD);
    walk->known = kept->known;
    walk->switches = plant->switches[phase];
    walk->on = half_bridge_on(walk->switches);
    walk->edge = plant->edge_next[phase];
    walk->count = 0;
    walk->current_A = kept->current_A;
    walk->flux_Wb = kept->flux_Wb;
    walk->inverse_1_H = kept->inverse_1_H;
    walk->point = kept->point;
    walk->angle_rad = rotor->angle_rad;
    walk->speed_rad_s = rotor->speed_rad_s;
    walk->impulse_Nms = walk->own_A2s = walk->own_J = 0.0;
    walk->end_s = 0.0;
}

/* The voltage of the link acts on the phase; freewheeling, it does not notice the link. */
MAGNETICS_INLINE bool is_tied(const link_t *link, unsigned on) {
    return link != NULL && on != 1;
}

/* Follows the edges up to the end of the step before, from where the next one lasts to the next edge at most. */
MAGNETICS_INLINE void follow_edges(const rotor_step_t *rotor, walk_t *walk) {
    const half_bridge_pattern_t *pattern = walk->pattern;
    const double at_s = walk->end_s;
    double until_s = rotor->length_s;
    for (; walk->edge < pattern->count; walk->edge++) {
        const double edge_s = (double)(int32_t)(pattern->delay_ns[walk->edge] - rotor->start_ns) * S_PER_NS;
        if (edge_s > at_s) {
            until_s = min_double(until_s, edge_s);
            break;
        }
        walk->switches = pattern->switches[walk->edge];
        walk->on = half_bridge_on(walk->switches);
    }
    walk->at_s = at_s;
    walk->end_s = until_s;
}

/* Shortens the step from at_s to end_s to its limits, and returns its length. */
MAGNETICS_INLINE double limit_step_s(const plant_t *plant, unsigned phase, const rotor_step_t *rotor, bool tied,
                                     walk_t *walk) {
    const double at_s = walk->at_s, current_A_s = walk->current_A_s;
    double step_s = walk->end_s - at_s;
    const double change_A = fabs(current_A_s) * step_s;
    const double swing_s2_H = tied ? step_s * step_s * walk->inverse_1_H : 0.0;
    if (change_A > rotor->current_step_A || (tied && swing_s2_H > plant->limits.link_swing_s2_H)) {
        double steps = change_A / rotor->current_step_A;
        if (tied && swing_s2_H > steps * steps * plant->limits.link_swing_s2_H) {
            steps = sqrt(swing_s2_H / plant->limits.link_swing_s2_H);
        }
        step_s /= ceil(steps);
        walk->end_s = at_s + step_s;
    }
    if (tied && walk->on == 0 && walk->flux_Wb + walk->voltage_V * step_s < 0.0) {
        /* A little late, so that the current ends in this step. */
        const double ohm = plant->resistance_ohm[phase][walk->on];
        const double ends_s = END_MARGIN * walk->flux_Wb / (0.5 * ohm * walk->current_A - walk->voltage_V);
        if (ends_s < step_s) {
            step_s = ends_s;
            walk->end_s = at_s + step_s;
        }
    }
    walk->corner = walk->corners &&
                   end_at_corner(plant, phase, rotor, walk->kept, at_s, walk->angle_rad, walk->speed_rad_s, &step_s);
    if (walk->corner) {
        walk->end_s = at_s + step_s;
    }
    return step_s;
}

/* Adds the current of a step that begins to that which the link takes from the capacitor; returns the second derivative
 * of the current that the voltages cause. */
MAGNETICS_INLINE double tie(link_t *link, double ohm, double bend_A_s2, walk_t *walk) {
    const double sign = link_signs[walk->on];
    link->drawn_A += sign * walk->current_A;
    link->drawn_A_s += sign * walk->current_A_s;
    bend_A_s2 += (sign * link_slope_V_s(link) - ohm * walk->current_A_s) * walk->inverse_1_H;
    link->drawn_A_s2 += 0.5 * sign * bend_A_s2;
    walk->bend_A_s2 = bend_A_s2;
    walk->link_V = link->voltage_V;
    walk->area_Vs = link->area_Vs;
    return bend_A_s2;
}

/* Begins a phase's next step, which lasts to end_s. False: it has no current until then. */
MAGNETICS_INLINE bool walk_begin(const plant_t *plant, magnetics_form_t form, unsigned phase, const rotor_step_t *rotor,
                                 link_t *link, walk_t *walk) {
    follow_edges(rotor, walk);
    const unsigned on = walk->on;
    const double current_A = walk->current_A, ohm = plant->resistance_ohm[phase][on];
    const bool tied = is_tied(link, on);
    walk->voltage_V = tied ? link_signs[on] * link->voltage_V - plant->drop_V[on] : rotor->voltage_V[on];
    const bool driven = tied ? walk->voltage_V > 0.0 : on == 2 && rotor->driven;
    if (!(current_A >= PLANT_CURRENT_NEGLIGIBLE_A || driven)) {
        walk->current_A = walk->flux_Wb = 0.0;
        walk->known = false;
        return false;
    }
    if (__builtin_expect(!walk->known, 0)) {
        rotor_at(rotor, walk->at_s, &walk->angle_rad, &walk->speed_rad_s);
        magnetics_kernel(&plant->magnetics, form, walk->angle_rad - walk->offset_rad, current_A, rotor->ahead_rad,
                         &walk->point);
        walk->inverse_1_H = 1.0 / walk->point.incremental_inductance_H;
        walk->flux_Wb = walk->point.flux_linkage_Wb;
    }
    const magnetics_point_t *point = &walk->point;
    const double speed_rad_s = walk->speed_rad_s;
    const double current_A_s =
        (walk->voltage_V - ohm * current_A - speed_rad_s * point->flux_gradient_Wb_rad) * walk->inverse_1_H;
    walk->current_A_s = current_A_s;
    walk->torque_Nm_s = point->torque_gradient_Nm_rad * speed_rad_s + point->flux_gradient_Wb_rad * current_A_s;
    const double step_s = walk->step_s = limit_step_s(plant, phase, rotor, tied, walk);

    /* The predicted current, with the part of the second derivative that the current's slope causes. */
    double bend_A_s2 =
        -(2.0 * speed_rad_s * point->inductance_gradient_H_rad + point->inductance_slope_H_A * current_A_s) *
        current_A_s * walk->inverse_1_H;
    if (tied) {
        bend_A_s2 = tie(link, ohm, bend_A_s2, walk);
    }
    walk->end_A = current_A + step_s * (current_A_s + 0.5 * step_s * bend_A_s2);
    return true;
}

/* Takes the phase's step from the link: what its charge was more than planned, and the energy. */
MAGNETICS_INLINE void settle(link_t *link, const walk_t *walk, double step_s, double area_Vs, double charge_As,
                             const course_t *current, double *energy_J) {
    const double sign = link_signs[walk->on], planned_s = walk->step_s;
    const double bend_A_s = planned_s * walk->bend_A_s2;
    const double planned_As =
        planned_s * (current->start + planned_s * (0.5 * current->start_1_s + (1.0 / 6.0) * bend_A_s));
    *energy_J += area_Vs / planned_s * charge_As +
                 (1.0 / 12.0) * step_s * (current->end - current->start) * (link->voltage_V - walk->link_V);
    link->drawn_A -= sign * walk->end_A;
    link->drawn_A_s -= sign * (current->start_1_s + bend_A_s);
    link->drawn_A_s2 -= 0.5 * sign * walk->bend_A_s2;
    link->voltage_V += sign * (link->charge_1_F * (charge_As - planned_As));
}

/* The present step of a phase at its end. */
typedef struct {
    double length_s, voltage_V;
    double area_Vs;   /* of the link over the planned step */
    double driven_Wb; /* flux linkage without the resistance */
    double end_Wb, charge_As, inverse_1_H;
    course_t current, torque;
} walk_end_t;

/* The step as planned. */
MAGNETICS_INLINE void find_end(const plant_t *plant, const link_t *link, bool tied, const walk_t *walk,
                               walk_end_t *end) {
    const unsigned on = walk->on;
    end->length_s = walk->step_s;
    end->voltage_V = walk->voltage_V;
    end->area_Vs = 0.0;
    end->driven_Wb = walk->flux_Wb + end->voltage_V * end->length_s;
    if (tied) {
        const double sign = link_signs[on];
        end->area_Vs = link->area_Vs - walk->area_Vs;
        end->voltage_V = sign * link->voltage_V - plant->drop_V[on];
        end->driven_Wb = walk->flux_Wb + (sign * end->area_Vs - plant->drop_V[on] * end->length_s);
    }
    end->current.start = walk->current_A;
    end->current.start_1_s = walk->current_A_s;
    end->current.end = walk->end_A;
    end->torque.start = walk->point.torque_Nm;
    end->torque.start_1_s = walk->torque_Nm_s;
}

/* Newton's step from the predicted current, of which `point` is, to the current of the flux linkage, and the magnetics
 * there. */
MAGNETICS_INLINE void solve_end(double ohm, double speed_rad_s, magnetics_point_t *point, walk_end_t *end) {
    course_t *current = &end->current, *torque = &end->torque;
    const double voltage_V = end->voltage_V, step_s = end->length_s;
    double inverse_1_H = 1.0 / point->incremental_inductance_H;
    current->end_1_s = (voltage_V - ohm * current->end - speed_rad_s * point->flux_gradient_Wb_rad) * inverse_1_H;
    const double missing_Wb = end->driven_Wb - ohm * course_integral(current, step_s) - point->flux_linkage_Wb;
    const double newton_A = missing_Wb * inverse_1_H * (1.0 - 0.5 * ohm * step_s * inverse_1_H);
    const double more_A = newton_A * (1.0 - 0.5 * point->inductance_slope_H_A * inverse_1_H * newton_A);
    point->torque_Nm += more_A * (point->flux_gradient_Wb_rad + 0.5 * more_A * point->inductance_gradient_H_rad);
    point->torque_gradient_Nm_rad += more_A * point->flux_curvature_Wb_rad2;
    point->flux_gradient_Wb_rad += more_A * point->inductance_gradient_H_rad;
    inverse_1_H -= more_A * point->inductance_slope_H_A * inverse_1_H * inverse_1_H;
    current->end += more_A;
    current->end_1_s = (voltage_V - ohm * current->end - speed_rad_s * point->flux_gradient_Wb_rad) * inverse_1_H;
    torque->end = point->torque_Nm;
    torque->end_1_s = point->torque_gradient_Nm_rad * speed_rad_s + point->flux_gradient_Wb_rad * current->end_1_s;
    end->charge_As = course_integral(current, step_s);
    end->end_Wb = end->driven_Wb - ohm * end->charge_As;
    end->inverse_1_H = inverse_1_H;
}

/* A step in which the current ends: earlier than planned, from the angle `start_rad` on. */
MAGNETICS_INLINE void end_current(const plant_t *plant, magnetics_form_t form, unsigned phase, const link_t *link,
                                  double start_rad, double start_rad_s, walk_t *walk, walk_end_t *end) {
    const unsigned on = walk->on;
    const double ohm = plant->resistance_ohm[phase][on], flux_Wb = walk->flux_Wb, step_s = walk->step_s;
    const bool tied = is_tied(link, on);
    const double voltage_V = tied ? (end->driven_Wb - flux_Wb) / step_s : walk->voltage_V;
    const double near_s = voltage_V < 0.0 ? min_double(-flux_Wb / voltage_V, step_s) : step_s;
    course_t *current = &end->current;
    magnetics_kernel(&plant->magnetics, form, start_rad - walk->offset_rad + near_s * start_rad_s, 0.0, 0.0,
                     &walk->point);
    current->end = end->torque.end = end->torque.end_1_s = 0.0;
    current->end_1_s = voltage_V / walk->point.incremental_inductance_H;
    double end_s = end_of_current_s(voltage_V, ohm, flux_Wb, current, step_s);
    if (tied) {
        /* Without the link's part after the end. */
        const double rest_s = step_s - end_s;
        const double rest_Vs = rest_s * (link->voltage_V - 0.5 * rest_s * link_slope_V_s(link));
        const double mean_V = link_signs[on] * (link->area_Vs - walk->area_Vs - rest_Vs) / end_s - plant->drop_V[on];
        end_s = end_of_current_s(mean_V, ohm, flux_Wb, current, step_s);
    } else {
        walk->end_s = walk->at_s + end_s;
    }
    end->length_s = end_s;
    end->end_Wb = 0.0;
    end->charge_As = course_integral(current, end_s);
}

/* Adds the integrals of the step. */
MAGNETICS_INLINE void book_end(const plant_t *plant, const rotor_step_t *rotor, double ohm, const walk_end_t *end,
                               walk_t *walk, sums_t *sums) {
    const double step_Nms = course_integral(&end->torque, end->length_s);
    walk->impulse_Nms += step_Nms;
    sums->moment_Nms2 += (rotor->length_s - walk->at_s) * step_Nms - course_moment(&end->torque, end->length_s);
    const double current2_A2s = course_square(&end->current, end->length_s);
    walk->own_A2s += current2_A2s;
    walk->own_J += plant->drop_V[walk->on] * end->charge_As + ohm * current2_A2s;
}

/* Ends the step of a phase. False: the comparator responds, or there are too many steps. */
MAGNETICS_INLINE bool walk_end(const plant_t *plant, magnetics_form_t form, unsigned phase, const rotor_step_t *rotor,
                               link_t *link, walk_t *walk, sums_t *sums, phase_record_t *record) {
    const unsigned on = walk->on;
    const bool tied = is_tied(link, on);
    const double ohm = plant->resistance_ohm[phase][on];
    const double start_rad = walk->angle_rad, start_rad_s = walk->speed_rad_s;
    magnetics_point_t *point = &walk->point;
    walk_end_t end;
    find_end(plant, link, tied, walk, &end);
    rotor_at(rotor, walk->end_s, &walk->angle_rad, &walk->speed_rad_s);
    magnetics_kernel(&plant->magnetics, form, walk->angle_rad - walk->offset_rad, end.current.end, -rotor->ahead_rad,
                     point);
    solve_end(ohm, walk->speed_rad_s, point, &end);
    walk->known = (end.end_Wb > 0.0 && end.current.end > 0.0) ||
                  (tied ? end.driven_Wb > walk->flux_Wb : on == 2 && rotor->driven);
    if (__builtin_expect(!walk->known, 0)) {
        end_current(plant, form, phase, link, start_rad, start_rad_s, walk, &end);
    }
    if ((on > 0 && end.current.end > rotor->trip_current_A) || ++walk->count > PHASE_STEPS_MAX) {
        return false;
    }
    if (__builtin_expect(record != NULL, 0)) {
        record->steps[record->count++] =
            (phase_step_t){walk->at_s, end.length_s, end.current, end.torque, walk->impulse_Nms};
    }
    if (link == NULL) {
        sums->link[on] += end.charge_As;
    } else if (tied) {
        settle(link, walk, end.length_s, end.area_Vs, end.charge_As, &end.current, &sums->link[on]);
    }
    book_end(plant, rotor, ohm, &end, walk, sums);
    walk->current_A = end.current.end;
    walk->flux_Wb = end.end_Wb;
    walk->inverse_1_H = end.inverse_1_H;
    if (__builtin_expect(walk->corner, 0) && form == MAGNETICS_LINEAR_TRAPEZOID && walk->known) {
        /* The corner's other side. */
        magnetics_kernel(&plant->magnetics, form, walk->angle_rad - walk->offset_rad, walk->current_A, rotor->ahead_rad,
                         point);
        walk->inverse_1_H = 1.0 / point->incremental_inductance_H;
    }
    return true;
}

/* The end of the rotor's step. */
MAGNETICS_INLINE void walk_finish(const plant_t *plant, unsigned phase, const rotor_step_t *rotor, const walk_t *walk,
                                  sums_t *sums) {
    const half_bridge_pattern_t *pattern = walk->pattern;
    plant_phase_t *kept = walk->kept;
    unsigned edge = walk->edge;
    uint8_t switches = walk->switches;
    for (; edge < pattern->count && pattern->delay_ns[edge] - rotor->start_ns == rotor->length_ns; edge++) {
        switches = pattern->switches[edge];
    }
    sums->impulse_Nms += walk->impulse_Nms;
    sums->copper_J[phase] = plant->winding_ohm[phase] * walk->own_A2s;
    sums->converter_J[phase] = walk->own_J - sums->copper_J[phase];
    sums->walked |= 1u << phase;
    sums->switches[phase] = switches;
    sums->edge_next[phase] = (uint8_t)edge;
    kept->known = walk->known;
    kept->current_A = walk->current_A;
    kept->flux_Wb = walk->flux_Wb;
    kept->inverse_1_H = walk->inverse_1_H;
    kept->point = walk->point;
}

#endif
