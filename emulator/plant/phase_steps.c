#include "plant/phase_steps.h"

#include <math.h>
#include <string.h>

#include "plant/hermite.h"
#include "plant/magnetics_kernel.h"

/* Limit at factor 1 of the feedback from the torque through the angle to the currents, which a step neglects but for
 * the correction at its end: (d psi / d theta)^2 h^2 / (L J). */
#define COUPLING_MAX 3e-5
/* Change of a current in a step, in limits of the common steps of all phases: 0.15 of saturation_A at factor 1. */
#define CURRENT_STEPS (0.15 / 0.09)
/* Shortest last step before a current ends. */
#define STEP_MIN_S 1e-13
#define END_ITERATIONS 4

static const double NS_S = 1e-9;

/* A step of the rotor. */
typedef struct {
    double angle_rad, speed_rad_s, acceleration_rad_s2, jerk_rad_s3; /* at its start */
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
    double impulse_Nms, moment_Nms2;                              /* of the torque: moment about the end of the step */
    double link_As[3];                                            /* charge by the number of switches that are on */
    double copper_J[HAL_PHASES_MAX], converter_J[HAL_PHASES_MAX]; /* losses of each phase */
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

static inline double lesser(double a, double b) {
    return a < b ? a : b;
}

static inline bool conducts(const rotor_step_t *rotor, double current_A, unsigned on) {
    return current_A >= PLANT_CURRENT_NEGLIGIBLE_A || (on == 2 && rotor->driven);
}

/* Predicted angle and speed. */
MAGNETICS_INLINE void rotor_at(const rotor_step_t *rotor, double at_s, double *angle_rad, double *speed_rad_s) {
    const double half_rad_s2 = 0.5 * rotor->acceleration_rad_s2, half_rad_s3 = 0.5 * rotor->jerk_rad_s3 * at_s;
    *angle_rad = rotor->angle_rad + at_s * (rotor->speed_rad_s + at_s * (half_rad_s2 + (1.0 / 3.0) * half_rad_s3));
    *speed_rad_s = rotor->speed_rad_s + at_s * (rotor->acceleration_rad_s2 + half_rad_s3);
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

/* Integrates a phase over a step of the rotor; `switches` are those that are on at its start, and `edge` is the first
 * of its edges to come: both change to those at its end. False: the comparator responds, or there are too many steps.
 */
MAGNETICS_INLINE bool integrate_phase(const plant_t *plant, magnetics_form_t form, unsigned phase,
                                      const rotor_step_t *rotor, uint8_t *switches, uint8_t *next_edge,
                                      plant_phase_t *state, sums_t *sums, phase_record_t *record) {
    const half_bridge_pattern_t *pattern = &plant->pattern[phase];
    const magnetics_model_t *model = &plant->magnetics;
    const double offset_rad = phase * plant->phase_offset_rad;
    const bool corners = (form == MAGNETICS_SATURATING || form == MAGNETICS_LINEAR_TRAPEZOID) &&
                         !(rotor->least_rad > state->smooth_from_rad + MAGNETICS_SMOOTH_TOLERANCE_RAD &&
                           rotor->most_rad < state->smooth_to_rad - MAGNETICS_SMOOTH_TOLERANCE_RAD);
    magnetics_point_t point = state->point;
    double current_A = state->current_A, flux_Wb = state->flux_Wb, inverse_1_H = state->inverse_1_H;
    bool known = state->known;
    double angle_rad = rotor->angle_rad, speed_rad_s = rotor->speed_rad_s, impulse_Nms = 0.0;
    double own_A2s = 0.0, own_J = 0.0; /* integral of the square of the current; losses */
    unsigned edge = *next_edge, on = half_bridge_on(*switches), count = 0;
    for (double at_s = 0.0; at_s < rotor->length_s;) {
        double until_s = rotor->length_s;
        for (; edge < pattern->count; edge++) {
            const double edge_s = (double)(int32_t)(pattern->delay_ns[edge] - rotor->start_ns) * NS_S;
            if (edge_s > at_s) {
                until_s = lesser(until_s, edge_s);
                break;
            }
            *switches = pattern->switches[edge];
            on = half_bridge_on(*switches);
        }
        if (!conducts(rotor, current_A, on)) {
            current_A = flux_Wb = 0.0;
            known = false;
            at_s = until_s;
            continue;
        }
        if (!known) {
            rotor_at(rotor, at_s, &angle_rad, &speed_rad_s);
            magnetics_kernel(model, form, angle_rad - offset_rad, current_A, rotor->ahead_rad, &point);
            inverse_1_H = 1.0 / point.incremental_inductance_H;
            flux_Wb = point.flux_linkage_Wb;
        }
        const double voltage_V = rotor->voltage_V[on], ohm = plant->resistance_ohm[on];
        course_t current, torque;
        current.start = current_A;
        current.start_1_s = (voltage_V - ohm * current_A - speed_rad_s * point.flux_gradient_Wb_rad) * inverse_1_H;
        torque.start = point.torque_Nm;
        torque.start_1_s = point.torque_gradient_Nm_rad * speed_rad_s + point.flux_gradient_Wb_rad * current.start_1_s;

        double step_s = until_s - at_s, end_s = until_s;
        const double change_A = fabs(current.start_1_s) * step_s;
        if (change_A > rotor->current_step_A) {
            step_s /= ceil(change_A / rotor->current_step_A);
            end_s = at_s + step_s;
        }
        const bool corner = corners && end_at_corner(plant, phase, rotor, state, at_s, angle_rad, speed_rad_s, &step_s);
        if (corner) {
            end_s = at_s + step_s;
        }

        /* The predicted current, with the part of the second derivative that the current's slope causes. */
        const double bend_A_s2 =
            -(2.0 * speed_rad_s * point.inductance_gradient_H_rad + point.inductance_slope_H_A * current.start_1_s) *
            current.start_1_s * inverse_1_H;
        current.end = current_A + step_s * (current.start_1_s + 0.5 * step_s * bend_A_s2);
        const double start_rad = angle_rad, start_rad_s = speed_rad_s;
        rotor_at(rotor, end_s, &angle_rad, &speed_rad_s);
        magnetics_kernel(model, form, angle_rad - offset_rad, current.end, -rotor->ahead_rad, &point);
        inverse_1_H = 1.0 / point.incremental_inductance_H;

        /* Newton's step to the current of the flux linkage, and the magnetics there. */
        current.end_1_s = (voltage_V - ohm * current.end - speed_rad_s * point.flux_gradient_Wb_rad) * inverse_1_H;
        const double driven_Wb = flux_Wb + voltage_V * step_s;
        const double missing_Wb = driven_Wb - ohm * course_integral(&current, step_s) - point.flux_linkage_Wb;
        const double newton_A = missing_Wb * inverse_1_H * (1.0 - 0.5 * ohm * step_s * inverse_1_H);
        const double more_A = newton_A * (1.0 - 0.5 * point.inductance_slope_H_A * inverse_1_H * newton_A);
        point.torque_Nm += more_A * (point.flux_gradient_Wb_rad + 0.5 * more_A * point.inductance_gradient_H_rad);
        point.torque_gradient_Nm_rad += more_A * point.flux_curvature_Wb_rad2;
        point.flux_gradient_Wb_rad += more_A * point.inductance_gradient_H_rad;
        inverse_1_H -= more_A * point.inductance_slope_H_A * inverse_1_H * inverse_1_H;
        current.end += more_A;
        current.end_1_s = (voltage_V - ohm * current.end - speed_rad_s * point.flux_gradient_Wb_rad) * inverse_1_H;
        torque.end = point.torque_Nm;
        torque.end_1_s = point.torque_gradient_Nm_rad * speed_rad_s + point.flux_gradient_Wb_rad * current.end_1_s;
        double charge_As = course_integral(&current, step_s);
        double end_Wb = driven_Wb - ohm * charge_As;
        known = (end_Wb > 0.0 && current.end > 0.0) || (on == 2 && rotor->driven);
        if (!known) {
            const double near_s = voltage_V < 0.0 ? lesser(-flux_Wb / voltage_V, step_s) : step_s;
            magnetics_kernel(model, form, start_rad - offset_rad + near_s * start_rad_s, 0.0, 0.0, &point);
            current.end = torque.end = torque.end_1_s = end_Wb = 0.0;
            current.end_1_s = voltage_V / point.incremental_inductance_H;
            step_s = end_of_current_s(voltage_V, ohm, flux_Wb, &current, step_s);
            end_s = at_s + step_s;
            charge_As = course_integral(&current, step_s);
        }
        if ((on > 0 && current.end > rotor->trip_current_A) || ++count > PHASE_STEPS_MAX) {
            return false;
        }
        if (record != NULL) {
            record->steps[record->count++] = (phase_step_t){at_s, step_s, current, torque, impulse_Nms};
        }
        const double step_Nms = course_integral(&torque, step_s);
        impulse_Nms += step_Nms;
        sums->moment_Nms2 += (rotor->length_s - at_s) * step_Nms - course_moment(&torque, step_s);
        sums->link_As[on] += charge_As;
        const double current2_A2s = course_square(&current, step_s);
        own_A2s += current2_A2s;
        own_J += plant->drop_V[on] * charge_As + ohm * current2_A2s;
        current_A = current.end;
        flux_Wb = end_Wb;
        at_s = end_s;
        if (corner && form == MAGNETICS_LINEAR_TRAPEZOID && known) { /* the corner's other side */
            magnetics_kernel(model, form, angle_rad - offset_rad, current_A, rotor->ahead_rad, &point);
            inverse_1_H = 1.0 / point.incremental_inductance_H;
        }
    }
    for (; edge < pattern->count && pattern->delay_ns[edge] - rotor->start_ns == rotor->length_ns; edge++) {
        *switches = pattern->switches[edge];
    }
    sums->impulse_Nms += impulse_Nms;
    sums->copper_J[phase] = plant->winding_ohm * own_A2s;
    sums->converter_J[phase] = own_J - sums->copper_J[phase];
    state->known = known;
    state->current_A = current_A;
    state->flux_Wb = flux_Wb;
    state->inverse_1_H = inverse_1_H;
    state->point = point;
    *next_edge = (uint8_t)edge;
    return true;
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
                         const phase_record_t *records, uint64_t end_ns) {
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
        plant->time_ns = plant->sample_next_ns;
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
static void add_energies(plant_t *plant, const rotor_step_t *rotor, const sums_t *sums, double turn_rad,
                         double gain_rad_s) {
    plant->energy_drawn_J += plant->bus_voltage_V * sums->link_As[2];
    plant->energy_returned_J += plant->bus_voltage_V * sums->link_As[0];
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

MAGNETICS_INLINE bool advance_of(plant_t *plant, magnetics_form_t form, uint64_t to_ns) {
    phase_record_t records[HAL_PHASES_MAX];
    rotor_step_t rotor;
    start_step(plant, form, &rotor, to_ns);
    const uint64_t end_ns = plant->time_ns + rotor.length_ns;
    const bool sampled = plant->sample != NULL && plant->sample_next_ns < end_ns;
    sums_t sums = {0};
    uint8_t switches[HAL_PHASES_MAX], edge_next[HAL_PHASES_MAX];
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        if (sampled) {
            records[phase].count = 0;
        }
        switches[phase] = plant->switches[phase];
        edge_next[phase] = plant->edge_next[phase];
        if (plant->phase[phase].known || edge_next[phase] < plant->pattern[phase].count) {
            if (!integrate_phase(plant, form, phase, &rotor, &switches[phase], &edge_next[phase], &plant->phase[phase],
                                 &sums, sampled ? &records[phase] : NULL)) {
                phase_steps_reset(plant);
                return false;
            }
        }
    }
    double predicted_rad, predicted_rad_s, turn_rad, gain_rad_s;
    rotor_at(&rotor, rotor.length_s, &predicted_rad, &predicted_rad_s);
    predicted_rad -= rotor.angle_rad;
    turn(plant, &rotor, &sums, predicted_rad, &turn_rad, &gain_rad_s);
    if (sampled) {
        take_samples(plant, &rotor, turn_rad - predicted_rad, records, end_ns);
    }
    add_energies(plant, &rotor, &sums, turn_rad, gain_rad_s);
    plant->time_ns = end_ns;
    plant->rotor_angle_rad = rotor.angle_rad + turn_rad;
    plant->speed_rad_s = rotor.speed_rad_s + gain_rad_s;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        if (plant->phase[phase].known) {
            correct(&plant->phase[phase], plant->rotor_angle_rad, turn_rad - predicted_rad);
        }
        plant->switches[phase] = switches[phase];
        plant->edge_next[phase] = edge_next[phase];
        plant->current_A[phase] = plant->phase[phase].current_A;
    }
    return true;
}

bool phase_steps_advance(plant_t *plant, uint64_t to_ns) {
    if (plant->faulted || plant->machine->dc_link.capacitance_F > 0.0 || plant->trip_ns != UINT64_MAX) {
        return false;
    }
    switch (plant->magnetics.form) {
    case MAGNETICS_LINEAR_COSINE:
        return advance_of(plant, MAGNETICS_LINEAR_COSINE, to_ns);
    case MAGNETICS_LINEAR_TRAPEZOID:
        return advance_of(plant, MAGNETICS_LINEAR_TRAPEZOID, to_ns);
    case MAGNETICS_SATURATING:
        return advance_of(plant, MAGNETICS_SATURATING, to_ns);
    case MAGNETICS_MAP:
        return advance_of(plant, MAGNETICS_MAP, to_ns);
    }
    return false;
}
