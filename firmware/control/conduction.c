#include "control/conduction.h"

#include "fixed/fixed.h"
#include "fixed/formats.h"

/* Torque shortfall that counts as voltage limitation: 0.05 N m and 1/64 of the reference. Less may be rounding. */
#define SHORTFALL_MIN_Q24 ((1u << 24) / 20)

/* 2^-32 electrical rev to Q1.30 in Q8, and a half. */
#define TRIM_SHIFT 11

#define ONE_Q8 (1 << 8)

/* Above base speed windows return within 8 s: each trial of a smaller advance is a torque shortfall. */
#define ABOVE_BASE_SHIFT 3

/* Base speed over the range of speeds above it in which the window with the least current takes effect, and the reduced
 * gain of the speed law: the speed error that belongs to an acceleration changes with it. */
#define LEAST_CURRENT_RANGE 8
#define SLOWER_RANGE 2

/* Least overlap of windows, 2^-32 electrical rev: 2 degrees. */
#define OVERLAP_MIN 0x016C16C1u

/* Past any angle: the flux linkage of a motoring phase does not end with its half. */
#define NO_END UINT32_MAX

/* Largest lead of a share of the torque, 2^-32 electrical rev: 20 degrees. */
#define SHARE_LEAD_MAX 0x0E38E38E

conduction_t conduction_initial(const torque_sharing_window_t *window) {
    return (conduction_t){
        .half = {{.window = *window, .width = HALF_REV, .end = NO_END},
                 {.window = *window, .width = HALF_REV, .end = HALF_REV}},
    };
}

static conduction_place_t place_of(const machine_tables_t *tables, const conduction_sample_t *sample) {
    const uint32_t scaled =
        (uint32_t)(((uint64_t)(uint32_t)fixed_abs(sample->speed_q22) * tables->pulse_index_scale) >> 32);
    const uint32_t voltage_q6 = sample->dc_link_voltage_q6 > 0 ? (uint32_t)sample->dc_link_voltage_q6 : 1u;
    const uint32_t index_q8 = scaled / voltage_q6;
    if (index_q8 >= (MACHINE_PULSE_POINTS - 1) << 8) {
        return (conduction_place_t){MACHINE_PULSE_POINTS - 2, ONE_Q8};
    }
    return (conduction_place_t){index_q8 >> 8, (int32_t)(index_q8 & 0xFF)};
}

/* Between two values of a table, Q8 of their unit: angles in 2^-24 electrical rev, torques in Q16, flux linkage in Q21.
 */
static int32_t between_q8(uint16_t low, uint16_t high, int32_t fraction_q8) {
    return low * (1 << 8) + (high - low) * fraction_q8;
}

static uint32_t angle(uint16_t low, uint16_t high, int32_t fraction_q8) {
    return (uint32_t)between_q8(low, high, fraction_q8) << 8;
}

static int32_t torque_q24(uint16_t low, uint16_t high, int32_t fraction_q8) {
    return fixed_saturate_bits(between_q8(low, high, fraction_q8), 24) * (1 << 8);
}

static void look_up(conduction_state_t *state, const machine_tables_t *tables, const conduction_sample_t *sample) {
    const conduction_place_t place = place_of(tables, sample);
    const bool braking = (sample->torque_q24 < 0) != (sample->speed_q22 < 0);
    const machine_pulse_t *low = &tables->pulse[braking][place.k], *high = low + 1;
    const machine_pulse_t *other = &tables->pulse[!braking][place.k];
    const int32_t fraction_q8 = place.fraction_q8;
    state->pulse = (conduction_pulse_t){
        .lead = angle(low->lead, high->lead, fraction_q8),
        .end = angle(low->end, high->end, fraction_q8),
        .smooth_q24 = torque_q24(low->smooth_torque, high->smooth_torque, fraction_q8),
        .mean_q24 = torque_q24(low->mean_torque, high->mean_torque, fraction_q8),
        .peak_q24 = torque_q24(low->peak_torque, high->peak_torque, fraction_q8),
    };
    const int32_t other_q24 = torque_q24(other[0].mean_torque, other[1].mean_torque, fraction_q8);
    state->motoring_max_q24 = braking ? other_q24 : state->pulse.mean_q24;
    state->braking_max_q24 = braking ? state->pulse.mean_q24 : other_q24;
    if (braking != state->braking) {
        state->trim_q30 = 0;
    }
    state->braking = braking;
    state->place = place;
}

static int32_t feed_forward_q15(const conduction_pulse_t *pulse, int32_t torque) {
    const int32_t excess_q8 = (torque - pulse->smooth_q24) >> 16;
    const int32_t range_q8 = (pulse->mean_q24 - pulse->smooth_q24) >> 16;
    if (excess_q8 <= 0) {
        return 0;
    }
    return excess_q8 >= range_q8 ? ONE_Q15 : (excess_q8 << 15) / range_q8;
}

/* From 0 at the base speed to 1, Q1.15, at 1 / range of it above. */
static int32_t above_base_q15(const machine_tables_t *tables, conduction_place_t place, int32_t range) {
    const int32_t base_q8 = tables->pulse_base_index;
    const int32_t excess_q8 = range * ((int32_t)(place.k << 8) + place.fraction_q8 - base_q8);
    return excess_q8 >= base_q8 ? ONE_Q15 : (fixed_clamp(excess_q8, 0, base_q8) << 15) / base_q8;
}

/* By which the gain of the speed law exceeds a quarter of the stroke rate, as part of it, Q0.31. */
static int32_t gain_excess_q31(const conduction_parameters_t *parameters, const conduction_sample_t *sample,
                               int32_t above_base_q15) {
    const uint64_t kept_q16 = ((uint64_t)sample->angle_step * parameters->gain_per_step_q16) >> 32;
    return above_base_q15 * (UINT16_MAX - (int32_t)(kept_q16 < UINT16_MAX ? kept_q16 : UINT16_MAX));
}

/* Torque for the feed-forward: above base speed its mean over about a stroke, without the ripple that the pulses cause
 * in the speed. */
static int32_t smoothed_q24(const conduction_state_t *state, uint32_t phases, const conduction_sample_t *sample) {
    const int32_t torque = fixed_abs(sample->torque_q24);
    const uint64_t strokes_q31 = (uint64_t)sample->angle_step * phases >> 1;
    const int32_t part_q31 = strokes_q31 > INT32_MAX ? INT32_MAX : (int32_t)strokes_q31;
    if (state->sharing_q15 == 0 || state->latest == CONDUCTION_INITIAL) {
        return torque;
    }
    return state->torque_q24 + 2 * fixed_multiply_high(torque - state->torque_q24, part_q31);
}

/* Half of the missing torque, as part of the largest, in an electrical revolution. */
static int32_t trim_step_q30(const conduction_pulse_t *pulse, const conduction_sample_t *sample) {
    const int32_t error_q24 = fixed_subtract(sample->torque_q24, sample->torque_sum_q24);
    const int32_t missing_q24 = sample->torque_q24 < 0 ? fixed_subtract(0, error_q24) : error_q24;
    const int32_t part_q8 = fixed_clamp((missing_q24 >> 8) / ((pulse->mean_q24 >> 16) + 1), -ONE_Q8, ONE_Q8);
    return (int32_t)(sample->angle_step >> TRIM_SHIFT) * part_q8;
}

/* Advance of the windows and level of the single pulse. */
static void move(const conduction_parameters_t *parameters, conduction_state_t *state, const machine_tables_t *tables,
                 const conduction_sample_t *sample) {
    const bool voltage_limited =
        fixed_magnitude(sample->torque_shortfall_q24) > SHORTFALL_MIN_Q24 + fixed_magnitude(sample->torque_q24) / 64;
    int32_t retract_q30 = voltage_limited ? 0 : parameters->retract_step_q30;
    if (parameters->single_pulse) {
        state->sharing_q15 = above_base_q15(tables, state->place, LEAST_CURRENT_RANGE);
        retract_q30 >>= state->sharing_q15 > 0 ? ABOVE_BASE_SHIFT : 0;
        state->torque_q24 = smoothed_q24(state, tables->phases, sample);
        const int32_t forward_q15 = feed_forward_q15(&state->pulse, state->torque_q24);
        const int32_t forward_q30 = forward_q15 * (1 << 15);
        if (forward_q15 > 0) {
            /* With the level that is still the one before: from the trim alone, windows do not jump. */
            const int32_t advanced_q30 = state->advance_q30 + parameters->advance_step_q30;
            state->advance_q30 = state->level_q15 == 0 || advanced_q30 > ONE_Q30 ? ONE_Q30 : advanced_q30;
        }
        if (forward_q15 == ONE_Q15) {
            state->trim_q30 = 0; /* the largest torque is that of the tables */
        } else if ((state->advance_q30 == ONE_Q30 || state->sharing_q15 > 0) &&
                   (voltage_limited || state->level_q15 > 0)) {
            /* Sharing follows the reference at any level that is too high: without a shortfall it returns. */
            state->trim_q30 += trim_step_q30(&state->pulse, sample) - (forward_q15 == 0 ? retract_q30 : 0);
        }
        state->trim_q30 = fixed_clamp(state->trim_q30, -forward_q30, ONE_Q30 - forward_q30);
        state->level_q15 = forward_q15 + (state->trim_q30 >> 15);
    }
    if (state->level_q15 == 0) {
        const int32_t step_q30 = voltage_limited ? parameters->advance_step_q30 : -retract_q30;
        state->advance_q30 = fixed_clamp(state->advance_q30 + step_q30, 0, ONE_Q30);
    }
}

static uint32_t blend(uint32_t from, uint32_t to, int32_t level_q15) {
    const int32_t way = (int32_t)(to - from);
    return from + (uint32_t)(((int64_t)way * level_q15) >> 15);
}

static conduction_interval_t sharing_interval(const conduction_parameters_t *parameters,
                                              const conduction_state_t *state) {
    const torque_sharing_parameters_t *sharing = &parameters->sharing;
    if (state->braking) {
        return (conduction_interval_t){.enter = -sharing->turn_off, .leave = -sharing->turn_on};
    }
    /* Windows advance against the rotation, which would be later for a braking phase. */
    const int32_t advance_q15 = state->advance_q30 >> 15;
    return (conduction_interval_t){
        .enter = sharing->turn_on - HALF_REV - blend(0, sharing->turn_on_advance, advance_q15),
        .leave = sharing->turn_off - HALF_REV - blend(0, sharing->turn_off_advance, advance_q15),
    };
}

/* With a part of the window with the least current; the advance of a motoring phase takes it back. */
static conduction_interval_t towards_least_current(const machine_tables_t *tables, const conduction_state_t *state,
                                                   conduction_interval_t interval) {
    const uint32_t on = (uint32_t)tables->sharing_on << 16, off = (uint32_t)tables->sharing_off << 16;
    const int32_t kept_q15 = state->braking ? ONE_Q15 : ONE_Q15 - (state->advance_q30 >> 15);
    const int32_t part_q15 = (state->sharing_q15 * kept_q15) >> 15;
    return (conduction_interval_t){
        .enter = blend(interval.enter, state->braking ? HALF_REV - off : on, part_q15),
        .leave = blend(interval.leave, state->braking ? HALF_REV - on : off, part_q15),
    };
}

static void set_window(const conduction_parameters_t *parameters, conduction_interval_t interval, bool braking,
                       torque_sharing_window_t *window) {
    const uint32_t stroke = parameters->sharing.stroke;
    const uint32_t width = interval.leave - interval.enter;
    const uint32_t overlap = width > stroke + OVERLAP_MIN ? width - stroke : OVERLAP_MIN;
    window->stroke = stroke;
    window->overlap = parameters->sharing.overlapping ? overlap : 0;
    window->reciprocal = UINT32_MAX / (overlap >> 15);
    window->turn_on = braking ? -interval.leave : HALF_REV + interval.leave - stroke - overlap;
}

/* What a braking phase may leave of its flux linkage. */
static void set_envelope(const machine_tables_t *tables, const conduction_state_t *state, conduction_half_t *braking) {
    const uint16_t *end = &tables->braking_end[state->place.k], *flux = &tables->braking_flux[state->place.k];
    const int32_t fraction_q8 = state->place.fraction_q8;
    const uint32_t flux_q29 = (uint32_t)between_q8(flux[0], flux[1], fraction_q8) << 8;
    braking->end = -angle(end[0], end[1], fraction_q8);
    braking->flux = (int32_t)(flux_q29 >> tables->flux_format.result_shift);
}

/* Limits by what the voltage can make and by the braking torque whose energy the DC link can take. */
static void limit_torque(const conduction_parameters_t *parameters, conduction_state_t *state,
                         const conduction_sample_t *sample) {
    const int32_t range_q6 = parameters->fold_back_range_q6;
    const int32_t room_q6 = fixed_clamp(parameters->braking_end_q6 - sample->dc_link_voltage_q6, 0, range_q6);
    const int32_t braking_q24 = 4 * fixed_multiply_high(state->braking_max_q24, (room_q6 << 15) / range_q6 << 15);
    const bool reverse = sample->speed_q22 < 0;
    const int32_t negative_q24 = reverse ? state->motoring_max_q24 : braking_q24;
    const int32_t positive_q24 = reverse ? braking_q24 : state->motoring_max_q24;
    state->torque_min_q24 = fixed_clamp(parameters->torque_min_q24, -negative_q24, 0);
    state->torque_max_q24 = fixed_clamp(parameters->torque_max_q24, 0, positive_q24);
}

/* Positions between those of torque sharing and of the single pulse. */
static void set_interval(const conduction_parameters_t *parameters, conduction_state_t *state,
                         const machine_tables_t *tables) {
    conduction_interval_t interval = towards_least_current(tables, state, sharing_interval(parameters, state));
    const int32_t level_q15 = state->level_q15;
    interval.on = 0;
    if (level_q15 > 0) {
        interval.on = blend(interval.enter < HALF_REV ? interval.enter : 0, -state->pulse.lead, level_q15);
        interval.leave = blend(interval.leave, state->pulse.end, level_q15);
        /* Less than half a revolution before the end: beyond, a phase would make up for no shortfall. */
        const int32_t earliest = (int32_t)(interval.leave - HALF_REV + 1);
        const int32_t enter = fixed_clamp((int32_t)interval.on, -SHARE_LEAD_MAX, (int32_t)interval.enter);
        interval.enter = (uint32_t)(enter > earliest ? enter : earliest);
    }
    state->interval = interval;
}

static void set_angles(const conduction_parameters_t *parameters, conduction_state_t *state,
                       const machine_tables_t *tables, bool negative) {
    const int32_t level_q15 = state->level_q15;
    const unsigned next = state->latest == 0 ? 1 : 0;
    conduction_t *angles = &state->angles[next];
    conduction_half_t *half = &angles->half[state->braking];
    conduction_half_t *before = &angles->half[!state->braking];
    const int32_t ripple_q24 = (int32_t)blend(0, (uint32_t)(state->pulse.peak_q24 - state->pulse.mean_q24), level_q15);
    const uint32_t on = state->interval.on;
    angles->ripple_q24 = negative ? -ripple_q24 : ripple_q24;
    before->window = parameters->initial.half[0].window;
    before->width = half->width = HALF_REV;
    before->lead = on >= HALF_REV ? -on : 0;
    angles->half[CONDUCTION_MOTORING].end = NO_END;
    angles->half[CONDUCTION_BRAKING].end = HALF_REV;
    before->flux = half->flux = 0;
    half->lead = 0;
    set_window(parameters, state->interval, state->braking, &half->window);
    if (level_q15 > 0 && state->braking) {
        set_envelope(tables, state, half);
    } else if (level_q15 > 0) {
        half->width = half->window.stroke + half->window.overlap;
    }
    state->latest = next;
}

void conduction_step(const conduction_parameters_t *parameters, conduction_state_t *state,
                     const machine_tables_t *tables, const conduction_sample_t *sample) {
    const unsigned step = state->step;
    state->step = (step + 1) % CONDUCTION_STEPS;
    switch (step) {
    case 0:
        look_up(state, tables, sample);
        break;
    case 1:
        move(parameters, state, tables, sample);
        break;
    case 2:
        limit_torque(parameters, state, sample);
        state->gain_excess_q31 =
            gain_excess_q31(parameters, sample, above_base_q15(tables, state->place, SLOWER_RANGE));
        set_interval(parameters, state, tables);
        break;
    default:
        set_angles(parameters, state, tables, sample->torque_q24 < 0);
        break;
    }
}
