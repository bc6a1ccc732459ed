#include "plant/plant.h"
#include "plant/magnetics_kernel.h"

#include <math.h>
#include <string.h>

/* Limits of a step at factor 1, chosen so that currents, torque and speed stay within 1e-6 of their range (measured
 * against SciPy's DOP853 at a tolerance of 1e-12: 5e-7) at the speeds and currents of a drive. A whole control period
 * at 40 kHz is one step where nothing happens in it. */
#define STEP_MAX_S 25e-6
/* Of the saturation current 1/b: limits the change of the incremental inductance. */
#define STEP_CURRENT_FRACTION 0.15
#define STEP_ANGLE_PITCHES 0.0015

/* Of the shortest time constants, those of a winding at its least inductance and of the free rotor: a Runge-Kutta step
 * loses its accuracy, and beyond 2.8 its stability, where the resistance or the friction is large. */
#define STEP_TIME_CONSTANTS 0.05

/* A diode's end of conduction is located to this. */
#define ZERO_TOLERANCE_S 1e-13
#define ZERO_ITERATIONS 60
/* A freewheeling current decays without ever ending; below this it counts as ended. */
#define CURRENT_NEGLIGIBLE_A 1e-9

static const double NS_S = 1e-9;

void plant_init(plant_t *plant, const machine_t *machine, double initial_angle_rad) {
    memset(plant, 0, sizeof *plant);
    plant->machine = machine;
    plant->rotor_angle_rad = initial_angle_rad;
    plant->bus_voltage_V = machine->supply_voltage_V;
    magnetics_prepare(&plant->magnetics, &machine->magnetics, machine->rotor_poles);
    plant->phase_offset_rad = plant->magnetics.pitch_rad / machine->phases;
    plant_set_step_factor(plant, 1.0);
    /* Empty: the first step computes it. */
    plant->smooth_from_rad = INFINITY;
    plant->smooth_to_rad = -INFINITY;
}

void plant_set_step_factor(plant_t *plant, double factor) {
    const machine_t *machine = plant->machine;
    const double least_inductance_H =
        plant->magnetics.unaligned_inductance_H + fmin(0.0, plant->magnetics.linear_excess_H);
    const double time_constant_s =
        fmin(least_inductance_H / machine->resistance_ohm, machine->inertia_kg_m2 / machine->friction_Nm_s);
    plant->step_max_s = factor * fmin(STEP_MAX_S, STEP_TIME_CONSTANTS * time_constant_s);
    plant->step_angle_rad = factor * STEP_ANGLE_PITCHES * plant->magnetics.pitch_rad;
    plant->step_current_A = INFINITY;
    if (machine->magnetics.form == MAGNETICS_SATURATING) {
        plant->step_current_A = factor * STEP_CURRENT_FRACTION * plant->magnetics.saturation_A;
    }
}

/* --- Converter --- */

/* The instants, in ticks from the period's start and up to its middle, where the pattern changes; the second half
 * mirrors the first. */
typedef struct {
    uint16_t tick;
    plant_switches_t toggles;
} half_edge_t;

static void insert_half_edge(half_edge_t *edges, unsigned *count, uint16_t tick, uint8_t upper, uint8_t lower) {
    unsigned at = *count;
    while (at > 0 && edges[at - 1].tick > tick) {
        edges[at] = edges[at - 1];
        at--;
    }
    edges[at] = (half_edge_t){tick, {upper, lower}};
    (*count)++;
}

static void append_edge(plant_t *plant, uint64_t time_ns, plant_switches_t toggles) {
    plant_switches_t switches = plant->switches;
    if (plant->edge_count > 0) {
        plant_edge_t *last = &plant->edges[plant->edge_count - 1];
        if (last->time_ns == time_ns) {
            last->switches.upper ^= toggles.upper;
            last->switches.lower ^= toggles.lower;
            return;
        }
        switches = last->switches;
    }
    switches.upper ^= toggles.upper;
    switches.lower ^= toggles.lower;
    plant->edges[plant->edge_count++] = (plant_edge_t){time_ns, switches};
}

void plant_set_switches(plant_t *plant, const hal_pwm_compare_t *compare, uint16_t period_ticks) {
    half_edge_t half_edges[2 * HAL_PHASES_MAX];
    unsigned count = 0;
    plant->switches = (plant_switches_t){0, 0};
    plant->edge_count = 0;
    plant->edge_next = 0;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        const uint16_t upper = compare->upper[phase], lower = compare->lower[phase];
        const uint8_t bit = (uint8_t)(1u << phase);
        if (upper >= period_ticks) {
            plant->switches.upper |= bit;
        } else if (upper > 0) {
            insert_half_edge(half_edges, &count, (uint16_t)(period_ticks - upper), bit, 0);
        }
        if (lower > 0) {
            plant->switches.lower |= bit;
            if (lower < period_ticks) {
                insert_half_edge(half_edges, &count, lower, 0, bit);
            }
        }
    }
    for (unsigned edge = 0; edge < count; edge++) {
        append_edge(plant, plant->time_ns + (uint64_t)half_edges[edge].tick * HAL_PWM_TICK_NS,
                    half_edges[edge].toggles);
    }
    for (unsigned edge = count; edge-- > 0;) {
        append_edge(plant, plant->time_ns + (2u * (uint64_t)period_ticks - half_edges[edge].tick) * HAL_PWM_TICK_NS,
                    half_edges[edge].toggles);
    }
}

void plant_open_all(plant_t *plant) {
    plant->switches = (plant_switches_t){0, 0};
    plant->edge_count = 0;
    plant->edge_next = 0;
}

/* --- Machine --- */

/* What stays the same during a step: the conducting phases. */
typedef struct {
    unsigned count;
    unsigned phase[HAL_PHASES_MAX];
    double angle_offset_rad[HAL_PHASES_MAX];
    double voltage_V[HAL_PHASES_MAX];
} conducting_t;

typedef struct {
    double angle_rad, speed_rad_s;
    double current_A[HAL_PHASES_MAX]; /* by index in conducting_t */
} state_t;

typedef struct {
    double torque_Nm, acceleration_rad_s2;
    double current_A_s[HAL_PHASES_MAX];
} derivative_t;

/* Integrals over a step that the energy ledger needs. */
typedef struct {
    double angle_rad;     /* of speed */
    double speed2_rad2_s; /* of speed squared */
    double current2_A2s;  /* of all currents squared */
    double charge_As[HAL_PHASES_MAX];
} integrals_t;

/* Through a pointer, for a struct given back is copied in wide loads that wait for the narrow stores before them. */
static void find_conducting(plant_t *plant, conducting_t *conducting) {
    conducting->count = 0;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        const unsigned upper = plant->switches.upper, lower = plant->switches.lower;
        const unsigned on = ((upper >> phase) & 1u) + ((lower >> phase) & 1u);
        const double voltage_V = on == 2 ? plant->bus_voltage_V : on == 1 ? 0.0 : -plant->bus_voltage_V;
        if (voltage_V <= 0.0 && plant->current_A[phase] < CURRENT_NEGLIGIBLE_A) {
            plant->current_A[phase] = 0.0;
            continue;
        }
        conducting->phase[conducting->count] = phase;
        conducting->angle_offset_rad[conducting->count] = phase * plant->phase_offset_rad;
        conducting->voltage_V[conducting->count] = voltage_V;
        conducting->count++;
    }
}

/* `form` is the magnetics' and `count` is conducting->count, apart so that the compiler can leave out the other forms
 * and unroll where they are known. */
MAGNETICS_INLINE void differentiate_of(const plant_t *plant, magnetics_form_t form, const conducting_t *conducting,
                                       unsigned count, const state_t *state, derivative_t *derivative) {
    const machine_t *machine = plant->machine;
    derivative->torque_Nm = 0.0;
    for (unsigned index = 0; index < count; index++) {
        magnetics_point_t point;
        magnetics_kernel(&plant->magnetics, form, state->angle_rad - conducting->angle_offset_rad[index],
                         state->current_A[index], 0.0, &point);
        derivative->current_A_s[index] =
            (conducting->voltage_V[index] - machine->resistance_ohm * state->current_A[index] -
             state->speed_rad_s * point.flux_gradient_Wb_rad) /
            point.incremental_inductance_H;
        derivative->torque_Nm += point.torque_Nm;
    }
    derivative->acceleration_rad_s2 =
        (derivative->torque_Nm - machine->friction_Nm_s * state->speed_rad_s - plant->load_torque_Nm) /
        machine->inertia_kg_m2;
}

MAGNETICS_INLINE void differentiate(const plant_t *plant, const conducting_t *conducting, const state_t *state,
                                    derivative_t *derivative) {
    if (plant->magnetics.form == MAGNETICS_SATURATING) {
        differentiate_of(plant, MAGNETICS_SATURATING, conducting, conducting->count, state, derivative);
    } else if (plant->magnetics.form == MAGNETICS_LINEAR_COSINE) {
        differentiate_of(plant, MAGNETICS_LINEAR_COSINE, conducting, conducting->count, state, derivative);
    } else {
        differentiate_of(plant, MAGNETICS_LINEAR_TRAPEZOID, conducting, conducting->count, state, derivative);
    }
}

MAGNETICS_INLINE void move(unsigned count, const state_t *from, const derivative_t *derivative, double speed_rad_s,
                           double step_s, state_t *to) {
    to->angle_rad = from->angle_rad + step_s * speed_rad_s;
    to->speed_rad_s = from->speed_rad_s + step_s * derivative->acceleration_rad_s2;
    for (unsigned index = 0; index < count; index++) {
        to->current_A[index] = from->current_A[index] + step_s * derivative->current_A_s[index];
    }
}

/* One classical Runge-Kutta step from `start`, whose derivative `first` is. */
MAGNETICS_INLINE void runge_kutta_step_of(const plant_t *plant, magnetics_form_t form, const conducting_t *conducting,
                                          unsigned count, const state_t *start, const derivative_t *first,
                                          double step_s, state_t *end, integrals_t *integrals) {
    state_t second_state, third_state, fourth_state;
    derivative_t second, third, fourth;
    move(count, start, first, start->speed_rad_s, 0.5 * step_s, &second_state);
    differentiate_of(plant, form, conducting, count, &second_state, &second);
    move(count, start, &second, second_state.speed_rad_s, 0.5 * step_s, &third_state);
    differentiate_of(plant, form, conducting, count, &third_state, &third);
    move(count, start, &third, third_state.speed_rad_s, step_s, &fourth_state);
    differentiate_of(plant, form, conducting, count, &fourth_state, &fourth);

    const double sixth_s = step_s / 6.0;
    integrals->angle_rad = sixth_s * (start->speed_rad_s + 2.0 * (second_state.speed_rad_s + third_state.speed_rad_s) +
                                      fourth_state.speed_rad_s);
    integrals->speed2_rad2_s = sixth_s * (start->speed_rad_s * start->speed_rad_s +
                                          2.0 * (second_state.speed_rad_s * second_state.speed_rad_s +
                                                 third_state.speed_rad_s * third_state.speed_rad_s) +
                                          fourth_state.speed_rad_s * fourth_state.speed_rad_s);
    integrals->current2_A2s = 0.0;
    end->angle_rad = start->angle_rad + integrals->angle_rad;
    end->speed_rad_s = start->speed_rad_s + sixth_s * (first->acceleration_rad_s2 +
                                                       2.0 * (second.acceleration_rad_s2 + third.acceleration_rad_s2) +
                                                       fourth.acceleration_rad_s2);
    for (unsigned index = 0; index < count; index++) {
        const double first_A = start->current_A[index], second_A = second_state.current_A[index];
        const double third_A = third_state.current_A[index], fourth_A = fourth_state.current_A[index];
        integrals->charge_As[index] = sixth_s * (first_A + 2.0 * (second_A + third_A) + fourth_A);
        integrals->current2_A2s +=
            sixth_s * (first_A * first_A + 2.0 * (second_A * second_A + third_A * third_A) + fourth_A * fourth_A);
        end->current_A[index] = first_A + sixth_s * (first->current_A_s[index] +
                                                     2.0 * (second.current_A_s[index] + third.current_A_s[index]) +
                                                     fourth.current_A_s[index]);
    }
}

MAGNETICS_INLINE void runge_kutta_step_in(const plant_t *plant, magnetics_form_t form, const conducting_t *conducting,
                                          const state_t *start, const derivative_t *first, double step_s, state_t *end,
                                          integrals_t *integrals) {
    if (conducting->count == 1) {
        runge_kutta_step_of(plant, form, conducting, 1, start, first, step_s, end, integrals);
    } else if (conducting->count == 2) {
        runge_kutta_step_of(plant, form, conducting, 2, start, first, step_s, end, integrals);
    } else {
        runge_kutta_step_of(plant, form, conducting, conducting->count, start, first, step_s, end, integrals);
    }
}

static void runge_kutta_step(const plant_t *plant, const conducting_t *conducting, const state_t *start,
                             const derivative_t *first, double step_s, state_t *end, integrals_t *integrals) {
    if (plant->magnetics.form == MAGNETICS_SATURATING) {
        runge_kutta_step_in(plant, MAGNETICS_SATURATING, conducting, start, first, step_s, end, integrals);
    } else if (plant->magnetics.form == MAGNETICS_LINEAR_COSINE) {
        runge_kutta_step_in(plant, MAGNETICS_LINEAR_COSINE, conducting, start, first, step_s, end, integrals);
    } else {
        runge_kutta_step_in(plant, MAGNETICS_LINEAR_TRAPEZOID, conducting, start, first, step_s, end, integrals);
    }
}

static double least_current_A(const conducting_t *conducting, const state_t *state) {
    double least_A = INFINITY;
    for (unsigned index = 0; index < conducting->count; index++) {
        if (conducting->voltage_V[index] <= 0.0 && state->current_A[index] < least_A) {
            least_A = state->current_A[index];
        }
    }
    return least_A;
}

/* The first current of those that fall has crossed zero within `step_s`: shortens the step to that instant. Illinois
 * variant of false position on the step's result; the current is nearly linear in time, so a few steps do. */
static double step_to_zero(const plant_t *plant, const conducting_t *conducting, const state_t *start,
                           const derivative_t *first, double step_s, state_t *end, integrals_t *integrals) {
    double before_s = 0.0, before_A = least_current_A(conducting, start);
    double after_s = step_s, after_A = least_current_A(conducting, end);
    int last_side = 0;
    double at_s = step_s;
    for (unsigned iteration = 0; iteration < ZERO_ITERATIONS; iteration++) {
        const double previous_s = at_s;
        at_s = before_s + (after_s - before_s) * (before_A / (before_A - after_A));
        runge_kutta_step(plant, conducting, start, first, at_s, end, integrals);
        const double at_A = least_current_A(conducting, end);
        if (at_A == 0.0 || fabs(at_s - previous_s) < ZERO_TOLERANCE_S) {
            break;
        }
        if (at_A > 0.0) {
            before_s = at_s;
            before_A = at_A;
            after_A *= last_side > 0 ? 0.5 : 1.0;
            last_side = 1;
        } else {
            after_s = at_s;
            after_A = at_A;
            before_A *= last_side < 0 ? 0.5 : 1.0;
            last_side = -1;
        }
    }
    return at_s;
}

/* --- Observation --- */

/* Cubic Hermite interpolation at fraction x of a step. */
static double interpolate(double x, double step_s, double start, double start_slope, double end, double end_slope) {
    const double y = 1.0 - x;
    return y * y * (start * (1.0 + 2.0 * x) + step_s * x * start_slope) +
           x * x * (end * (1.0 + 2.0 * y) - step_s * y * end_slope);
}

static void sample_now(plant_t *plant) {
    plant->sample(plant->sample_context, plant);
    plant->sample_next_ns += plant->sample_step_ns;
}

/* Samples within a step that began `start_s` after plant->time_ns, at instants before `limit_ns` and not after the
 * step's end. */
static void sample_step(plant_t *plant, const conducting_t *conducting, const state_t *start, const derivative_t *first,
                        const state_t *end, double start_s, double step_s, uint64_t limit_ns) {
    double at_s = (double)(plant->sample_next_ns - plant->time_ns) * NS_S;
    if (plant->sample_next_ns >= limit_ns || at_s > start_s + step_s) {
        return;
    }
    derivative_t last;
    differentiate(plant, conducting, end, &last);
    const uint64_t time_ns = plant->time_ns;
    const double angle_rad = plant->rotor_angle_rad, speed_rad_s = plant->speed_rad_s;
    double current_A[HAL_PHASES_MAX];
    memcpy(current_A, plant->current_A, sizeof current_A);
    do {
        const double x = (at_s - start_s) / step_s;
        plant->time_ns = plant->sample_next_ns;
        plant->rotor_angle_rad =
            interpolate(x, step_s, start->angle_rad, start->speed_rad_s, end->angle_rad, end->speed_rad_s);
        plant->speed_rad_s = interpolate(x, step_s, start->speed_rad_s, first->acceleration_rad_s2, end->speed_rad_s,
                                         last.acceleration_rad_s2);
        for (unsigned index = 0; index < conducting->count; index++) {
            const double at_A = interpolate(x, step_s, start->current_A[index], first->current_A_s[index],
                                            end->current_A[index], last.current_A_s[index]);
            plant->current_A[conducting->phase[index]] = at_A > 0.0 ? at_A : 0.0;
        }
        sample_now(plant);
        at_s = (double)(plant->sample_next_ns - time_ns) * NS_S;
    } while (plant->sample_next_ns < limit_ns && at_s <= start_s + step_s);
    plant->time_ns = time_ns;
    plant->rotor_angle_rad = angle_rad;
    plant->speed_rad_s = speed_rad_s;
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

/* The range of rotor angles around the present one in which no phase's magnetics lose their smoothness. */
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

/* The longest step from here: within the limits, and not across a place where the magnetics are not smooth. */
static double step_length_s(plant_t *plant, const conducting_t *conducting, const derivative_t *first,
                            double remaining_s) {
    const double speed_rad_s = fabs(plant->speed_rad_s);
    double limit_s = plant->step_max_s;
    if (speed_rad_s * limit_s > plant->step_angle_rad) {
        limit_s = plant->step_angle_rad / speed_rad_s;
    }
    for (unsigned index = 0; index < conducting->count; index++) {
        const double slope_A_s = fabs(first->current_A_s[index]);
        if (slope_A_s * limit_s > plant->step_current_A) {
            limit_s = plant->step_current_A / slope_A_s;
        }
    }
    double step_s = remaining_s;
    if (remaining_s > limit_s) {
        step_s = remaining_s / ceil(remaining_s / limit_s);
    }
    if (conducting->count == 0) {
        return step_s;
    }

    const double angle_rad = plant->rotor_angle_rad;
    if (angle_rad < plant->smooth_from_rad + MAGNETICS_SMOOTH_TOLERANCE_RAD ||
        angle_rad > plant->smooth_to_rad - MAGNETICS_SMOOTH_TOLERANCE_RAD) {
        find_smooth_range(plant);
    }
    const double distance_rad =
        plant->speed_rad_s > 0.0 ? plant->smooth_to_rad - angle_rad : angle_rad - plant->smooth_from_rad;
    if (speed_rad_s * step_s > distance_rad) {
        step_s = distance_rad / speed_rad_s;
    }
    return step_s;
}

static void book(plant_t *plant, const conducting_t *conducting, const integrals_t *integrals) {
    for (unsigned index = 0; index < conducting->count; index++) {
        const double energy_J = conducting->voltage_V[index] * integrals->charge_As[index];
        if (energy_J > 0.0) {
            plant->energy_drawn_J += energy_J;
        } else {
            plant->energy_returned_J -= energy_J;
        }
    }
    plant->energy_copper_J += plant->machine->resistance_ohm * integrals->current2_A2s;
    plant->energy_load_J += plant->load_torque_Nm * integrals->angle_rad;
    plant->energy_friction_J += plant->machine->friction_Nm_s * integrals->speed2_rad2_s;
}

/* From time_ns to `to_ns`, with the switches as they are. */
static void integrate(plant_t *plant, uint64_t to_ns) {
    const double length_s = (double)(to_ns - plant->time_ns) * NS_S;
    double at_s = 0.0;
    while (at_s < length_s) {
        conducting_t conducting;
        find_conducting(plant, &conducting);
        state_t start, end;
        derivative_t first;
        integrals_t integrals;
        start.angle_rad = plant->rotor_angle_rad;
        start.speed_rad_s = plant->speed_rad_s;
        for (unsigned index = 0; index < conducting.count; index++) {
            start.current_A[index] = plant->current_A[conducting.phase[index]];
        }
        differentiate(plant, &conducting, &start, &first);
        double step_s = step_length_s(plant, &conducting, &first, length_s - at_s);
        runge_kutta_step(plant, &conducting, &start, &first, step_s, &end, &integrals);
        if (least_current_A(&conducting, &end) < 0.0) {
            step_s = step_to_zero(plant, &conducting, &start, &first, step_s, &end, &integrals);
        }
        if (plant->sample != NULL) {
            sample_step(plant, &conducting, &start, &first, &end, at_s, step_s, to_ns);
        }
        book(plant, &conducting, &integrals);
        plant->rotor_angle_rad = end.angle_rad;
        plant->speed_rad_s = end.speed_rad_s;
        for (unsigned index = 0; index < conducting.count; index++) {
            plant->current_A[conducting.phase[index]] = end.current_A[index] > 0.0 ? end.current_A[index] : 0.0;
        }
        at_s += step_s;
    }
    plant->time_ns = to_ns;
}

void plant_advance(plant_t *plant, uint64_t to_ns) {
    while (plant->time_ns < to_ns) {
        while (plant->edge_next < plant->edge_count && plant->edges[plant->edge_next].time_ns <= plant->time_ns) {
            plant->switches = plant->edges[plant->edge_next++].switches;
        }
        if (plant->sample != NULL && plant->sample_next_ns == plant->time_ns) {
            sample_now(plant);
        }
        uint64_t until_ns = to_ns;
        if (plant->edge_next < plant->edge_count && plant->edges[plant->edge_next].time_ns < to_ns) {
            until_ns = plant->edges[plant->edge_next].time_ns;
        }
        integrate(plant, until_ns);
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
    return 0.5 * plant->machine->inertia_kg_m2 * plant->speed_rad_s * plant->speed_rad_s;
}
