#include "control/conduction.h"

#include "fixed/compiler.h"
#include "fixed/fixed.h"
#include "fixed/formats.h"

_Static_assert(CONDUCTION_ANGLES + 1 == CONDUCTION_STEPS, "the last step");

/* Torque shortfall that counts as voltage limitation: 0.05 N m and 1/64 of the reference. Less may be rounding. */
#define SHORTFALL_MIN_Q24 ((1u << 24) / 20)

/* 2^-32 electrical rev to Q1.30 in Q12, and a half. */
#define TRIM_SHIFT 15
#define ONE_Q12 (1 << 12)

#define ONE_Q8 (1 << 8)

/* Above base speed windows return within 8 s: each trial of a smaller advance is a torque shortfall. */
#define ABOVE_BASE_SHIFT 3

/* Base speed over the range of speeds above it in which the pulses for parts of the torque take effect, and the reduced
 * gain of the speed law: the speed error that belongs to an acceleration changes with it. */
#define ABOVE_BASE_RANGE 8

/* Least overlap of windows, 2^-32 electrical rev: 2 degrees. */
#define OVERLAP_MIN 0x016C16C1u

/* Overlap of a pulse, 8 degrees. */
#define PULSE_OVERLAP_MIN (4 * OVERLAP_MIN)

/* Rate of the braking limit's slow part, from the advance's, Q1.30 to Q1.15: 5/8 in a second by each fold-back
 * range that the DC link has free, of which LINK_RANGES count; and by which it is faster where the link is full. */
#define LINK_SHIFT 19
#define LINK_RANGES 8
#define LINK_FULL_RATE 32

/* Past any angle: the flux linkage of a motoring phase does not end with its half. */
#define NO_END UINT32_MAX

/* Largest lead of a share of the torque, 2^-32 electrical rev: 20 degrees. */
#define SHARE_LEAD_MAX 0x0E38E38E

conduction_t conduction_initial(const torque_sharing_window_t *window) {
    return (conduction_t){
        .half = {{.window = *window, .width = UINT32_MAX, .end = NO_END},
                 {.window = *window, .width = UINT32_MAX, .end = HALF_REV}},
    };
}

/* --- Tables --- */

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

/* Point of a place that an earlier step has found; one that has changed in memory is within the tables. */
static unsigned point_of(conduction_place_t place) {
    return fixed_min_u32(place.k, MACHINE_PULSE_POINTS - 2);
}

/* Between two values of a table, Q8 of their unit: angles in 2^-24 electrical rev, torques in Q16, flux linkage in Q21.
 */
static int32_t between_q8(int32_t low, int32_t high, int32_t fraction_q8) {
    return low * ONE_Q8 + (high - low) * fraction_q8;
}

static uint32_t angle(uint16_t low, uint16_t high, int32_t fraction_q8) {
    return (uint32_t)between_q8(low, high, fraction_q8) << 8;
}

static int32_t torque_q24(uint16_t low, uint16_t high, int32_t fraction_q8) {
    return fixed_saturate_bits(between_q8(low, high, fraction_q8), 24) * (1 << 8);
}

static void look_up(conduction_state_t *state, conduction_update_t *update, const machine_tables_t *tables,
                    const conduction_sample_t *sample) {
    const conduction_place_t place = place_of(tables, sample);
    const bool braking = (sample->torque_q24 < 0) != (sample->speed_q22 < 0);
    const machine_pulse_t *low = &tables->pulse[braking][place.k], *high = low + 1;
    const machine_pulse_t *other = &tables->pulse[!braking][place.k];
    const int32_t fraction_q8 = place.fraction_q8;
    update->pulse = (conduction_pulse_t){
        .lead = angle(low->lead, high->lead, fraction_q8),
        .end = angle(low->end, high->end, fraction_q8),
        .smooth_q24 = torque_q24(low->smooth_torque, high->smooth_torque, fraction_q8),
        .mean_q24 = torque_q24(low->mean_torque, high->mean_torque, fraction_q8),
        .peak_q24 = torque_q24(low->peak_torque, high->peak_torque, fraction_q8),
    };
    const int32_t other_q24 = torque_q24(other[0].mean_torque, other[1].mean_torque, fraction_q8);
    update->motoring_max_q24 = braking ? other_q24 : update->pulse.mean_q24;
    update->braking_max_q24 = braking ? update->pulse.mean_q24 : other_q24;
    update->place = place;
    if (braking != state->braking) {
        state->trim_q30 = 0;
    }
    state->braking = braking;
}

/* At the level 0 and 1 within 2 LSB of from and to. */
static uint32_t blend(uint32_t from, uint32_t to, int32_t level_q15) {
    return from + 4 * (uint32_t)fixed_multiply_high((int32_t)(to - from), level_q15 << 15);
}

/* Angle between two torques and two speeds of the tables, in 2^-24 electrical rev. */
static int32_t between_windows(int32_t still, int32_t still_above, int32_t base, int32_t base_above, int32_t part_q8,
                               int32_t speed_q8) {
    const int32_t at_rest = between_q8(still, still_above, part_q8);
    return at_rest + (((between_q8(base, base_above, part_q8) - at_rest) * speed_q8) >> 8);
}

/* Windows with the least current for the torque. */
static conduction_sharing_t sharing_for_torque(const machine_tables_t *tables, const conduction_state_t *state,
                                               conduction_place_t place) {
    const int32_t index_q8 = (int32_t)(place.k << 8) + place.fraction_q8;
    const int32_t base_q8 = tables->pulse_base_index;
    const int32_t speed_q8 = index_q8 < base_q8 ? index_q8 * ONE_Q8 / base_q8 : ONE_Q8;
    const int32_t quarters_q8 = (state->torque_q24 >> 16) * (MACHINE_SHARING_PARTS * ONE_Q8) / tables->sharing_torque;
    const int32_t place_q8 = fixed_clamp(quarters_q8 - ONE_Q8, 0, (MACHINE_SHARING_PARTS - 1) * ONE_Q8);
    const int32_t k = place_q8 < (MACHINE_SHARING_PARTS - 1) * ONE_Q8 ? place_q8 >> 8 : MACHINE_SHARING_PARTS - 2;
    const int32_t part_q8 = place_q8 - k * ONE_Q8;
    const machine_sharing_window_t *still = &tables->sharing[conduction_half_of(state)][0][k];
    const machine_sharing_window_t *base = &tables->sharing[conduction_half_of(state)][1][k];
    return (conduction_sharing_t){
        .on = (uint32_t)between_windows(still[0].on, still[1].on, base[0].on, base[1].on, part_q8, speed_q8) << 8,
        .off = (uint32_t)between_windows(still[0].off, still[1].off, base[0].off, base[1].off, part_q8, speed_q8) << 8,
    };
}

/* Pulse for an index of the tables, or above them for the largest mean torque. */
static conduction_partial_pulse_t pulse_at(const machine_tables_t *tables, const conduction_update_t *update,
                                           unsigned half, unsigned index) {
    const conduction_pulse_t *largest = &update->pulse;
    if (index == MACHINE_PULSE_PARTS) {
        return (conduction_partial_pulse_t){-largest->lead, largest->end, largest->peak_q24 - largest->mean_q24};
    }
    const unsigned k = point_of(update->place);
    const machine_partial_pulse_t *low = &tables->partial_pulse[half][index][k], *high = low + 1;
    const int32_t fraction_q8 = update->place.fraction_q8;
    const int32_t ripple_q15 = between_q8(low->ripple, high->ripple, fraction_q8) - MACHINE_RIPPLE_OFFSET * ONE_Q8;
    return (conduction_partial_pulse_t){
        .on = (uint32_t)between_q8(low->on, high->on, fraction_q8) << 16,
        .end = (uint32_t)between_q8(low->end, high->end, fraction_q8) << 16,
        .ripple_q24 = fixed_saturate_bits(fixed_multiply_high(largest->mean_q24, ripple_q15 * ONE_Q15), 30) * 4,
    };
}

/* Below the least part of the tables with its angles, and less ripple. */
static conduction_partial_pulse_t partial_pulse(const machine_tables_t *tables, const conduction_update_t *update,
                                                unsigned half, int32_t part_q15) {
    const unsigned quarter = (unsigned)part_q15 >> 13;
    const unsigned above = quarter < MACHINE_PULSE_PARTS ? quarter : MACHINE_PULSE_PARTS;
    conduction_partial_pulse_t low = pulse_at(tables, update, half, above > 0 ? above - 1 : 0);
    if (above == 0) {
        low.ripple_q24 = 0;
    }
    const conduction_partial_pulse_t high = pulse_at(tables, update, half, above);
    const int32_t fraction_q15 = (part_q15 - (int32_t)(above << 13)) * 4;
    return (conduction_partial_pulse_t){
        .on = blend(low.on, high.on, fraction_q15),
        .end = blend(low.end, high.end, fraction_q15),
        .ripple_q24 = (int32_t)blend((uint32_t)low.ripple_q24, (uint32_t)high.ripple_q24, fraction_q15),
    };
}

/* --- Common to both laws --- */

/* Torque for the feed-forward: above base speed its mean over about a stroke, without the ripple that the pulses cause
 * in the speed. */
static int32_t smoothed_q24(const conduction_state_t *state, uint32_t phases, const conduction_sample_t *sample) {
    const int32_t torque = fixed_abs(sample->torque_q24);
    const uint64_t strokes_q31 = (uint64_t)sample->angle_step * phases >> 1;
    const int32_t part_q31 = strokes_q31 > INT32_MAX ? INT32_MAX : (int32_t)strokes_q31;
    if (state->partial_q15 == 0) { /* as at the start */
        return torque;
    }
    return state->torque_q24 + 2 * fixed_multiply_high(torque - state->torque_q24, part_q31);
}

/* Half of the missing torque, as part of the largest, in an electrical revolution. */
static int32_t trim_step_q30(const conduction_state_t *state, const conduction_update_t *update,
                             const conduction_sample_t *sample) {
    const int32_t sum_q21 = sample->torque_q24 < 0 ? -state->missing_sum_q21 : state->missing_sum_q21;
    const int32_t missing_q20 = sum_q21 / (2 * CONDUCTION_STEPS);
    const int32_t part_q12 = fixed_clamp(missing_q20 / ((update->pulse.mean_q24 >> 16) + 1), -ONE_Q12, ONE_Q12);
    return (int32_t)(sample->angle_step >> TRIM_SHIFT) * part_q12;
}

static bool voltage_limited(const conduction_sample_t *sample) {
    return fixed_magnitude(sample->torque_shortfall_q24) > SHORTFALL_MIN_Q24 + fixed_magnitude(sample->torque_q24) / 64;
}

/* Level of the single pulse by the torque alone. */
static int32_t feed_forward_q15(const conduction_pulse_t *pulse, int32_t torque) {
    const int32_t excess_q8 = (torque - pulse->smooth_q24) >> 16;
    const int32_t range_q8 = (pulse->mean_q24 - pulse->smooth_q24) >> 16;
    if (excess_q8 <= 0) {
        return 0;
    }
    return excess_q8 >= range_q8 ? ONE_Q15 : (excess_q8 << 15) / range_q8;
}

/* Above T_smooth the windows advance: at once from a level of 0; step by step from one that the trim alone has made, so
 * that they do not jump. level_q15 is still the last update's. */
static void advance_for_pulse(const conduction_parameters_t *parameters, conduction_state_t *state,
                              int32_t forward_q15) {
    if (forward_q15 > 0) {
        const int32_t advanced_q30 = state->advance_q30 + parameters->advance_step_q30;
        state->advance_q30 = state->level_q15 == 0 || advanced_q30 > ONE_Q30 ? ONE_Q30 : advanced_q30;
    }
}

/* At a level of 0, torque sharing alone, the windows follow the torque shortfall. */
static void advance_for_shortfall(const conduction_parameters_t *parameters, conduction_state_t *state, bool limited,
                                  int32_t retract_q30) {
    if (state->level_q15 == 0) {
        const int32_t step_q30 = limited ? parameters->advance_step_q30 : -retract_q30;
        state->advance_q30 = fixed_clamp(state->advance_q30 + step_q30, 0, ONE_Q30);
    }
}

/* --- Law below base speed: a level from torque sharing to the single pulse --- */

static void move_level(const conduction_parameters_t *parameters, conduction_state_t *state,
                       const conduction_update_t *update, const conduction_sample_t *sample) {
    const bool limited = voltage_limited(sample);
    const int32_t retract_q30 = limited ? 0 : parameters->retract_step_q30;
    if (parameters->single_pulse) {
        const int32_t forward_q15 = feed_forward_q15(&update->pulse, state->torque_q24);
        const int32_t forward_q30 = forward_q15 * (1 << 15);
        advance_for_pulse(parameters, state, forward_q15);
        if (forward_q15 == ONE_Q15) {
            state->trim_q30 = 0; /* the largest torque is the tables' */
        } else if (state->advance_q30 == ONE_Q30 && (limited || state->level_q15 > 0)) {
            /* Sharing follows the reference at any level that is too high: without a shortfall it returns. */
            state->trim_q30 += trim_step_q30(state, update, sample) - (forward_q15 == 0 ? retract_q30 : 0);
        }
        state->trim_q30 = fixed_clamp(state->trim_q30, -forward_q30, ONE_Q30 - forward_q30);
        state->level_q15 = (forward_q30 + state->trim_q30) >> 15;
        state->part_q15 = state->level_q15;
    }
    advance_for_shortfall(parameters, state, limited, retract_q30);
}

static conduction_interval_t sharing_interval(const conduction_parameters_t *parameters,
                                              const conduction_state_t *state, conduction_sharing_t own) {
    const torque_sharing_parameters_t *sharing = &parameters->sharing;
    if (parameters->own_windows) {
        return (conduction_interval_t){.enter = own.on, .leave = own.off};
    }
    if (state->braking != 0) {
        return (conduction_interval_t){.enter = -sharing->turn_off, .leave = -sharing->turn_on};
    }
    /* Windows advance against the rotation, which would be later for a braking phase. */
    const int32_t advance_q15 = state->advance_q30 >> 15;
    return (conduction_interval_t){
        .enter = sharing->turn_on - HALF_REV - blend(0, sharing->turn_on_advance, advance_q15),
        .leave = sharing->turn_off - HALF_REV - blend(0, sharing->turn_off_advance, advance_q15),
    };
}

/* Positions and ripple between torque sharing's and the single pulse's. */
static inline void blend_single_pulse(const conduction_pulse_t *pulse, int32_t level_q15,
                                      conduction_interval_t *interval, int32_t *ripple_q24) {
    interval->on = blend(interval->enter < HALF_REV ? interval->enter : 0, -pulse->lead, level_q15);
    interval->leave = blend(interval->leave, pulse->end, level_q15);
    *ripple_q24 = (int32_t)blend(0, (uint32_t)(pulse->peak_q24 - pulse->mean_q24), level_q15 * level_q15 >> 15);
}

/* --- Law above base speed: the pulse for a part of the largest torque --- */

static int32_t part_of_largest_q15(const conduction_pulse_t *pulse, int32_t torque) {
    const int32_t torque_q8 = torque >> 16, largest_q8 = pulse->mean_q24 >> 16;
    return torque_q8 >= largest_q8 ? ONE_Q15 : (torque_q8 << 15) / largest_q8;
}

static void move_part(const conduction_parameters_t *parameters, conduction_state_t *state,
                      const conduction_update_t *update, const conduction_sample_t *sample) {
    const bool limited = voltage_limited(sample);
    const int32_t forward_q15 = feed_forward_q15(&update->pulse, state->torque_q24);
    const int32_t forward_q30 = part_of_largest_q15(&update->pulse, state->torque_q24) * (1 << 15);
    advance_for_pulse(parameters, state, forward_q15);
    if (forward_q15 == ONE_Q15) {
        state->trim_q30 = 0; /* the largest torque is the tables' */
    } else if (!limited && !state->single_pulse) {
        state->trim_q30 -= fixed_clamp(state->trim_q30, -parameters->advance_step_q30, parameters->advance_step_q30);
    } else {
        state->trim_q30 += trim_step_q30(state, update, sample) >> 2;
    }
    const int32_t missing_q30 = ONE_Q30 - forward_q30;
    /* At most the part itself: what a lost phase leaves missing goes with the reference. */
    const int32_t trim_max_q30 = missing_q30 > forward_q30 ? forward_q30 : missing_q30;
    state->trim_q30 = fixed_clamp(state->trim_q30, -forward_q30, trim_max_q30);
    state->part_q15 = (forward_q30 + state->trim_q30) >> 15;
    state->level_q15 = fixed_clamp(forward_q15 + (state->trim_q30 >> 15), 0, ONE_Q15);
    advance_for_shortfall(parameters, state, limited, limited ? 0 : parameters->retract_step_q30 >> ABOVE_BASE_SHIFT);
}

/* Positions and ripple between the law's below base speed and the partial pulse's. True if that pulse makes the torque
 * pulsate, or begins before the half. */
static inline bool blend_partial_pulse(const conduction_state_t *state, const conduction_update_t *update,
                                       conduction_interval_t *interval, int32_t *ripple_q24) {
    const int32_t partial_q15 = state->partial_q15;
    const int32_t mean_q24 = update->pulse.mean_q24;
    const conduction_partial_pulse_t *pulse = &update->partial;
    const uint32_t on = pulse->on - update->extension;
    const int32_t trim_q24 = fixed_multiply_high(mean_q24, state->trim_q30) * 4;
    const int32_t trimmed_q24 = fixed_add(pulse->ripple_q24, trim_q24);
    interval->on = blend(state->level_q15 > 0 ? interval->on : interval->enter, on, partial_q15);
    interval->leave = blend(interval->leave, pulse->end, partial_q15);
    interval->enter = interval->on;
    *ripple_q24 = (int32_t)blend((uint32_t)*ripple_q24, (uint32_t)trimmed_q24, partial_q15);
    return state->torque_q24 > update->pulse.smooth_q24 || (int32_t)on < 0 ||
           fixed_abs(pulse->ripple_q24) > mean_q24 >> 6;
}

/* From 0 at the base speed to 1, Q1.15, at 1 / ABOVE_BASE_RANGE of it above. */
static int32_t above_base_q15(const machine_tables_t *tables, conduction_place_t place) {
    const int32_t base_q8 = tables->pulse_base_index;
    const int32_t excess_q8 = ABOVE_BASE_RANGE * ((int32_t)(place.k << 8) + place.fraction_q8 - base_q8);
    return excess_q8 >= base_q8 ? ONE_Q15 : (fixed_clamp(excess_q8, 0, base_q8) << 15) / base_q8;
}

/* By which the gain of the speed law exceeds a quarter of the stroke rate, as part of it, Q0.31. */
static int32_t gain_excess_q31(const conduction_parameters_t *parameters, const conduction_sample_t *sample,
                               int32_t above_base_q15) {
    const uint64_t kept_q16 = ((uint64_t)sample->angle_step * parameters->gain_per_step_q16) >> 32;
    return above_base_q15 * (UINT16_MAX - (int32_t)(kept_q16 < UINT16_MAX ? kept_q16 : UINT16_MAX));
}

/* By which a braking pulse begins earlier, whose energy the DC link would not take, 2^-32 electrical rev: a part of the
 * way from the pulse to one without a torque. */
static uint32_t extension(const conduction_parameters_t *parameters, const conduction_state_t *state,
                          const conduction_pulse_t *pulse) {
    const int32_t taken_q15 = ONE_Q15 - ((state->room_q15 * state->room_q15) >> 15);
    const int32_t extension_q15 = parameters->longer_pulses > 0 ? taken_q15 * state->part_q15 >> 15 : 0;
    const bool possible = state->braking && pulse->end > pulse->lead;
    return possible ? blend(0, pulse->end - pulse->lead, extension_q15) : 0;
}

/* --- Limits and angles, of both laws --- */

/* Braking torque for which the DC link has room, part of the largest, Q1.15. The voltage follows the torque later, by
 * the fields of the phases: the part alone by which it is too high would let both oscillate. */
static int32_t room_q15(const conduction_parameters_t *parameters, conduction_state_t *state, int32_t voltage_q6) {
    const int32_t range_q6 = parameters->fold_back_range_q6;
    const int32_t room_q6 = fixed_clamp(parameters->braking_end_q6 - voltage_q6, 0, LINK_RANGES * range_q6);
    const int32_t free_q15 = (room_q6 - range_q6) * ONE_Q15 / range_q6;
    const int32_t part_q15 = free_q15 < 0 ? LINK_FULL_RATE * free_q15 : free_q15;
    state->link_q30 =
        fixed_clamp(state->link_q30 + (parameters->advance_step_q30 >> LINK_SHIFT) * part_q15, 0, ONE_Q30);
    return ((free_q15 < 0 ? free_q15 + ONE_Q15 : ONE_Q15) * (state->link_q30 >> 15)) >> 15;
}

/* Limits by what the voltage can make and by the braking torque whose energy the DC link can take. */
static void limit_torque(const conduction_parameters_t *parameters, conduction_state_t *state,
                         const conduction_update_t *update, const conduction_sample_t *sample) {
    const int32_t room = room_q15(parameters, state, sample->dc_link_voltage_q6);
    const int32_t more = (state->partial_q15 >> 2) * room >> 13;
    const int32_t kept_q15 = room + parameters->longer_pulses * more;
    const int32_t part_q15 = kept_q15 < ONE_Q15 && !conduction_at_rest(sample->speed_q22) ? kept_q15 : ONE_Q15;
    state->room_q15 = (uint16_t)room;
    const int32_t braking_q24 = 4 * fixed_multiply_high(update->braking_max_q24, part_q15 << 15);
    const bool reverse = sample->speed_q22 < 0;
    const int32_t min_q24 = reverse ? -update->motoring_max_q24 : -braking_q24;
    const int32_t max_q24 = reverse ? braking_q24 : update->motoring_max_q24;
    state->torque_min_q24 = parameters->torque_min_q24 > min_q24 ? parameters->torque_min_q24 : min_q24;
    state->torque_max_q24 = parameters->torque_max_q24 < max_q24 ? parameters->torque_max_q24 : max_q24;
}

/* The window of a pulse begins at most SHARE_LEAD_MAX before the half, and less than half a revolution before its end:
 * beyond, a phase would make up for no shortfall. */
static void set_enter(conduction_interval_t *interval) {
    const int32_t earliest = (int32_t)(interval->leave - HALF_REV + 1);
    const int32_t latest = (int32_t)interval->enter > -SHARE_LEAD_MAX ? (int32_t)interval->enter : -SHARE_LEAD_MAX;
    const int32_t enter = fixed_clamp((int32_t)interval->on, -SHARE_LEAD_MAX, latest);
    interval->enter = (uint32_t)(enter > earliest ? enter : earliest);
}

static void set_interval(const conduction_parameters_t *parameters, conduction_state_t *state,
                         conduction_update_t *update, const machine_tables_t *tables) {
    const int32_t level_q15 = state->level_q15, partial_q15 = state->partial_q15;
    conduction_interval_t interval =
        sharing_interval(parameters, state, sharing_for_torque(tables, state, update->place));
    int32_t ripple_q24 = 0;
    bool single_pulse = level_q15 > 0;
    interval.on = 0;
    if (level_q15 > 0) {
        blend_single_pulse(&update->pulse, level_q15, &interval, &ripple_q24);
    }
    if (partial_q15 > 0) {
        single_pulse = blend_partial_pulse(state, update, &interval, &ripple_q24);
    }
    if (level_q15 > 0 || partial_q15 > 0) {
        set_enter(&interval);
    }
    update->interval = interval;
    update->ripple_q24 = ripple_q24;
    state->single_pulse = single_pulse;
}

/* The share of a motoring pulse that is narrower than a stroke falls over some control periods: turn-off would be at
 * one of them, and the torque of the strokes would differ. */
static void set_window(const conduction_parameters_t *parameters, conduction_interval_t interval, bool braking,
                       bool partial, torque_sharing_window_t *window) {
    uint32_t stroke = parameters->sharing.stroke, overlap = OVERLAP_MIN;
    const uint32_t width = interval.leave - interval.enter;
    if (width > stroke + OVERLAP_MIN) {
        overlap = width - stroke;
    }
    const uint32_t least = braking ? OVERLAP_MIN : PULSE_OVERLAP_MIN;
    if (partial && overlap <= least) {
        overlap = least;
        stroke = width > least ? width - least / 2 : least / 2;
        interval.leave += least / 2;
    }
    window->stroke = stroke;
    window->overlap = parameters->sharing.overlapping ? overlap : 0;
    window->reciprocal = UINT32_MAX / (overlap >> 15);
    window->turn_on = braking ? -interval.leave : HALF_REV + interval.leave - stroke - overlap;
}

/* Flux linkage that a braking phase may keep. */
static void set_envelope(const machine_tables_t *tables, conduction_place_t place, conduction_half_t *braking) {
    const unsigned k = point_of(place);
    const uint16_t *end = &tables->braking_end[k], *flux = &tables->braking_flux[k];
    const int32_t fraction_q8 = place.fraction_q8;
    const uint32_t flux_q29 = (uint32_t)between_q8(flux[0], flux[1], fraction_q8) << 8;
    braking->end = -angle(end[0], end[1], fraction_q8);
    braking->flux = (int32_t)(flux_q29 >> tables->flux_format.result_shift);
}

static void set_angles(const conduction_parameters_t *parameters, conduction_state_t *state,
                       const conduction_update_t *update, const machine_tables_t *tables, bool negative) {
    const int32_t level_q15 = state->level_q15;
    const unsigned next = state->latest == 0 ? 1 : 0;
    conduction_t *angles = &state->angles[next];
    conduction_half_t *half = &angles->half[conduction_half_of(state)];
    conduction_half_t *before = &angles->half[conduction_half_of(state) ^ 1u];
    const uint32_t on = update->interval.on;
    angles->ripple_q24 = negative ? fixed_subtract(0, update->ripple_q24) : update->ripple_q24;
    before->window = parameters->initial.half[0].window;
    before->width = half->width = UINT32_MAX;
    before->lead = on >= HALF_REV ? -on : 0;
    angles->half[CONDUCTION_MOTORING].end = NO_END;
    angles->half[CONDUCTION_BRAKING].end = HALF_REV;
    before->flux = half->flux = 0;
    half->lead = 0;
    set_window(parameters, update->interval, state->braking != 0, state->partial_q15 > 0, &half->window);
    if (state->braking && (level_q15 > 0 || state->partial_q15 > 0)) {
        set_envelope(tables, update->place, half);
    }
    if (state->partial_q15 > 0 || (level_q15 > 0 && !state->braking)) {
        half->width = half->window.stroke + half->window.overlap;
    }
    state->latest = next;
}

void conduction_step(const conduction_parameters_t *parameters, conduction_state_t *state, conduction_update_t *update,
                     const machine_tables_t *tables, const conduction_sample_t *sample) {
    const unsigned step = update->step;
    update->step = step + 1 < CONDUCTION_STEPS ? step + 1 : 0;
    state->missing_sum_q21 += fixed_subtract(sample->torque_q24, sample->torque_sum_q24) >> 3;
    switch (step) {
    case CONDUCTION_LOOK_UP:
        look_up(state, update, tables, sample);
        state->torque_q24 = smoothed_q24(state, tables->phases, sample);
        break;
    case CONDUCTION_MOVE:
        update->extension = extension(parameters, state, &update->pulse); /* by the part of the last update */
        if (state->partial_q15 > 0) {
            move_part(parameters, state, update, sample);
        } else {
            move_level(parameters, state, update, sample);
        }
        state->missing_sum_q21 = 0;
        state->gain_excess_q31 = gain_excess_q31(parameters, sample, state->above_base_q15);
        break;
    case CONDUCTION_CHOOSE_LAW:
        state->above_base_q15 = above_base_q15(tables, update->place);
        state->partial_q15 = parameters->single_pulse ? state->above_base_q15 : 0;
        if (state->partial_q15 > 0) {
            update->partial = partial_pulse(tables, update, conduction_half_of(state), state->part_q15);
        }
        break;
    case CONDUCTION_POSITIONS:
        limit_torque(parameters, state, update, sample);
        set_interval(parameters, state, update, tables);
        break;
    default: /* CONDUCTION_ANGLES */
        set_angles(parameters, state, update, tables, sample->torque_q24 < 0);
        break;
    }
}
