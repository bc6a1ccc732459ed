#include "plant/magnetics.h"

#include <math.h>
#include <string.h>

#include "plant/exponential.h"
#include "plant/magnetics_kernel.h"
#include "plant/units.h"

void magnetics_prepare(magnetics_model_t *model, const magnetics_t *magnetics, unsigned rotor_poles) {
    memset(model, 0, sizeof *model);
    model->form = magnetics->form;
    model->unaligned_inductance_H = magnetics->unaligned_inductance_H;
    model->electrical_per_mechanical = rotor_poles;
    model->pitch_rad = 2.0 * PI / rotor_poles;
    model->pitches_per_rad = rotor_poles / (2.0 * PI);
    model->inductance_min_H = magnetics->unaligned_inductance_H;
    model->saturation_A = INFINITY;
    if (magnetics->form == MAGNETICS_MAP) {
        model->map = magnetics->map;
        model->map_steps_1_rad = 2.0 * FLUX_MAP_ANGLE_INTERVALS * model->pitches_per_rad;
        model->map_gain = 1.0;
        model->map_steps_1_A = FLUX_MAP_CURRENT_INTERVALS / magnetics->map->current_max_A;
        model->inductance_min_H = magnetics->map->inductance_min_H;
        model->saturation_A = magnetics->map->current_scale_A;
        return;
    }
    model->linear_excess_H = magnetics->aligned_inductance_H - magnetics->unaligned_inductance_H;
    if (magnetics->form == MAGNETICS_SATURATING) {
        const double saturated_H = magnetics->saturated_inductance_H;
        model->linear_excess_H = saturated_H - magnetics->unaligned_inductance_H;
        model->inductance_min_H = fmin(saturated_H, magnetics->unaligned_inductance_H);
        model->saturating_Wb = magnetics->flux_linkage_max_Wb - saturated_H * magnetics->current_at_flux_linkage_max_A;
        model->saturation_1_A = (magnetics->aligned_inductance_H - saturated_H) / model->saturating_Wb;
        model->saturation_A = 1.0 / model->saturation_1_A;
        model->initial_slope_H = model->saturating_Wb * model->saturation_1_A;
        model->decay_step_A = exp2(floor(log2(model->saturation_A / 64.0)));
        model->decay_steps_per_A = 1.0 / model->decay_step_A;
        model->decay_shift_A = ROUNDING_SHIFT * model->decay_step_A;
        model->cubic_1_rad = 2.0 * model->pitches_per_rad;
        model->cubic_gradient_1_rad = 12.0 * model->pitches_per_rad;
        model->cubic_curvature_1_rad2 = 24.0 * model->pitches_per_rad * model->pitches_per_rad;
        for (unsigned step = 0; step < MAGNETICS_DECAY_STEPS; step++) {
            model->decay[step] = exponential(-model->saturation_1_A * model->decay_step_A * step);
        }
    }
    if (magnetics->form == MAGNETICS_LINEAR_TRAPEZOID) {
        model->flat_rad = magnetics->flat_deg * PI / 180.0;
        model->blend_rad = magnetics->blend_deg * PI / 180.0;
        model->slope_1_rad = 1.0 / (0.5 * model->pitch_rad - 2.0 * model->flat_rad - model->blend_rad);
        model->curvature_1_rad2 = model->blend_rad > 0.0 ? model->slope_1_rad / model->blend_rad : 0.0;
    }
}

void magnetics_scale(magnetics_model_t *model, double gain) {
    model->unaligned_inductance_H *= gain;
    model->inductance_min_H *= gain;
    model->linear_excess_H *= gain;
    model->saturating_Wb *= gain;
    model->initial_slope_H *= gain;
    model->map_gain *= gain;
}

void magnetics_evaluate(const magnetics_model_t *model, double phase_angle_rad, double current_A,
                        magnetics_point_t *point) {
    magnetics_kernel(model, model->form, phase_angle_rad, current_A, 0.0, point);
}

/* W(i), the integral of g(i) - Lu i from 0 to i. */
static double excess_energy_J(const magnetics_model_t *model, double current_A) {
    double energy_J = 0.5 * model->linear_excess_H * current_A * current_A;
    if (model->form == MAGNETICS_SATURATING) {
        const double decay = magnetics_kernel_decay(model, current_A);
        energy_J += model->saturating_Wb * (current_A - (1.0 - decay) * model->saturation_A);
    }
    return energy_J;
}

double magnetics_coenergy_J(const magnetics_model_t *model, double phase_angle_rad, double current_A) {
    if (model->form == MAGNETICS_MAP) {
        magnetics_point_t point;
        double coenergy_J;
        flux_map_kernel(model, magnetics_kernel_wrap(model, phase_angle_rad), current_A, &point, &coenergy_J);
        return coenergy_J;
    }
    magnetics_shape_t shape;
    magnetics_kernel_shape(model, model->form, phase_angle_rad, 0.0, &shape);
    return 0.5 * model->unaligned_inductance_H * current_A * current_A + shape.f * excess_energy_J(model, current_A);
}

double magnetics_field_energy_J(const magnetics_model_t *model, double phase_angle_rad, double current_A) {
    magnetics_point_t point;
    magnetics_evaluate(model, phase_angle_rad, current_A, &point);
    return point.flux_linkage_Wb * current_A - magnetics_coenergy_J(model, phase_angle_rad, current_A);
}

double magnetics_smooth_distance_rad(const magnetics_model_t *model, double phase_angle_rad, double direction) {
    /* Points within half a pole pitch; the mirrored ones follow because f is even. */
    const double half_rad = 0.5 * model->pitch_rad;
    const double flat_end_rad = model->flat_rad, corner_end_rad = model->flat_rad + model->blend_rad;
    double kinks_rad[4] = {0.0, half_rad, 0.0, 0.0};
    unsigned kinks = 2;
    if (model->form == MAGNETICS_LINEAR_COSINE || model->form == MAGNETICS_MAP) {
        return INFINITY;
    }
    if (model->form == MAGNETICS_LINEAR_TRAPEZOID) {
        kinks_rad[0] = flat_end_rad;
        kinks_rad[1] = corner_end_rad;
        kinks_rad[2] = half_rad - corner_end_rad;
        kinks_rad[3] = half_rad - flat_end_rad;
        kinks = 4;
    }
    const double position_rad = phase_angle_rad - floor(phase_angle_rad * model->pitches_per_rad) * model->pitch_rad;
    double nearest_rad = model->pitch_rad;
    for (unsigned mirrored = 0; mirrored < 2; mirrored++) {
        for (unsigned kink = 0; kink < kinks; kink++) {
            const double at_rad = mirrored ? model->pitch_rad - kinks_rad[kink] : kinks_rad[kink];
            double distance_rad = (at_rad - position_rad) * direction;
            distance_rad -= floor(distance_rad * model->pitches_per_rad) * model->pitch_rad;
            if (distance_rad > MAGNETICS_SMOOTH_TOLERANCE_RAD && distance_rad < nearest_rad) {
                nearest_rad = distance_rad;
            }
        }
    }
    return nearest_rad;
}
