#include "control/misalignment.h"

#include "control/phase_map.h"
#include "fixed/compiler.h"
#include "fixed/divide.h"
#include "fixed/fixed.h"

#define MEAN_1_S 10
#define FILTER_GAIN_MAX_Q16 65535 /* largest below one */
#define SETTLE_MS 150
/* Settling time x 8, 1.2 s, after a contradiction. */
#define CONTRADICTED_SHIFT 3
#define TORQUE_MIN_Q24 (1u << 24)
/* 0.05 * 0.02^2 of T^2, Q32: keeps the denominator above the noise of s_j. */
#define POWER_FLOOR_Q32 (21 << 12)
#define OFFSET_LIMIT_Q40 (((int64_t)7 << 40) / 2)
/* Error that a step corrects, 0.08 rad: a load step teaches little before the end of its stroke, where learning stops.
 */
#define STEP_MAX_Q10 (4 << 10)
/* Mean of the square of the sum: 25 ms at 40 kHz, updates every 8 periods. */
#define COMMON_POWER_SHIFT 8
/* Its rate is half of the phases': the sum is smaller than its parts, and the noise is not. */
#define COMMON_SLOWER 2
/* Corner of high-pass and low-pass of the sum and of y in rad per stroke, and the largest gain of both. */
#define BAND_FACTOR 4
#define BAND_GAIN_MAX_Q16 (1 << 15)
/* (0.02 rad / s)^2 9 / 48 / 16, which is 75. */
#define NOISE_FACTOR 75
#define TWO_PI_Q10 6434

/* N / 16 = 75 rate Ts (J w0^2 q)^2, in (N m per 0.02 rad)^2. */
static int32_t noise_q22(const misalignment_settings_t *settings) {
    const uint64_t square = (uint64_t)settings->bandwidth_rad_s * settings->bandwidth_rad_s; /* 27 bits */
    const uint64_t per_turn_q24 = ((uint64_t)settings->inertia_q30 * square >> 16) * TWO_PI_Q10;
    const int64_t count_q24 = (int64_t)(per_turn_q24 >> (settings->encoder_bits + settings->speed_exponent));
    const int64_t limited_q24 = fixed_clamp_64(count_q24, 0, INT32_MAX);
    const int64_t squared_q22 = (limited_q24 * limited_q24) >> 26;
    return fixed_saturate(fixed_divide(squared_q22 * NOISE_FACTOR * settings->rate_1_s, settings->control_rate_hz));
}

misalignment_parameters_t misalignment_configure(const misalignment_settings_t *settings) {
    const uint32_t update_rate_hz = settings->control_rate_hz / settings->periods_per_update;
    const uint32_t phase_rate_hz = update_rate_hz / settings->phases;
    const uint32_t common_rate_hz = settings->control_rate_hz / settings->periods_per_common_update;
    const uint32_t probe_angle = MISALIGNMENT_PROBE_ANGLE * settings->rotor_poles;
    return (misalignment_parameters_t){
        .probe_angle = probe_angle,
        .rate_q30 = (int32_t)fixed_divide((int64_t)settings->rate_1_s << 30, phase_rate_hz),
        .common_rate_q30 = (int32_t)fixed_divide((int64_t)settings->rate_1_s << 30, COMMON_SLOWER * common_rate_hz),
        .flux_rate_q8 = (int32_t)fixed_divide((int64_t)settings->rate_1_s << 46, (int64_t)probe_angle * phase_rate_hz),
        .filter_q32 = (int32_t)fixed_divide(((int64_t)8 << 32) / 5, phase_rate_hz),
        .mean_q16 = (int32_t)fixed_divide((int64_t)MEAN_1_S << 16, phase_rate_hz) + 1,
        .noise_q22 = noise_q22(settings),
        .inertia_rate_q8 = fixed_saturate(((int64_t)settings->inertia_q30 * settings->control_rate_hz) >> 22),
        .settle_updates = update_rate_hz * SETTLE_MS / 1000u,
    };
}

/* First-order low-pass: value += gain (target - value), gain in Q0.16. Added in two halves, because a gain in Q32 would
 * not fit in 32 bits. */
static inline void low_pass_step(int32_t *value, int32_t target, int32_t gain_q16) {
    const int32_t half = fixed_multiply_high(fixed_subtract(target, *value), gain_q16 << 15);
    *value = fixed_add(fixed_add(*value, half), half);
}

static int32_t square_q24(int32_t value_q24) {
    return fixed_multiply_shift(value_q24, value_q24, 24);
}

int32_t misalignment_disturbance_q24(int32_t inertia_rate_q8, int32_t load_torque_q24, int32_t speed_correction_q22) {
    return fixed_subtract(load_torque_q24, fixed_multiply_shift(speed_correction_q22, inertia_rate_q8, 6));
}

int32_t misalignment_slope_q24(const misalignment_t *misalignment) {
    int32_t sum_q24 = 0;
    UNROLL(4)
    for (unsigned i = 0; i < HAL_PHASES_MAX; i++) {
        sum_q24 = fixed_add(sum_q24, misalignment->phase[i].slope_q24);
    }
    return sum_q24;
}

static int32_t slope_at_q24(const misalignment_parameters_t *parameters, const machine_tables_t *tables, uint32_t angle,
                            int32_t current_q9) {
    return current_q9 > 0 ? phase_map_torque_slope_q24(tables, angle, current_q9, 2 * parameters->probe_angle) : 0;
}

static int32_t limited_step_q10(int32_t step_q10) {
    return fixed_clamp(step_q10, -STEP_MAX_Q10, STEP_MAX_Q10);
}

static int64_t clamped_offset_q40(int64_t offset_q40) {
    return fixed_clamp_64(offset_q40, -OFFSET_LIMIT_Q40, OFFSET_LIMIT_Q40);
}

/* Step of a phase towards the angle that its flux linkage shows, which the end of a stroke does not undo. */
static inline int64_t flux_step_q40(const misalignment_parameters_t *parameters, misalignment_phase_t *phase,
                                    int32_t flux_error) {
    const int64_t step_q40 = fixed_product(flux_error, parameters->flux_rate_q8) >> 8;
    phase->before_last_q40 += step_q40;
    phase->before_q40 += step_q40;
    return step_q40;
}

static inline void add_to_offset(const misalignment_parameters_t *parameters, misalignment_phase_t *phase,
                                 int64_t step_q40) {
    phase->offset_q40 = clamped_offset_q40(phase->offset_q40 + step_q40);
    /* 0.02 rad is twice the probe angle. */
    phase->offset =
        fixed_multiply_shift((int32_t)fixed_shift(phase->offset_q40, 12), (int32_t)parameters->probe_angle, 27);
}

COLD bool misalignment_is_intact(const misalignment_parameters_t *parameters, const misalignment_t *misalignment,
                                 uint32_t phases) {
    for (unsigned i = 0; i < phases; i++) {
        if (fixed_magnitude(misalignment->phase[i].offset) > 8u * parameters->probe_angle) { /* 3.5 of 0.02 rad are 7 */
            return false;
        }
    }
    return true;
}

/* Gain of means over the time since the state became steady, at most 100 ms: before, the load was another. */
static inline int32_t growing_mean_q16(const misalignment_parameters_t *parameters, uint32_t steady_updates,
                                       int32_t phases) {
    const int32_t gain_q16 = FILTER_GAIN_MAX_Q16 / ((int32_t)steady_updates / phases + 1);
    return gain_q16 > parameters->mean_q16 ? gain_q16 : parameters->mean_q16;
}

/* The phase to update; the next step takes the next one. */
static inline misalignment_phase_t *take_phase(misalignment_t *misalignment, const machine_tables_t *tables) {
    const unsigned index = misalignment_phase_index(misalignment);
    misalignment->phase_index = index + 1 < tables->phases ? index + 1 : 0;
    misalignment_phase_t *phase = &misalignment->phase[index];
    IN_REGISTER(phase);
    return phase;
}

static inline int32_t flux_error(const misalignment_phase_t *phase, int32_t flux_misalignment) {
    return flux_misalignment != 0 ? fixed_subtract(flux_misalignment, phase->offset) : 0;
}

/* Counts the steady updates, and decides whether the ripple teaches in this one. True if the state had settled before
 * it. */
static inline bool settle(const misalignment_parameters_t *parameters, misalignment_t *misalignment,
                          const misalignment_sample_t *sample, int32_t error) {
    const bool torque_suffices = fixed_magnitude(sample->torque_q24) > TORQUE_MIN_Q24;
    const bool steady = sample->condition == MISALIGNMENT_STEADY && torque_suffices;
    const bool contradicted = fixed_magnitude(error) > parameters->probe_angle / 2;
    const bool settled = misalignment->steady_updates >= parameters->settle_updates
                                                             << (misalignment->contradicted ? CONTRADICTED_SHIFT : 0);
    if (steady) {
        misalignment->steady_updates += !settled;
    } else if (sample->condition == MISALIGNMENT_UNSTEADY) {
        misalignment->steady_updates = 0;
    }
    if (settled) {
        misalignment->contradicted = contradicted;
        misalignment->steady_updates = contradicted ? 0 : misalignment->steady_updates;
    }
    misalignment->learning = steady && settled && !contradicted;
    return settled;
}

/* Slope of the phase as y shows it, its alternating part, N m per 0.02 rad, Q7.24; means of y and of the slopes' power.
 * One phase per update stands for all: the sum over the phases. */
static inline int32_t filter_slopes(const misalignment_parameters_t *parameters, misalignment_t *misalignment,
                                    misalignment_phase_t *phase, const machine_tables_t *tables,
                                    const misalignment_sample_t *sample, int32_t mean_gain_q16) {
    phase->slope_q24 = slope_at_q24(parameters, tables, sample->angle, sample->current_q9);
    const int32_t filter_q16 = fixed_clamp(
        fixed_multiply_high((int32_t)(sample->bandwidth_rad_s << 16), parameters->filter_q32), 0, FILTER_GAIN_MAX_Q16);
    low_pass_step(&phase->slope_lag1_q24, phase->slope_q24, filter_q16);
    low_pass_step(&phase->slope_lag2_q24, phase->slope_lag1_q24, filter_q16);
    low_pass_step(&phase->slope_mean_q24, phase->slope_lag2_q24, mean_gain_q16);
    const int32_t alternating_q24 = fixed_subtract(phase->slope_lag2_q24, phase->slope_mean_q24);
    const int32_t phase_power_q24 = square_q24(alternating_q24);
    int32_t power_q24 = 0;
    UNROLL(4)
    for (unsigned i = 0; i < tables->phases; i++) {
        power_q24 = fixed_add(power_q24, phase_power_q24);
    }
    const int32_t gain_q16 = mean_gain_q16 / (int32_t)tables->phases + 1;
    low_pass_step(&misalignment->power_q24, power_q24, gain_q16);
    low_pass_step(&misalignment->disturbance_mean_q24, sample->disturbance_q24, gain_q16);
    return alternating_q24;
}

/* Step of a phase by least mean squares, 0.02 rad, Q10. disturbances_q24: sum of y since its last update, of at most
 * four, 32 bits each. */
static inline int32_t lms_step_q10(const misalignment_t *misalignment, int64_t disturbances_q24,
                                   int32_t alternating_q24, int32_t torque_q24, int32_t phases) {
    const int32_t recent_mean_q24 = 4 * ((int32_t)(disturbances_q24 >> 2) / phases);
    const int32_t error_q24 = fixed_subtract(recent_mean_q24, misalignment->disturbance_mean_q24);
    const int32_t floor_q24 = fixed_multiply_high(square_q24(torque_q24), POWER_FLOOR_Q32);
    const int32_t denominator_q20 = (fixed_add(misalignment->power_q24, floor_q24) >> 4) + 1;
    /* Q24 * Q24 to Q30, divided by Q20: Q10. */
    return limited_step_q10(fixed_multiply_shift(error_q24, alternating_q24, 18) / denominator_q20);
}

void misalignment_step(const misalignment_parameters_t *parameters, misalignment_t *misalignment,
                       const machine_tables_t *tables, const misalignment_sample_t *sample) {
    misalignment_phase_t *phase = take_phase(misalignment, tables);
    const int32_t phases = (int32_t)tables->phases;
    const int32_t error = flux_error(phase, sample->flux_misalignment);
    const bool settled = settle(parameters, misalignment, sample, error);
    const int32_t mean_gain_q16 =
        settled ? parameters->mean_q16 : growing_mean_q16(parameters, misalignment->steady_updates, phases);
    misalignment->disturbance_sum_q24 += sample->disturbance_q24;
    const int64_t disturbances_q24 = misalignment->disturbance_sum_q24 - phase->last_sum_q24;
    phase->last_sum_q24 = misalignment->disturbance_sum_q24;
    const int32_t alternating_q24 = filter_slopes(parameters, misalignment, phase, tables, sample, mean_gain_q16);
    int64_t step_q40 = misalignment->common_sum_q40 - phase->common_sum_q40;
    phase->common_sum_q40 = misalignment->common_sum_q40;
    if (misalignment->learning) {
        const int32_t step_q10 =
            lms_step_q10(misalignment, disturbances_q24, alternating_q24, sample->torque_q24, phases);
        step_q40 = fixed_accumulate(step_q40, step_q10, parameters->rate_q30);
    } else { /* a last step of the common angle is dropped: the ripple teaches no longer */
        step_q40 = flux_step_q40(parameters, phase, error);
    }
    add_to_offset(parameters, phase, step_q40);
}

void misalignment_follow_flux(const misalignment_parameters_t *parameters, misalignment_t *misalignment,
                              const machine_tables_t *tables, uint32_t angle, int32_t current_q9,
                              int32_t flux_misalignment) {
    misalignment->steady_updates = 0;
    misalignment->learning = false;
    misalignment_phase_t *phase = take_phase(misalignment, tables);
    phase->slope_q24 = slope_at_q24(parameters, tables, angle, current_q9);
    add_to_offset(parameters, phase, flux_step_q40(parameters, phase, flux_error(phase, flux_misalignment)));
}

/* Part of a value around the frequency of the strokes. */
static int32_t band_pass_step(misalignment_band_t *band, int32_t value_q24, int32_t gain_q16) {
    low_pass_step(&band->mean_q24, value_q24, gain_q16);
    low_pass_step(&band->value_q24, fixed_subtract(value_q24, band->mean_q24), gain_q16);
    return band->value_q24;
}

void misalignment_common_step(const misalignment_parameters_t *parameters, misalignment_t *misalignment,
                              unsigned phases, int32_t torque_q24, int32_t stroke_part_q16) {
    /* A quarter of the sum over the phases, which fits. */
    int32_t sum_q24 = 0;
    const unsigned count = phases < HAL_PHASES_MAX ? phases : HAL_PHASES_MAX;
    UNROLL(4)
    for (unsigned i = 0; i < count; i++) {
        sum_q24 += misalignment->phase[i].slope_lag2_q24 / 4;
    }
    const int32_t gain_q16 = fixed_clamp(stroke_part_q16, 0, BAND_GAIN_MAX_Q16 / BAND_FACTOR) * BAND_FACTOR;
    const int32_t quarter_q24 = band_pass_step(&misalignment->common_slope, sum_q24, gain_q16);
    /* Mean of the four samples since the last step: single ones would show quantisation that is far above the band as a
     * slow one. */
    const int32_t mean_q24 = (int32_t)((misalignment->disturbance_sum_q24 - misalignment->last_common_sum_q24) >> 2);
    misalignment->last_common_sum_q24 = misalignment->disturbance_sum_q24;
    const int32_t error_q24 = band_pass_step(&misalignment->common_disturbance, mean_q24, gain_q16);
    const int64_t square_q40 = fixed_product(quarter_q24, quarter_q24) >> 8;
    misalignment->common_power_q40 += (square_q40 - misalignment->common_power_q40) >> COMMON_POWER_SHIFT;
    if (!misalignment->learning) {
        return;
    }
    const int32_t power_q22 = fixed_saturate(misalignment->common_power_q40 >> 18);
    /* T^2 2^-26 of the square of a quarter: 0.00007 T^2 / rad^2. */
    const int32_t torque_q9 = torque_q24 >> 15; /* at most 64 N m: its square is 2^30 */
    const int32_t floor_q22 = fixed_add((torque_q9 * torque_q9 >> 25) + 1, parameters->noise_q22);
    /* y 4 q / (16 q^2), q the quarter. */
    const int32_t step_q10 =
        limited_step_q10(fixed_multiply_shift(error_q24, quarter_q24, 18) / fixed_add(power_q22, floor_q22));
    misalignment->common_sum_q40 += fixed_product(step_q10, parameters->common_rate_q30);
}

void misalignment_end_stroke(misalignment_t *misalignment, bool changed, bool grown) {
    if (changed && grown) {
        for (unsigned i = 0; i < HAL_PHASES_MAX; i++) {
            misalignment_phase_t *phase = &misalignment->phase[i];
            phase->offset_q40 = phase->before_q40 = phase->before_last_q40;
            phase->common_sum_q40 = misalignment->common_sum_q40;
        }
        return;
    }
    for (unsigned i = 0; i < HAL_PHASES_MAX; i++) {
        misalignment_phase_t *phase = &misalignment->phase[i];
        phase->before_last_q40 = phase->before_q40;
        phase->before_q40 = phase->offset_q40;
    }
}

void misalignment_keep(misalignment_t *misalignment) {
    for (unsigned i = 0; i < HAL_PHASES_MAX; i++) {
        misalignment_phase_t *phase = &misalignment->phase[i];
        phase->before_last_q40 = phase->before_q40 = phase->offset_q40;
    }
}
