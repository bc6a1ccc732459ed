/* Magnetics of one phase: flux linkage, its derivatives, torque and energy as functions of rotor angle and current.
 *
 * The formulas are psi = Lu i + f(theta) (g(i) - Lu i), T = f'(theta) W(i), W(i) = integral of g(i) - Lu i from 0:
 *
 *   linear, cosine      f = (1 + cos Nr theta) / 2, g = La i
 *   linear, trapezoid   f from 1 to 0 with flats at both ends, a straight slope and parabolic corners, g = La i
 *   saturating          H. Le-Huy, P. Brunelle, "A versatile nonlinear switched reluctance motor model in Simulink
 *                       using realistic and analytical magnetization characteristics", IECON 2005:
 *                       f = 2 (Nr theta / pi)^3 - 3 (Nr theta / pi)^2 + 1 on [0, pi / Nr], even,
 *                       g = Ls i + A (1 - e^(-b i)), A = psi_m - Ls I_m, b = (La - Ls) / A
 *
 * The fourth form is a flux-linkage map over angle and current: flux_map.h.
 *
 * The phase angle theta is mechanical: 0 aligned, half a pole pitch (pi / Nr) unaligned; torque is positive from half a
 * pitch to a whole one. Coupling of phases: coupled.h.
 */
#ifndef PLANT_MAGNETICS_H
#define PLANT_MAGNETICS_H

#include "plant/flux_map.h"

/* Size of the table of e^(-b i), which covers at least i <= 4 / b; larger currents are slower, with equal accuracy. */
#define MAGNETICS_DECAY_STEPS 512

typedef enum {
    MAGNETICS_LINEAR_COSINE,
    MAGNETICS_LINEAR_TRAPEZOID,
    MAGNETICS_SATURATING,
    MAGNETICS_MAP
} magnetics_form_t;

/* Magnetics as defined by the machine file. Fields that a form does not use are 0. */
typedef struct {
    magnetics_form_t form;
    double unaligned_inductance_H;        /* Lu, > 0; map: at 0 A */
    double aligned_inductance_H;          /* La, > Lu; saturating: at small currents */
    double flat_deg;                      /* trapezoid: flat at each end of half a pitch, mechanical degrees */
    double blend_deg;                     /* trapezoid: length of each parabolic corner, mechanical degrees */
    double saturated_inductance_H;        /* saturating: Ls, slope of the aligned curve at large currents */
    double flux_linkage_max_Wb;           /* saturating: psi_m, aligned at I_m */
    double current_at_flux_linkage_max_A; /* saturating: I_m */
    const flux_map_t *map;                /* map; must outlive its models */
} magnetics_t;

/* Magnetics with precomputed constants; initialised by magnetics_prepare. */
typedef struct {
    magnetics_form_t form;
    double unaligned_inductance_H;
    double inductance_min_H;                /* smallest incremental inductance at any angle and current */
    double saturation_A;                    /* scale on which the incremental inductance changes; infinite: constant */
    double linear_excess_H;                 /* (g(i) - Lu i) / i without the exponential part: La - Lu or Ls - Lu */
    double saturating_Wb;                   /* A; this and the members up to the table: saturating only */
    double saturation_1_A;                  /* b */
    double initial_slope_H;                 /* A b */
    double decay_step_A, decay_steps_per_A; /* a power of two, at most 1 / (64 b) */
    double decay_shift_A;                   /* added and subtracted: rounds to the step */
    double cubic_1_rad, cubic_gradient_1_rad, cubic_curvature_1_rad2; /* of the cubic f and its derivatives */
    double decay[MAGNETICS_DECAY_STEPS];                              /* e^(-b i) at multiples of the step */
    double pitch_rad, pitches_per_rad;
    double electrical_per_mechanical; /* Nr */
    double flat_rad, blend_rad, slope_1_rad, curvature_1_rad2;
    const flux_map_t *map;
    double map_steps_1_rad, map_steps_1_A, map_gain;
} magnetics_model_t;

/* One operating point. */
typedef struct {
    double flux_linkage_Wb;          /* psi */
    double incremental_inductance_H; /* d psi / d i, > 0 */
    double flux_gradient_Wb_rad;     /* d psi / d theta, per mechanical radian; times speed: back-EMF */
    double torque_Nm;                /* d co-energy / d theta */
    /* Second derivatives, for the integrator; d torque / d i equals flux_gradient_Wb_rad. */
    double inductance_slope_H_A;      /* d2 psi / d i2 */
    double inductance_gradient_H_rad; /* d2 psi / d i d theta */
    double flux_curvature_Wb_rad2;    /* d2 psi / d theta2 */
    double torque_gradient_Nm_rad;    /* d torque / d theta */
} magnetics_point_t;

/* Prepares `model` for `magnetics` of a machine with `rotor_poles` poles. The values must come from a validated
 * machine file; they are not checked. */
void magnetics_prepare(magnetics_model_t *model, const magnetics_t *magnetics, unsigned rotor_poles);

/* Multiplies flux linkage, and with it torque and energies, by `gain` (> 0) at every angle and current. */
void magnetics_scale(magnetics_model_t *model, double gain);

/* Computes the operating point at a phase angle (any mechanical angle, rad) and a current (A, >= 0; slightly negative
 * values continue the curves smoothly, for root finding). */
void magnetics_evaluate(const magnetics_model_t *model, double phase_angle_rad, double current_A,
                        magnetics_point_t *point);

/* Co-energy, the integral of psi over the current at a constant angle, in J. */
double magnetics_coenergy_J(const magnetics_model_t *model, double phase_angle_rad, double current_A);

/* Energy stored in the field: psi i - co-energy, in J. */
double magnetics_field_energy_J(const magnetics_model_t *model, double phase_angle_rad, double current_A);

/* A point where f is not smooth counts as passed when it is nearer than this. */
#define MAGNETICS_SMOOTH_TOLERANCE_RAD 1e-8

/* Distance, mechanical rad, > 0, from phase_angle_rad in a direction (+1 or -1) to the next point where the second or
 * third derivative of f jumps; infinite for the cosine, and for a map, whose jumps are many and small. An integrator
 * that ends its steps at these points keeps its order. */
double magnetics_smooth_distance_rad(const magnetics_model_t *model, double phase_angle_rad, double direction);

#endif
