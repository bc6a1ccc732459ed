/* Inner loop of the plant: magnetics_evaluate as inline functions for the integrator, where a call takes as long as the
 * arithmetic. Included only by magnetics.c and integrator.c, and for the sine by sensors.c and rig/load.c; all others
 * call magnetics.h.
 *
 * Exponential and cosine do not use libm: see exponential.h. */
#ifndef PLANT_MAGNETICS_KERNEL_H
#define PLANT_MAGNETICS_KERNEL_H

#include <math.h>
#include <stdint.h>

#include "plant/exponential.h"
#include "plant/flux_map_kernel.h"
#include "plant/magnetics.h"

/* e^(-b i), relative error below 1e-15: the nearest entry of the table times a series of the remainder, abs <= 1/128.
 */
MAGNETICS_INLINE double magnetics_kernel_decay(const magnetics_model_t *model, double current_A) {
    const double nearest_A = (current_A + model->decay_shift_A) - model->decay_shift_A;
    const int64_t step = (int64_t)(nearest_A * model->decay_steps_per_A);
    if (step < 0 || step >= MAGNETICS_DECAY_STEPS) {
        return exponential(-model->saturation_1_A * current_A);
    }
    const double x = model->saturation_1_A * (nearest_A - current_A), x2 = x * x;
    return model->decay[step] * ((1.0 + x) + x2 * ((0.5 + x * (1.0 / 6.0)) + x2 * (1.0 / 24.0 + x * (1.0 / 120.0))));
}

/* Sine and cosine for abs(x) <= pi, absolute error below 2e-15: series of x / 4, then two double-angle steps. */
MAGNETICS_INLINE void magnetics_kernel_sine_cosine(double x, double *sine, double *cosine) {
    const double q = 0.25 * x, z = q * q, z2 = z * z, z4 = z2 * z2;
    const double quarter_sine =
        q *
        (((1.0 - z * (1.0 / 6.0)) + z2 * (1.0 / 120.0 - z * (1.0 / 5040.0))) +
         z4 * ((1.0 / 362880.0 - z * (1.0 / 39916800.0)) + z2 * (1.0 / 6227020800.0 - z * (1.0 / 1307674368000.0))));
    const double quarter_cosine =
        ((1.0 - z * 0.5) + z2 * (1.0 / 24.0 - z * (1.0 / 720.0))) +
        z4 * ((1.0 / 40320.0 - z * (1.0 / 3628800.0)) + z2 * (1.0 / 479001600.0 - z * (1.0 / 87178291200.0)) +
              z4 * (1.0 / 20922789888000.0));
    const double half_sine = 2.0 * quarter_sine * quarter_cosine;
    const double half_cosine = 1.0 - 2.0 * quarter_sine * quarter_sine;
    *sine = 2.0 * half_sine * half_cosine;
    *cosine = 1.0 - 2.0 * half_sine * half_sine;
}

/* f and its derivatives at an angle, per mechanical radian. */
typedef struct {
    double f, gradient_1_rad, curvature_1_rad2;
} magnetics_shape_t;

/* f over half a pole pitch, from 1 at 0 to 0 at half a pitch. The curvature jumps at the corners; `ahead_rad`, an angle
 * slightly ahead in the direction of motion, selects the side of a corner. */
MAGNETICS_INLINE void magnetics_kernel_trapezoid(const magnetics_model_t *model, double angle_rad, double ahead_rad,
                                                 magnetics_shape_t *shape) {
    const double unaligned_rad = 0.5 * model->pitch_rad - model->flat_rad;
    const double from_aligned = angle_rad - model->flat_rad, to_unaligned = unaligned_rad - angle_rad;
    if (ahead_rad <= model->flat_rad || ahead_rad >= unaligned_rad) {
        *shape = (magnetics_shape_t){ahead_rad <= model->flat_rad ? 1.0 : 0.0, 0.0, 0.0};
    } else if (ahead_rad < model->flat_rad + model->blend_rad) {
        shape->curvature_1_rad2 = -model->curvature_1_rad2;
        shape->gradient_1_rad = -model->curvature_1_rad2 * from_aligned;
        shape->f = 1.0 + 0.5 * shape->gradient_1_rad * from_aligned;
    } else if (ahead_rad > unaligned_rad - model->blend_rad) {
        shape->curvature_1_rad2 = model->curvature_1_rad2;
        shape->gradient_1_rad = -model->curvature_1_rad2 * to_unaligned;
        shape->f = -0.5 * shape->gradient_1_rad * to_unaligned;
    } else {
        shape->curvature_1_rad2 = 0.0;
        shape->gradient_1_rad = -model->slope_1_rad;
        shape->f = 1.0 - model->slope_1_rad * (from_aligned - 0.5 * model->blend_rad);
    }
}

/* Phase angle wrapped to +- half a pole pitch. */
MAGNETICS_INLINE double magnetics_kernel_wrap(const magnetics_model_t *model, double phase_angle_rad) {
    const double pitches = (phase_angle_rad * model->pitches_per_rad + ROUNDING_SHIFT) - ROUNDING_SHIFT;
    return phase_angle_rad - pitches * model->pitch_rad;
}

/* f at any phase angle. `form` is the model's, a separate argument so that with a constant the compiler
 * removes the other forms. */
MAGNETICS_INLINE void magnetics_kernel_shape(const magnetics_model_t *model, magnetics_form_t form,
                                             double phase_angle_rad, double ahead_rad, magnetics_shape_t *shape) {
    const double wrapped_rad = magnetics_kernel_wrap(model, phase_angle_rad);
    if (form == MAGNETICS_LINEAR_COSINE) {
        double sine, cosine;
        magnetics_kernel_sine_cosine(model->electrical_per_mechanical * wrapped_rad, &sine, &cosine);
        shape->f = 0.5 + 0.5 * cosine;
        shape->gradient_1_rad = -0.5 * model->electrical_per_mechanical * sine;
        shape->curvature_1_rad2 = -0.5 * model->electrical_per_mechanical * model->electrical_per_mechanical * cosine;
        return;
    }
    const double folded_rad = fabs(wrapped_rad);
    if (form == MAGNETICS_SATURATING) {
        const double x = folded_rad * model->cubic_1_rad; /* 0 aligned, 1 unaligned */
        shape->f = 1.0 + x * x * (2.0 * x - 3.0);
        shape->gradient_1_rad = model->cubic_gradient_1_rad * (x * (x - 1.0));
        shape->curvature_1_rad2 = model->cubic_curvature_1_rad2 * (2.0 * x - 1.0);
    } else {
        magnetics_kernel_trapezoid(model, folded_rad, folded_rad + copysign(ahead_rad, ahead_rad * wrapped_rad), shape);
    }
    shape->gradient_1_rad = copysign(shape->gradient_1_rad, -wrapped_rad);
}

/* See magnetics_evaluate; `form` and `ahead_rad` as above. */
MAGNETICS_INLINE void magnetics_kernel(const magnetics_model_t *model, magnetics_form_t form, double phase_angle_rad,
                                       double current_A, double ahead_rad, magnetics_point_t *point) {
    if (form == MAGNETICS_MAP) {
        double coenergy_J;
        flux_map_kernel(model, magnetics_kernel_wrap(model, phase_angle_rad), current_A, point, &coenergy_J);
        return;
    }
    magnetics_shape_t shape;
    magnetics_kernel_shape(model, form, phase_angle_rad, ahead_rad, &shape);
    /* g(i) - Lu i, its first and second derivatives, and its integral W(i) */
    double excess_Wb = model->linear_excess_H * current_A;
    double excess_H = model->linear_excess_H;
    double excess_H_A = 0.0;
    double excess_J = 0.5 * excess_Wb * current_A;
    if (form == MAGNETICS_SATURATING) {
        const double decay = magnetics_kernel_decay(model, current_A);
        const double knee_Wb = model->saturating_Wb * (1.0 - decay);
        excess_Wb += knee_Wb;
        excess_H += model->initial_slope_H * decay;
        excess_H_A = -model->saturation_1_A * (model->initial_slope_H * decay);
        excess_J += model->saturating_Wb * current_A - knee_Wb * model->saturation_A;
    }
    point->flux_linkage_Wb = model->unaligned_inductance_H * current_A + shape.f * excess_Wb;
    point->incremental_inductance_H = model->unaligned_inductance_H + shape.f * excess_H;
    point->flux_gradient_Wb_rad = shape.gradient_1_rad * excess_Wb;
    point->torque_Nm = shape.gradient_1_rad * excess_J;
    point->inductance_slope_H_A = shape.f * excess_H_A;
    point->inductance_gradient_H_rad = shape.gradient_1_rad * excess_H;
    point->flux_curvature_Wb_rad2 = shape.curvature_1_rad2 * excess_Wb;
    point->torque_gradient_Nm_rad = shape.curvature_1_rad2 * excess_J;
}

#endif
