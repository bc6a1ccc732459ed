#include "plant/phase_steps.h"

#include <math.h>
#include <string.h>

#include "plant/hermite.h"
#include "plant/link_steps.h"
#include "plant/magnetics_kernel.h"

/* Limit at factor 1 of the feedback from the torque through the angle to the currents, which a step neglects but for
 * the correction at its end: (d psi / d theta)^2 h^2 / (L J). */
#define COUPLING_MAX 3e-5
/* Change of a current in a step, in limits of the common steps of all phases: 0.15 of saturation_A at factor 1. */
#define CURRENT_STEPS (0.15 / 0.09)
/* Shortest last step before a current ends. */
#define STEP_MIN_S 1e-13
#define END_ITERATIONS 4
/* With a link, a step in which a current is expected to end is longer by this. */
#define END_MARGIN 1.01

static const double NS_S = 1e-9;

/* A step of the rotor. */
typedef struct {
    double angle_rad, speed_rad_s, acceleration_rad_s2, jerk_rad_s3; /* at its start */
    double half_rad_s2, half_rad_s3;                                 /* half of the last two */
    uint32_t start_ns; /* after the start of the control period, modulo 2^32 */
    uint64_t length_ns;
    double length_s;
    double ahead_rad;           /* small angle in the direction of motion, see magnetics_kernel_trapezoid */
    double least_rad, most_rad; /* bounds of the angle within it */
    double voltage_V[3];        /* of link and device drops, by the number of switches that are on */
    bool driven;                /* it is positive with both */
    double trip_current_A, current_step_A;
} rotor_step_t;

/* Integrals of a step of the rotor over all phases. */
typedef struct {
    double impulse_Nms, moment_Nms2; /* of the torque: moment about the end of the step */
    double link[3]; /* by the number of switches that are on: charge; with a link, energy at its voltage */
    double copper_J[HAL_PHASES_MAX], converter_J[HAL_PHASES_MAX]; /* losses of each phase */
    unsigned walked;                                              /* phases that had current or edges: bits */
    uint8_t switches[HAL_PHASES_MAX], edge_next[HAL_PHASES_MAX];  /* theirs at the end */
} sums_t;

/* A quantity at both ends of a step, and its time derivative. */
typedef struct {
    double start, end, start_1_s, end_1_s;
} course_t;

/* A step of a phase. */
typedef struct {
    double from_s, length_s; /* within the rotor's step */
    course_t current_A, torque_Nm;
    double impulse_Nms; /* of the phase's steps before */
} phase_step_t;

typedef struct {
    unsigned count;
    phase_step_t steps[PHASE_STEPS_MAX];
} phase_record_t;

/* --- Cubic Hermite course of a quantity --- */

static inline double course_at(const course_t *f, double h, double x) {
    return hermite(x, h, f->start, f->start_1_s, f->end, f->end_1_s);
}

static inline double course_integral(const course_t *f, double h) {
    return 0.5 * h * (f->start + f->end) + h * h * (1.0 / 12.0) * (f->start_1_s - f->end_1_s);
}

/* Integral from the start to fraction x. */
static double course_integral_to(const course_t *f, double h, double x) {
    const double x2 = x * x, x3 = x2 * x, x4 = x2 * x2;
    return h * (f->start * (0.5 * x4 - x3 + x) + f->end * (x3 - 0.5 * x4) +
                h * (f->start_1_s * (0.25 * x4 - (2.0 / 3.0) * x3 + 0.5 * x2) +
                     f->end_1_s * (0.25 * x4 - (1.0 / 3.0) * x3)));
}

/* Integral of the quantity times the time since the start. */
static inline double course_moment(const course_t *f, double h) {
    return h * h * (0.15 * f->start + 0.35 * f->end + h * ((1.0 / 30.0) * f->start_1_s - 0.05 * f->end_1_s));
}

/* Integral of the square, by the Hermite course of the square. */
static inline double course_square(const course_t *f, double h) {
    return 0.5 * h * (f->start * f->start + f->end * f->end) +
           h * h * (1.0 / 6.0) * (f->start * f->start_1_s - f->end * f->end_1_s);
}

/* --- One phase --- */

static bool has_link(const plant_t *plant) {
    return plant->machine->dc_link.capacitance_F > 0.0;
}

static inline double lesser(double a, double b) {
    return a < b ? a : b;
}

static inline bool conducts(const rotor_step_t *rotor, double current_A, unsigned on) {
    return current_A >= PLANT_CURRENT_NEGLIGIBLE_A || (on == 2 && rotor->driven);
}

/* Predicted angle and speed. */
MAGNETICS_INLINE void rotor_at(const rotor_step_t *rotor, double at_s, double *angle_rad, double *speed_rad_s) {
    const double half_rad_s2 = rotor->half_rad_s3 * at_s;
    *angle_rad =
        rotor->angle_rad + at_s * (rotor->speed_rad_s + at_s * (rotor->half_rad_s2 + (1.0 / 3.0) * half_rad_s2));
    *speed_rad_s = rotor->speed_rad_s + at_s * (rotor->acceleration_rad_s2 + half_rad_s2);
}

/* Shortens a step so that it ends where the phase's magnetics are not smooth; true if it does. */
static bool end_at_corner(const plant_t *plant, unsigned phase, const rotor_step_t *rotor, plant_phase_t *state,
                          double at_s, double angle_rad, double speed_rad_s, double *step_s) {
    if (angle_rad < state->smooth_from_rad + MAGNETICS_SMOOTH_TOLERANCE_RAD ||
        angle_rad > state->smooth_to_rad - MAGNETICS_SMOOTH_TOLERANCE_RAD) {
        const double phase_rad = angle_rad - phase * plant->phase_offset_rad;
        state->smooth_to_rad = angle_rad + magnetics_smooth_distance_rad(&plant->magnetics, phase_rad, 1.0);
        state->smooth_from_rad = angle_rad - magnetics_smooth_distance_rad(&plant->magnetics, phase_rad, -1.0);
    }
    const bool forward = speed_rad_s > 0.0 || (speed_rad_s == 0.0 && rotor->acceleration_rad_s2 > 0.0);
    const double corner_rad = forward ? state->smooth_to_rad : state->smooth_from_rad;
    const double distance_rad = fabs(corner_rad - angle_rad), along_rad_s = fabs(speed_rad_s);
    const double along_rad_s2 = forward ? rotor->acceleration_rad_s2 : -rotor->acceleration_rad_s2;
    if (*step_s * (along_rad_s + 0.5 * along_rad_s2 * *step_s) <= distance_rad) {
        return false;
    }
    *step_s = 2.0 * distance_rad / (along_rad_s + sqrt(along_rad_s * along_rad_s + 2.0 * along_rad_s2 * distance_rad));
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
                    !(rotor->least_rad > kept->smooth_from_rad + MAGNETICS_SMOOTH_TOLERANCE_RAD &&
                      rotor->most_rad < kept->smooth_to_rad - MAGNETICS_SMOOTH_TOLERANCE_RAD);
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

/* Begins a phase's next step, which lasts to end_s. False: it has no current until then. */
MAGNETICS_INLINE bool walk_begin(const plant_t *plant, magnetics_form_t form, unsigned phase, const rotor_step_t *rotor,
                                 link_t *link, walk_t *walk) {
    const half_bridge_pattern_t *pattern = walk->pattern;
    const double at_s = walk->end_s;
    double until_s = rotor->length_s;
    for (; walk->edge < pattern->count; walk->edge++) {
        const double edge_s = (double)(int32_t)(pattern->delay_ns[walk->edge] - rotor->start_ns) * NS_S;
        if (edge_s > at_s) {
            until_s = lesser(until_s, edge_s);
            break;
        }
        walk->switches = pattern->switches[walk->edge];
        walk->on = half_bridge_on(walk->switches);
    }
    const unsigned on = walk->on;
    walk->at_s = at_s;
    walk->end_s = until_s;
    const double current_A = walk->current_A, ohm = plant->resistance_ohm[on];
    const bool tied = link != NULL && on != 1; /* freewheeling, it does not notice the link */
    const double voltage_V = tied ? link_signs[on] * link->voltage_V - plant->drop_V[on] : rotor->voltage_V[on];
    const bool driven = tied ? voltage_V > 0.0 : on == 2 && rotor->driven;
    if (!(current_A >= PLANT_CURRENT_NEGLIGIBLE_A || driven)) {
        walk->current_A = walk->flux_Wb = 0.0;
        walk->known = false;
        return false;
    }
    if (__builtin_expect(!walk->known, 0)) {
        rotor_at(rotor, at_s, &walk->angle_rad, &walk->speed_rad_s);
        magnetics_kernel(&plant->magnetics, form, walk->angle_rad - walk->offset_rad, current_A, rotor->ahead_rad,
                         &walk->point);
        walk->inverse_1_H = 1.0 / walk->point.incremental_inductance_H;
        walk->flux_Wb = walk->point.flux_linkage_Wb;
    }
    const magnetics_point_t *point = &walk->point;
    const double speed_rad_s = walk->speed_rad_s;
    const double current_A_s =
        (voltage_V - ohm * current_A - speed_rad_s * point->flux_gradient_Wb_rad) * walk->inverse_1_H;
    walk->voltage_V = voltage_V;
    walk->current_A_s = current_A_s;
    walk->torque_Nm_s = point->torque_gradient_Nm_rad * speed_rad_s + point->flux_gradient_Wb_rad * current_A_s;

    double step_s = until_s - at_s;
    const double change_A = fabs(current_A_s) * step_s;
    const double swing_s2_H = tied ? step_s * step_s * walk->inverse_1_H : 0.0;
    if (change_A > rotor->current_step_A || (tied && swing_s2_H > plant->link_swing_s2_H)) {
        double steps = change_A / rotor->current_step_A;
        if (tied && swing_s2_H > steps * steps * plant->link_swing_s2_H) {
            steps = sqrt(swing_s2_H / plant->link_swing_s2_H);
        }
        step_s /= ceil(steps);
        walk->end_s = at_s + step_s;
    }
    if (tied && on == 0 && walk->flux_Wb + voltage_V * step_s < 0.0) {
        /* A little late, so that the current ends in this step. */
        const double ends_s = END_MARGIN * walk->flux_Wb / (0.5 * ohm * current_A - voltage_V);
        if (ends_s < step_s) {
            step_s = ends_s;
            walk->end_s = at_s + step_s;
        }
    }
    walk->corner =
        walk->corners && end_at_corner(plant, phase, rotor, walk->kept, at_s, walk->angle_rad, speed_rad_s, &step_s);
    if (walk->corner) {
        walk->end_s = at_s + step_s;
    }

    /* The predicted current, with the part of the second derivative that the current's slope causes. */
    double bend_A_s2 =
        -(2.0 * speed_rad_s * point->inductance_gradient_H_rad + point->inductance_slope_H_A * current_A_s) *
        current_A_s * walk->inverse_1_H;
    if (tied) {
        const double sign = link_signs[on];
        link->drawn_A += sign * current_A;
        link->drawn_A_s += sign * current_A_s;
        bend_A_s2 += (sign * link_slope_V_s(link) - ohm * current_A_s) * walk->inverse_1_H;
        link->drawn_A_s2 += 0.5 * sign * bend_A_s2;
        walk->bend_A_s2 = bend_A_s2;
        walk->link_V = link->voltage_V;
        walk->area_Vs = link->area_Vs;
    }
    walk->step_s = step_s;
    walk->end_A = current_A + step_s * (current_A_s + 0.5 * step_s * bend_A_s2);
    return true;
}

/* The end of a current in a step: returns the step's length, and its end and charge. */
MAGNETICS_INLINE double end_of_step(const plant_t *plant, magnetics_form_t form, const link_t *link, double driven_Wb,
                                    const walk_t *walk, double start_rad, double start_rad_s, magnetics_point_t *point,
                                    course_t *current, course_t *torque) {
    const unsigned on = walk->on;
    const double ohm = plant->resistance_ohm[on], flux_Wb = walk->flux_Wb, step_s = walk->step_s;
    const bool tied = link != NULL && on != 1;
    const double voltage_V = tied ? (driven_Wb - flux_Wb) / step_s : walk->voltage_V;
    const double near_s = voltage_V < 0.0 ? lesser(-flux_Wb / voltage_V, step_s) : step_s;
    magnetics_kernel(&plant->magnetics, form, start_rad - walk->offset_rad + near_s * start_rad_s, 0.0, 0.0, point);
    current->end = torque->end = torque->end_1_s = 0.0;
    current->end_1_s = voltage_V / point->incremental_inductance_H;
    double end_s = end_of_current_s(voltage_V, ohm, flux_Wb, current, step_s);
    if (tied) {
        /* Without the link's part after the end. */
        const double rest_s = step_s - end_s;
        const double rest_Vs = rest_s * (link->voltage_V - 0.5 * rest_s * link_slope_V_s(link));
        const double mean_V = link_signs[on] * (link->area_Vs - walk->area_Vs - rest_Vs) / end_s - plant->drop_V[on];
        end_s = end_of_current_s(mean_V, ohm, flux_Wb, current, step_s);
    }
    return end_s;
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

/* Ends the step of a phase. False: the comparator responds, or there are too many steps. */
MAGNETICS_INLINE bool walk_end(const plant_t *plant, magnetics_form_t form, const rotor_step_t *rotor, link_t *link,
                               walk_t *walk, sums_t *sums, phase_record_t *record) {
    const unsigned on = walk->on;
    const bool tied = link != NULL && on != 1;
    const double at_s = walk->at_s, ohm = plant->resistance_ohm[on], flux_Wb = walk->flux_Wb;
    double step_s = walk->step_s, voltage_V = walk->voltage_V, area_Vs = 0.0;
    course_t current, torque;
    magnetics_point_t *point = &walk->point;
    current.start = walk->current_A;
    current.start_1_s = walk->current_A_s;
    current.end = walk->end_A;
    torque.start = point->torque_Nm;
    torque.start_1_s = walk->torque_Nm_s;
    double driven_Wb = flux_Wb + voltage_V * step_s; /* without the resistance */
    if (tied) {
        const double sign = link_signs[on];
        area_Vs = link->area_Vs - walk->area_Vs;
        voltage_V = sign * link->voltage_V - plant->drop_V[on];
        driven_Wb = flux_Wb + (sign * area_Vs - plant->drop_V[on] * step_s);
    }
    const double start_rad = walk->angle_rad, start_rad_s = walk->speed_rad_s;
    rotor_at(rotor, walk->end_s, &walk->angle_rad, &walk->speed_rad_s);
    const double angle_rad = walk->angle_rad, speed_rad_s = walk->speed_rad_s;
    magnetics_kernel(&plant->magnetics, form, angle_rad - walk->offset_rad, current.end, -rotor->ahead_rad, point);
    double inverse_1_H = 1.0 / point->incremental_inductance_H;

    /* Newton's step to the current of the flux linkage, and the magnetics there. */
    current.end_1_s = (voltage_V - ohm * current.end - speed_rad_s * point->flux_gradient_Wb_rad) * inverse_1_H;
    const double missing_Wb = driven_Wb - ohm * course_integral(&current, step_s) - point->flux_linkage_Wb;
    const double newton_A = missing_Wb * inverse_1_H * (1.0 - 0.5 * ohm * step_s * inverse_1_H);
    const double more_A = newton_A * (1.0 - 0.5 * point->inductance_slope_H_A * inverse_1_H * newton_A);
    point->torque_Nm += more_A * (point->flux_gradient_Wb_rad + 0.5 * more_A * point->inductance_gradient_H_rad);
    point->torque_gradient_Nm_rad += more_A * point->flux_curvature_Wb_rad2;
    point->flux_gradient_Wb_rad += more_A * point->inductance_gradient_H_rad;
    inverse_1_H -= more_A * point->inductance_slope_H_A * inverse_1_H * inverse_1_H;
    current.end += more_A;
    current.end_1_s = (voltage_V - ohm * current.end - speed_rad_s * point->flux_gradient_Wb_rad) * inverse_1_H;
    torque.end = point->torque_Nm;
    torque.end_1_s = point->torque_gradient_Nm_rad * speed_rad_s + point->flux_gradient_Wb_rad * current.end_1_s;
    double charge_As = course_integral(&current, step_s);
    double end_Wb = driven_Wb - ohm * charge_As;
    walk->known = (end_Wb > 0.0 && current.end > 0.0) || (tied ? driven_Wb > flux_Wb : on == 2 && rotor->driven);
    if (__builtin_expect(!walk->known, 0)) {
        step_s = end_of_step(plant, form, link, driven_Wb, walk, start_rad, start_rad_s, point, &current, &torque);
        end_Wb = 0.0;
        charge_As = course_integral(&current, step_s);
        if (!tied) {
            walk->end_s = at_s + step_s;
        }
    }
    if ((on > 0 && current.end > rotor->trip_current_A) || ++walk->count > PHASE_STEPS_MAX) {
        return false;
    }
    if (__builtin_expect(record != NULL, 0)) {
        record->steps[record->count++] = (phase_step_t){at_s, step_s, current, torque, walk->impulse_Nms};
    }
    if (link == NULL) {
        sums->link[on] += charge_As;
    } else if (tied) {
        settle(link, walk, step_s, area_Vs, charge_As, &current, &sums->link[on]);
    }
    const double step_Nms = course_integral(&torque, step_s);
    walk->impulse_Nms += step_Nms;
    sums->moment_Nms2 += (rotor->length_s - at_s) * step_Nms - course_moment(&torque, step_s);
    const double current2_A2s = course_square(&current, step_s);
    walk->own_A2s += current2_A2s;
    walk->own_J += plant->drop_V[on] * charge_As + ohm * current2_A2s;
    walk->current_A = current.end;
    walk->flux_Wb = end_Wb;
    walk->inverse_1_H = inverse_1_H;
    if (__builtin_expect(walk->corner, 0) && form == MAGNETICS_LINEAR_TRAPEZOID &&
        walk->known) { /* the corner's other side */
        magnetics_kernel(&plant->magnetics, form, angle_rad - walk->offset_rad, walk->current_A, rotor->ahead_rad,
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
    sums->copper_J[phase] = plant->winding_ohm * walk->own_A2s;
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
                    !walk_end(plant, form, rotor, NULL, &walk, sums, records != NULL ? &records[phase] : NULL)) {
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
            walk_t *walk = &walks[n];
            while (walk->end_s <= at_s) {
                const unsigned phase = phase_of[n];
                if (walk->active &&
                    !walk_end(plant, form, rotor, link, walk, sums, records != NULL ? &records[phase] : NULL)) {
                    return false;
                }
                if (walk->end_s >= rotor->length_s) {
                    walk_finish(plant, phase, rotor, walk, sums);
                    break;
                }
                walk->active = walk_begin(plant, form, phase, rotor, link, walk);
            }
            next_s = lesser(walk->end_s, next_s);
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

/* --- Samples --- */

/* State of a phase within a step: its current, and its torque's impulse since the start. */
static void phase_within(const phase_record_t *record, double at_s, double *current_A, double *impulse_Nms) {
    *current_A = *impulse_Nms = 0.0;
    for (unsigned n = 0; n < record->count && record->steps[n].from_s <= at_s; n++) {
        const phase_step_t *step = &record->steps[n];
        const double x = fmin((at_s - step->from_s) / step->length_s, 1.0);
        *current_A = fmax(course_at(&step->current_A, step->length_s, x), 0.0);
        *impulse_Nms = step->impulse_Nms + course_integral_to(&step->torque_Nm, step->length_s, x);
    }
}

/* Takes the samples within a step; its correction of the angle grows as the cube of the time. */
static void take_samples(plant_t *plant, const rotor_step_t *rotor, double correction_rad,
                         const phase_record_t *records, const link_record_t *link, uint64_t end_ns) {
    const uint64_t start_ns = plant->time_ns;
    double current_A[HAL_PHASES_MAX];
    memcpy(current_A, plant->current_A, sizeof current_A);
    while (plant->sample_next_ns < end_ns) {
        const double at_s = (double)(plant->sample_next_ns - start_ns) * NS_S, x = at_s / rotor->length_s;
        double net_Nms = -plant->load_torque_Nm * at_s;
        for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
            double impulse_Nms;
            phase_within(&records[phase], at_s, &plant->current_A[phase], &impulse_Nms);
            net_Nms += impulse_Nms;
        }
        rotor_at(rotor, at_s, &plant->rotor_angle_rad, &plant->speed_rad_s);
        if (!plant->held) {
            net_Nms -= plant->friction_Nm_s * (plant->rotor_angle_rad - rotor->angle_rad);
            plant->speed_rad_s = rotor->speed_rad_s + net_Nms / plant->inertia_kg_m2;
        }
        plant->rotor_angle_rad += x * x * x * correction_rad;
        if (link->count > 0) {
            plant->bus_voltage_V = link_recorded_V(link, at_s);
        }
        plant->time_ns = plant->sample_next_ns;
        plant_follow_edges(plant, end_ns);
        plant->sample_next_ns += plant->sample_step_ns;
        plant->sample(plant->sample_context, plant);
    }
    plant->time_ns = start_ns;
    memcpy(plant->current_A, current_A, sizeof current_A);
}

/* --- All phases --- */

/* Prepares the rotor's step and the phases at its start. */
MAGNETICS_INLINE void start_step(plant_t *plant, magnetics_form_t form, rotor_step_t *rotor, uint64_t to_ns) {
    const unsigned phases = plant->machine->phases;
    const double speed_rad_s = plant->speed_rad_s, angle_rad = plant->rotor_angle_rad;
    const double inertia_1 = 1.0 / plant->inertia_kg_m2;
    for (unsigned on = 0; on < 3; on++) {
        rotor->voltage_V[on] = ((double)on - 1.0) * plant->bus_voltage_V - plant->drop_V[on];
    }
    rotor->driven = rotor->voltage_V[2] > 0.0;
    rotor->trip_current_A = plant->tripped ? INFINITY : plant->trip_current_A;
    rotor->current_step_A = CURRENT_STEPS * plant->step_current_A;
    rotor->angle_rad = angle_rad;
    rotor->speed_rad_s = speed_rad_s;
    rotor->start_ns = (uint32_t)(plant->time_ns - plant->pattern_ns);
    rotor->ahead_rad = copysign(2.0 * MAGNETICS_SMOOTH_TOLERANCE_RAD, speed_rad_s);

    double torque_Nm = 0.0, torque_Nm_s = 0.0, coupling_1_s2 = 0.0;
    for (unsigned phase = 0; phase < phases; phase++) {
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
            (rotor->voltage_V[on] - plant->resistance_ohm[on] * current_A - speed_rad_s * gradient_Wb_rad) *
            state->inverse_1_H;
        torque_Nm += state->point.torque_Nm;
        torque_Nm_s += state->point.torque_gradient_Nm_rad * speed_rad_s + gradient_Wb_rad * current_A_s;
        coupling_1_s2 += gradient_Wb_rad * gradient_Wb_rad * state->inverse_1_H;
    }
    coupling_1_s2 *= inertia_1;
    rotor->acceleration_rad_s2 = (torque_Nm - plant->friction_Nm_s * speed_rad_s - plant->load_torque_Nm) * inertia_1;
    rotor->jerk_rad_s3 = (torque_Nm_s - plant->friction_Nm_s * rotor->acceleration_rad_s2) * inertia_1;
    if (plant->held) {
        rotor->acceleration_rad_s2 = plant->held_acceleration_rad_s2;
        rotor->jerk_rad_s3 = coupling_1_s2 = 0.0;
    }
    rotor->half_rad_s2 = 0.5 * rotor->acceleration_rad_s2;
    rotor->half_rad_s3 = 0.5 * rotor->jerk_rad_s3;

    double limit_s = plant->step_max_s;
    if (fabs(speed_rad_s) * limit_s > plant->step_angle_rad) {
        limit_s = plant->step_angle_rad / fabs(speed_rad_s);
    }
    const double coupling_max = plant->step_factor * plant->step_factor * COUPLING_MAX;
    if (coupling_1_s2 * limit_s * limit_s > coupling_max) {
        limit_s = sqrt(coupling_max / coupling_1_s2);
    }
    uint64_t length_ns = to_ns - plant->time_ns;
    if ((double)length_ns * NS_S > limit_s) {
        const uint64_t steps = (uint64_t)ceil((double)length_ns * NS_S / limit_s);
        length_ns = (length_ns + steps - 1) / steps;
    }
    rotor->length_ns = length_ns;
    rotor->length_s = (double)length_ns * NS_S;
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
    /* Of a speed whose course is a straight line. */
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
        plant->phase[phase] = (plant_phase_t){.smooth_from_rad = INFINITY, .smooth_to_rad = -INFINITY};
    }
}

MAGNETICS_INLINE bool advance_of(plant_t *plant, magnetics_form_t form, bool linked, uint64_t to_ns) {
    phase_record_t records[HAL_PHASES_MAX];
    link_record_t link_record;
    rotor_step_t rotor;
    start_step(plant, form, &rotor, to_ns);
    const uint64_t end_ns = plant->time_ns + rotor.length_ns;
    const bool sampled = plant->sample != NULL && plant->sample_next_ns < end_ns;
    if (sampled) {
        for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
            records[phase].count = 0;
        }
        link_record.count = 0;
    }
    link_t link;
    sums_t sums = {0};
    bool walked;
    if (linked) {
        link_start(&link, plant, sampled ? &link_record : NULL);
        walked = walk_together(plant, form, &rotor, &link, &sums, sampled ? records : NULL) &&
                 !(sampled && link_record.count > LINK_STEPS_MAX);
    } else {
        walked = walk_apart(plant, form, &rotor, &sums, sampled ? records : NULL);
    }
    if (!walked) {
        phase_steps_reset(plant);
        return false;
    }
    double predicted_rad, predicted_rad_s, turn_rad, gain_rad_s;
    rotor_at(&rotor, rotor.length_s, &predicted_rad, &predicted_rad_s);
    predicted_rad -= rotor.angle_rad;
    turn(plant, &rotor, &sums, predicted_rad, &turn_rad, &gain_rad_s);
    if (sampled) {
        take_samples(plant, &rotor, turn_rad - predicted_rad, records, &link_record, end_ns);
    }
    add_energies(plant, &rotor, &sums, linked, turn_rad, gain_rad_s);
    if (linked) {
        link_finish(&link, plant);
    }
    plant->time_ns = end_ns;
    plant->rotor_angle_rad = rotor.angle_rad + turn_rad;
    plant->speed_rad_s = rotor.speed_rad_s + gain_rad_s;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        if (sums.walked >> phase & 1u) {
            plant->switches[phase] = sums.switches[phase];
            plant->edge_next[phase] = sums.edge_next[phase];
            if (plant->phase[phase].known) {
                correct(&plant->phase[phase], plant->rotor_angle_rad, turn_rad - predicted_rad);
            }
        }
        plant->current_A[phase] = plant->phase[phase].current_A;
    }
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
    return has_link(plant) ? advance_with_link(plant, to_ns) : advance_without_link(plant, to_ns);
}
