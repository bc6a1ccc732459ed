#include "plant/magnetics.h"
#include "plant/magnetics_kernel.h"

#include <math.h>
#include <stdint.h>
#include <string.h>

#define PI 3.14159265358979323846

/* 2^(j/64) */
static const double exponential_table[64] = {
    // clang-format off
    1.00000000000000000000, 1.01088928605170046002, 1.02189714865411667823, 1.03302487902122842250,
    1.04427378242741384032, 1.05564517836055715881, 1.06714040067682361817, 1.07876079775711979374,
    1.09050773266525765921, 1.10238258330784094356, 1.11438674259589253631, 1.12652161860824189979,
    1.13878863475669165370, 1.15118922995298270582, 1.16372485877757751381, 1.17639699165028127628,
    1.18920711500272106672, 1.20215673145270314210, 1.21524735998046887812, 1.22848053610687000569,
    1.24185781207348404859, 1.25538075702469108958, 1.26905095719173322255, 1.28287001607877828073,
    1.29683955465100966593, 1.31096121152476434192, 1.32523664315974129463, 1.33966752405330300536,
    1.35425554693689272830, 1.36900242297459061193, 1.38390988196383195487, 1.39897967253831114021,
    1.41421356237309504880, 1.42961333839197001124, 1.44518080697704662004, 1.46091779418064698865,
    1.47682614593949931139, 1.49290772829126484920, 1.50916442759342273977, 1.52559815074453830685,
    1.54221082540794082361, 1.55900440023783696703, 1.57598084510788648646, 1.59314215134226689794,
    1.61049033194925430818, 1.62802742185734776685, 1.64575547815396484452, 1.66367658032673643505,
    1.68179283050742908606, 1.70010635371852346950, 1.71861929812247791563, 1.73733383527370624899,
    1.75625216037329948311, 1.77537649252652125255, 1.79470907500310718643, 1.81425217550039875625,
    1.83400808640934246349, 1.85397912508338556839, 1.87416763411029990133, 1.89457598158696564134,
    1.91520656139714729387, 1.93606179349229445060, 1.95714412417540026902, 1.97845602638795096826,
    // clang-format on
};

/* x = (64 n + j) ln 2 / 64 + r, abs(r) <= ln 2 / 128. */
double magnetics_exponential(double x) {
    const double ln2_64_high = 0x1.62e42fef00000p-7, ln2_64_low = 0x1.473de6af278edp-40;
    if (x < -700.0) {
        return 0.0;
    }
    const double shifted = x * 0x1.71547652b82fep+6 + MAGNETICS_ROUNDING_SHIFT;
    const double whole = shifted - MAGNETICS_ROUNDING_SHIFT;
    const int64_t steps = (int64_t)whole;
    const double r = (x - whole * ln2_64_high) - whole * ln2_64_low;
    const double r2 = r * r;
    const double series = r + r2 * (0.5 + r * (1.0 / 6.0)) + r2 * r2 * (1.0 / 24.0 + r * (1.0 / 120.0));
    const double fraction = exponential_table[steps & 63];
    double result = fraction + fraction * series;
    uint64_t bits;
    memcpy(&bits, &result, sizeof bits);
    bits += (uint64_t)(steps >> 6) << 52;
    memcpy(&result, &bits, sizeof result);
    return result;
}

void magnetics_prepare(magnetics_model_t *model, const magnetics_t *magnetics, unsigned rotor_poles) {
    memset(model, 0, sizeof *model);
    model->form = magnetics->form;
    model->unaligned_inductance_H = magnetics->unaligned_inductance_H;
    model->electrical_per_mechanical = rotor_poles;
    model->pitch_rad = 2.0 * PI / rotor_poles;
    model->pitches_per_rad = rotor_poles / (2.0 * PI);
    model->least_inductance_H = magnetics->unaligned_inductance_H;
    model->saturation_A = INFINITY;
    if (magnetics->form == MAGNETICS_MAP) {
        model->map = magnetics->map;
        model->map_steps_1_rad = 2.0 * FLUX_MAP_ANGLE_INTERVALS * model->pitches_per_rad;
        model->map_gain = 1.0;
        model->map_steps_1_A = FLUX_MAP_CURRENT_INTERVALS / magnetics->map->current_max_A;
        model->least_inductance_H = magnetics->map->least_inductance_H;
        model->saturation_A = magnetics->map->current_scale_A;
        return;
    }
    model->linear_excess_H = magnetics->aligned_inductance_H - magnetics->unaligned_inductance_H;
    if (magnetics->form == MAGNETICS_SATURATING) {
        const double saturated_H = magnetics->saturated_inductance_H;
        model->linear_excess_H = saturated_H - magnetics->unaligned_inductance_H;
        model->least_inductance_H = fmin(saturated_H, magnetics->unaligned_inductance_H);
        model->saturating_Wb = magnetics->flux_linkage_max_Wb - saturated_H * magnetics->current_at_flux_linkage_max_A;
        model->saturation_1_A = (magnetics->aligned_inductance_H - saturated_H) / model->saturating_Wb;
        model->saturation_A = 1.0 / model->saturation_1_A;
        model->initial_slope_H = model->saturating_Wb * model->saturation_1_A;
        model->decay_step_A = exp2(floor(log2(model->saturation_A / 64.0)));
        model->decay_steps_per_A = 1.0 / model->decay_step_A;
        for (unsigned step = 0; step < MAGNETICS_DECAY_STEPS; step++) {
            model->decay[step] = magnetics_exponential(-model->saturation_1_A * model->decay_step_A * step);
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
    model->least_inductance_H *= gain;
    model->linear_excess_H *= gain;
    model->saturating_Wb *= gain;
    model->initial_slope_H *= gain;
    model->map_gain *= gain;
}

void magnetics_evaluate(const magnetics_model_t *model, double phase_angle_rad, double current_A,
                        magnetics_point_t *point) {
    magnetics_kernel(model, model->form, phase_angle_rad, current_A, 0.0, point);
}

/* W(i), the integral of g(i) - Lu i. */
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
    /* Within half a pitch; the mirrored ones follow from the evenness of f. */
    const double half_rad = 0.5 * model->pitch_rad;
    const double flat_end_rad = model->flat_rad, corner_end_rad = model->flat_rad + model->blend_rad;
    double places_rad[4] = {0.0, half_rad, 0.0, 0.0};
    unsigned places = 2;
    if (model->form == MAGNETICS_LINEAR_COSINE || model->form == MAGNETICS_MAP) {
        return INFINITY;
    }
    if (model->form == MAGNETICS_LINEAR_TRAPEZOID) {
        places_rad[0] = flat_end_rad;
        places_rad[1] = corner_end_rad;
        places_rad[2] = half_rad - corner_end_rad;
        places_rad[3] = half_rad - flat_end_rad;
        places = 4;
    }
    const double position_rad = phase_angle_rad - floor(phase_angle_rad * model->pitches_per_rad) * model->pitch_rad;
    double nearest_rad = model->pitch_rad;
    for (unsigned mirrored = 0; mirrored < 2; mirrored++) {
        for (unsigned place = 0; place < places; place++) {
            const double at_rad = mirrored ? model->pitch_rad - places_rad[place] : places_rad[place];
            double distance_rad = (at_rad - position_rad) * direction;
            distance_rad -= floor(distance_rad * model->pitches_per_rad) * model->pitch_rad;
            if (distance_rad > MAGNETICS_SMOOTH_TOLERANCE_RAD && distance_rad < nearest_rad) {
                nearest_rad = distance_rad;
            }
        }
    }
    return nearest_rad;
}
