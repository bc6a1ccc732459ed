#include "monitors/phase_evidence.h"

#include "control/applied_flux.h"
#include "control/phase_map.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"
#include "fixed/formats.h"

/* 10 degrees electrical: 2.5 degrees of a rotor with four poles. */
#define ANGLE_TOLERANCE (UINT32_MAX / 36u)

/* Rotation after which a difference that an angle may explain is one: 1/32 electrical rev. */
#define TURN_MIN (1 << 27)

/* Time for which a phase has to differ alone at high speed: a slipping encoder shows in the others soon. */
#define DOUBT_MS 20u

/* Rotation since the phase last differed: of less it differs now; after more it differs no longer. Electrical rev,
 * Q7.24: 1/2 and 3/2. */
#define AGAIN_Q24 (1 << 23)
#define GONE_Q24 (3 << 23)

#define OPEN_SAMPLES 2u

/* A current that should not be is judged after 1/4 ms. One that does not move is its sensor's error after this time; at
 * once when not even the last bit changes, and when it ends after 1/2 ms. */
#define STILL_MS 8u

/* Time for which a current that has ended too soon may explain one that is read in another phase. */
#define VANISHED_MS 2u

/* Side and extent of a difference between voltage and current. */
typedef enum {
    AGREES,
    DOUBTFUL,      /* agrees within the tolerances, with hardly a current */
    WITHIN_ANGLES, /* differs at the measured angle */
    BEYOND_ANGLES  /* differs at any */
} difference_t;

/* Flux linkage of the tables with the tolerances of current and flux linkage. [SR-30] */
static flux_band_t tolerated(const flux_residual_t *residual, uint32_t distance, uint32_t width, int32_t current_q9,
                             int32_t more_q9) {
    const flux_band_t band = flux_residual_band(distance, width, (current_q9 - residual->offset_q9) * 10 / 11,
                                                current_q9 + current_q9 / 10 + more_q9);
    return (flux_band_t){
        .least_q29 = band.least_q29 - band.least_q29 / 20 * 3,
        .most_q29 = fixed_add(band.most_q29, band.most_q29 / 20 * 3),
    };
}

/* Error of the voltage in a period, Wb, Q2.29. */
static int32_t error_q29(const flux_residual_t *residual) {
    return fixed_max(residual->pulse_q29, residual->device_q29);
}

/* Least flux linkage by what the voltage has built up since the current was last more than a small one. */
static int32_t built_up_q29(const flux_residual_t *residual, phase_evidence_phase_t *state,
                            const flux_residual_phase_t *phase) {
    const int32_t built_q29 = fixed_subtract(phase->flux_q29, fixed_add(state->base_q29, residual->delay_q29));
    state->base_q29 =
        fixed_saturate(state->base_q29 + 2 * (int64_t)error_q29(residual) * (int32_t)(residual->elapsed & 0xffffu) +
                       applied_flux_warm_q29(&machine_tables, phase->step_drop_q29));
    return built_q29;
}

/* The flux linkage by the tables is between the limits of both sides, so that most comparisons end with it.
 * [SR-25] [SR-27] [SR-30] */
static difference_t compare(const flux_residual_t *residual, phase_evidence_phase_t *state, unsigned index, int *side) {
    const flux_residual_phase_t *phase = &residual->phase[index];
    const int32_t table_q29 = phase->table_q29;
    if (!phase->small || phase->flux_q29 < state->base_q29 ||
        residual->elapsed > residual->sample.periods_per_ms / 2u) {
        state->base_q29 = phase->flux_q29;
    }
    /* With a small current errors of the past do not count. */
    const int32_t high_q29 =
        phase->small ? built_up_q29(residual, state, phase) : flux_residual_least_q29(residual, index);
    const int32_t low_q29 = flux_residual_most_q29(residual, index);
    *side = 0;
    if (high_q29 <= table_q29 && low_q29 >= table_q29) {
        return AGREES;
    }
    const uint32_t distance = phase_map_distance(phase->angle);
    const flux_band_t here = tolerated(residual, distance, ANGLE_TOLERANCE, phase->current_q9, residual->offset_q9);
    if (high_q29 > here.most_q29) {
        *side = 1;
        /* Flux linkage that tables of a wrong angle have added shows no more than an angle. */
        const int32_t by_voltage_q29 = fixed_subtract(high_q29, fixed_non_negative(phase->followed_q29));
        const flux_band_t anywhere = tolerated(residual, 0, HALF_REV, phase->current_q9, 0);
        return by_voltage_q29 > anywhere.most_q29 ? BEYOND_ANGLES : WITHIN_ANGLES;
    }
    if (low_q29 < here.least_q29) {
        *side = -1;
        const flux_band_t anywhere = tolerated(residual, 0, HALF_REV, phase->current_q9, 0);
        return low_q29 < anywhere.least_q29 ? BEYOND_ANGLES : WITHIN_ANGLES;
    }
    return phase->small && high_q29 > table_q29 ? DOUBTFUL : AGREES;
}

/* True when the opposite voltage has removed a quarter of the flux linkage since the switches opened, and the tables
 * saw less than a quarter of that part disappear. Parts, because at a wrong angle the tables err by a factor; of a flux
 * linkage from which that may have taken away something. [SR-27] */
static bool does_not_fall(const flux_residual_t *residual, phase_evidence_phase_t *state,
                          const flux_residual_phase_t *phase) {
    const int32_t flux_q29 = phase->flux_q29;
    if (!phase->off || !state->was_off || residual->lost) {
        state->off_flux_q29 = flux_q29;
        state->off_all_q29 = fixed_add(fixed_add(flux_q29, fixed_clamp(-phase->followed_q29, 0, INT32_MAX)),
                                       applied_flux_cold_q29(phase->drop_q29));
        state->off_table_q29 = phase->table_q29;
    }
    state->was_off = phase->off;
    const int32_t removed_q29 = fixed_subtract(fixed_subtract(state->off_flux_q29, flux_q29), 2 * residual->delay_q29);
    const int32_t fallen_q29 = fixed_subtract(state->off_table_q29, phase->table_q29);
    return !phase->small && removed_q29 > state->off_all_q29 / 4 &&
           fixed_product(fallen_q29, state->off_all_q29) < fixed_product(removed_q29, state->off_table_q29) / 4;
}

/* True when the integral has gone only because the tables have taken most of it away, more than a warm winding and the
 * drops of the devices explain, a seventh of the error of the voltage, twice that after a small current: by voltage and
 * time alone the current may flow, and it is the angle of the tables that is wrong. [SR-27] */
static bool taken_away(const flux_residual_t *residual, const flux_residual_phase_t *phase) {
    const uint32_t age = residual->sample.periods - phase->zero_at;
    const bool was_small = phase->conducting > FLUX_RESIDUAL_FOLLOW_MS * residual->sample.periods_per_ms;
    const int64_t drops_q29 = (int64_t)(error_q29(residual) / 7 * (was_small ? 2 : 1)) * age;
    const int32_t warm_q29 = applied_flux_warm_q29(&machine_tables, phase->drop_q29);
    return -(int64_t)phase->followed_q29 > phase->peak_q29 / 2 + drops_q29 + warm_q29;
}

/* A current that should not be: does it move? [SR-26] [SR-27] */
static void check_excess(const flux_residual_t *residual, phase_evidence_phase_t *state, unsigned index, bool excess,
                         flux_evidence_t *evidence) {
    const flux_residual_phase_t *phase = &residual->phase[index];
    const int32_t current_q9 = phase->current_q9;
    if (!excess) {
        const bool lasted = state->excess_periods >= residual->sample.periods_per_ms / 2u;
        evidence->excess_still |= (uint32_t)lasted << index;
        state->excess_periods = 0;
        return;
    }
    if (state->excess_periods == 0) {
        state->least_q9 = state->most_q9 = current_q9;
    }
    evidence->excess |= 1u << index;
    state->least_q9 = current_q9 < state->least_q9 ? current_q9 : state->least_q9;
    state->most_q9 = current_q9 > state->most_q9 ? current_q9 : state->most_q9;
    state->excess_periods += state->excess_periods == 0 ? 1 : residual->elapsed;
    const int32_t moved_q9 = state->most_q9 - state->least_q9;
    if (state->excess_periods <= residual->sample.periods_per_ms / 4u) {
        return;
    }
    if (moved_q9 > residual->offset_q9) {
        const bool by_tables = taken_away(residual, phase);
        evidence->excess_by_tables |= (uint32_t)by_tables << index;
        evidence->excess_moves |= (uint32_t)!by_tables << index;
        return;
    }
    const bool still = moved_q9 == 0 || state->excess_periods > STILL_MS * residual->sample.periods_per_ms;
    evidence->excess_still |= (uint32_t)still << index;
}

/* There is no current while there is voltage, or it has ended within the last milliseconds before the voltage had
 * removed it. [SR-25] */
static bool is_missing(const flux_residual_t *residual, phase_evidence_phase_t *state, unsigned index) {
    const flux_residual_phase_t *phase = &residual->phase[index];
    if (phase->none && phase->flux_q29 > fixed_add(phase->peak_q29 / 8, 2 * residual->delay_q29)) {
        state->vanished = true;
        state->vanished_at = residual->sample.periods;
    }
    /* Forgotten before the number of the period comes round. */
    state->vanished = state->vanished &&
                      residual->sample.periods - state->vanished_at < VANISHED_MS * residual->sample.periods_per_ms;
    const bool none =
        !phase->off && phase->current_q9 <= residual->offset_q9 && phase->flux_q29 > residual->delay_q29 / 2;
    return state->vanished || none;
}

/* A difference on one side over TURN_MIN is one that an angle may explain: judge_doubts. [SR-25] [SR-27] */
static void follow_side(const flux_residual_t *residual, phase_evidence_t *state, unsigned index, int side) {
    phase_evidence_phase_t *phase_state = &state->phase[index];
    phase_state->turned = side == 0 || side != phase_state->side
                              ? 0
                              : fixed_saturate((int64_t)phase_state->turned + fixed_abs(residual->step));
    phase_state->side = (int8_t)side;
    if (phase_state->turned >= TURN_MIN) {
        state->doubted |= 1u << index;
        state->doubted_side = side;
        state->quiet_turned_q24 = 0;
    }
}

/* True when a phase has had less flux linkage than any angle explains in OPEN_SAMPLES samples in succession. [SR-25] */
static bool stays_open(phase_evidence_phase_t *phase_state, bool too_little) {
    const unsigned samples = phase_state->open_samples + (phase_state->open_samples < OPEN_SAMPLES ? 1u : 0u);
    phase_state->open_samples = (uint8_t)(too_little ? samples : 0);
    return phase_state->open_samples >= OPEN_SAMPLES;
}

/* [SR-25] [SR-26] [SR-27] */
static void check_phase(const flux_residual_t *residual, phase_evidence_t *state, unsigned index,
                        flux_evidence_t *evidence) {
    const bool is_lost = (residual->sample.lost_phases >> index & 1u) != 0;
    phase_evidence_phase_t *phase_state = &state->phase[index];
    const flux_residual_phase_t *phase = &residual->phase[index];
    const bool remains = does_not_fall(residual, phase_state, phase);
    int side = 0;
    difference_t difference = AGREES;
    if (residual->sample.run && !residual->lost && !is_lost) {
        difference = compare(residual, phase_state, index, &side);
        state->agreed |= (uint32_t)(difference == AGREES && !phase->small) << index;
    }
    follow_side(residual, state, index, side);
    const bool beyond = difference == BEYOND_ANGLES;
    evidence->too_little |= (uint32_t)stays_open(phase_state, beyond && side > 0) << index;
    const bool more = phase->current_q9 > 2 * residual->offset_q9;
    check_excess(residual, phase_state, index, (phase->at_rest && more) || remains || (beyond && side < 0), evidence);
    const bool missing = is_missing(residual, phase_state, index);
    evidence->missing |= (uint32_t)(residual->sample.run && missing) << index;
    evidence->suspicious |=
        difference != AGREES || phase_state->excess_periods > 0 || (more && phase->off && phase->flux_q29 == 0);
}

/* Differences that an angle may explain: the phase's, when it alone has them within an electrical revolution and
 * DOUBT_MS, in which all others have conducted within the tolerances, and then has one again; else they decide nothing
 * here, and may be the encoder's. A wrong angle shows most in a stroke that begins in its middle, as the first one of a
 * run, and may be within the tolerances in complete ones; a fault of the phase shows in the next stroke, too.
 * [SR-25] [SR-27] */
static void judge_doubts(const flux_residual_t *residual, phase_evidence_t *state, flux_evidence_t *evidence) {
    if (state->doubted == 0) {
        state->doubted_at = residual->sample.periods;
        state->doubt_turned_q24 = 0;
        state->agreed = 0;
        return;
    }
    state->doubt_turned_q24 = fixed_add(state->doubt_turned_q24, residual->step / 256);
    state->quiet_turned_q24 = fixed_add(state->quiet_turned_q24, residual->step / 256);
    const uint32_t doubted = state->doubted;
    const bool alone = (doubted & (doubted - 1u)) == 0;
    const int32_t quiet_q24 = fixed_abs(state->quiet_turned_q24);
    if (fixed_abs(state->doubt_turned_q24) < 1 << 24 ||
        residual->sample.periods - state->doubted_at < DOUBT_MS * residual->sample.periods_per_ms ||
        (alone && quiet_q24 > AGAIN_Q24 && quiet_q24 < GONE_Q24)) {
        return;
    }
    state->doubted = 0;
    const uint32_t agreed = state->agreed;
    state->agreed = 0;
    const uint32_t all = (1u << residual->phases) - 1u;
    if (!alone || quiet_q24 >= GONE_Q24 || ((doubted | agreed | residual->sample.lost_phases) & all) != all) {
        return;
    }
    if (state->doubted_side > 0) {
        evidence->too_little_at_angle = doubted;
    } else {
        evidence->too_much_at_angle = doubted;
    }
}

/* [SR-29] */
void phase_evidence_forget(phase_evidence_t *state) {
    state->doubted = 0;
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        state->phase[phase].excess_periods = 0;
        state->phase[phase].open_samples = 0;
        state->phase[phase].turned = 0;
    }
}

/* [SR-25] [SR-26] [SR-27] */
COLD void phase_evidence_step(phase_evidence_t *state, const flux_residual_t *residual, flux_evidence_t *evidence) {
    for (unsigned phase = 0; phase < residual->phases; phase++) {
        check_phase(residual, state, phase, evidence);
    }
    if (residual->sample.run) {
        judge_doubts(residual, state, evidence);
    } else {
        state->doubted = 0;
    }
}
