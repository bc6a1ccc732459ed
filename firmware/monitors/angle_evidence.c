#include "monitors/angle_evidence.h"

#include "control/applied_flux.h"
#include "control/machine_tables.h"
#include "control/phase_map.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"
#include "fixed/formats.h"

/* Time constant of the leak of the reference, and time over which the error of the voltage adds up in it: 1/256 s. */
#define LEAK_SHIFT 8

/* Error of the flux linkage by the shape of the tables: 1/64. */
#define SHAPE_SHIFT 6

/* Once the rotor has been seen to move in a run, a larger error of the voltage is tolerated, twice that and 1/64 of the
 * DC-link voltage: the currents follow the torque, and their pulses change. */
#define MOVING_FACTOR 2
#define PART_SHIFT 6

/* In short periods the other parts of the tolerances, which are of a period's flux linkage, are small: another 1/64 of
 * the DC-link voltage at each multiple of this rate. */
#define SHORT_PERIOD_HZ 50000u

/* Error of the flux linkage by gains of sensors and machine: 1/8. */
#define GAIN_SHIFT 3

/* Error of a current, A, Q7.9: 0.75 A. */
#define CURRENT_ERROR_Q9 384

/* Time for which they have parted that shows a frozen encoder: 1/2048 s, in which a current that a sensor does not show
 * trips the comparators first. */
#define FROZEN_SHIFT 11

/* Periods of a contradiction in succession that are one. */
#define PERSISTENT_PERIODS 3

/* A contradiction counts for 1/4 s; one of a phase alone when it lasts for 1/256 s. */
#define SHOWN_SHIFT 2
#define ALONE_SHIFT 8

/* Time for which a phase has to be consistent with the angle to speak for the encoder: 1/1024 s. When two others, or
 * all that there are, have within a quarter of a second (SHOWN_SHIFT), the contradiction of one alone is not the
 * encoder's. */
#define AGREES_SHIFT 10
#define AGREEING_PHASES 2

/* Time for which a contradiction waits for the next phase: 1/64 s. */
#define WAIT_SHIFT 6

/* Time without a zero of the current after which an integral is too old to contradict the angle: 1/128 s. */
#define AGE_SHIFT 7

/* Mechanical angle in which a free rotor at the torque limit reaches the speed whose back-EMF is the tolerated
 * error of the voltage, twice, in rad: 4 degrees, Q20. */
#define TWICE_ANGLE_Q20 73204

/* 2^20 rad/s^2: 52 N m on 5e-5 kg m^2. */
#define ACCELERATION_MAX (INT64_C(1) << 20)

/* Square root, rounded down. */
static uint32_t square_root(uint64_t square) {
    uint32_t root = 0;
    for (uint32_t bit = UINT32_C(1) << 31; bit != 0; bit >>= 1) {
        const uint64_t larger = root | bit;
        root = larger * larger <= square ? (uint32_t)larger : root;
    }
    return root;
}

/* [SR-21] [SR-30] */
int32_t angle_evidence_flux_error_q29(int64_t acceleration, int32_t current_q9, int32_t angle_step_q32,
                                      uint32_t rotor_poles) {
    const int64_t clamped = acceleration < ACCELERATION_MAX ? acceleration : ACCELERATION_MAX;
    const uint64_t square_q22 = (uint64_t)clamped * TWICE_ANGLE_Q20 * 4u >> machine_tables.speed_exponent;
    const int32_t speed_q22 = fixed_saturate((int64_t)square_root(square_q22) << 11);
    const uint32_t step = (uint32_t)fixed_multiply_high(speed_q22, angle_step_q32) * rotor_poles;
    const int32_t rise_q29 = fixed_subtract(phase_map_flux_q29(&machine_tables, HALF_REV - 1u, current_q9),
                                            phase_map_flux_q29(&machine_tables, 0, current_q9)) /
                             2;
    return 2 * fixed_multiply_high(rise_q29, (int32_t)step);
}

/* Values that all phases have in common in a sample. */
typedef struct {
    const angle_evidence_parameters_t *parameters;
    const flux_residual_t *residual;
    uint32_t electrical;      /* middle of the encoder's count, 2^-32 electrical rev */
    int64_t moving_drift_q29; /* tolerated error of the voltage in a period, Wb, Q2.29 */
    int64_t drift_q29;        /* the same as long as the rotor has not been seen to move in this run */
} common_t;

static common_t common_of(const angle_evidence_parameters_t *parameters, const flux_residual_t *residual, bool moves) {
    const int32_t part_q29 = residual->sample.period_flux_q29 >> PART_SHIFT;
    const int32_t short_q29 = part_q29 * (int32_t)(parameters->rate_hz / SHORT_PERIOD_HZ);
    const int32_t suppressed_q29 = residual->shortest_q29 / 2; /* on average */
    const int32_t device_q29 = residual->device_q29;
    const int32_t pulse_q29 = fixed_max(suppressed_q29, short_q29);
    const int64_t moving_q29 =
        MOVING_FACTOR * ((int64_t)parameters->flux_error_q29 + short_q29) + fixed_max(device_q29, part_q29);
    const int64_t standing_q29 = parameters->flux_error_q29 + (int64_t)fixed_max(pulse_q29, device_q29);
    return (common_t){
        .parameters = parameters,
        .residual = residual,
        .electrical =
            commutation_electrical(&parameters->commutation, residual->sample.encoder_angle + parameters->middle),
        .moving_drift_q29 = moving_q29,
        .drift_q29 = moves ? moving_q29 : standing_q29,
    };
}

static uint32_t age_of(const common_t *common, const flux_residual_phase_t *phase) {
    return common->residual->sample.periods - phase->zero_at;
}

static flux_band_t band_of(const flux_residual_phase_t *phase, uint32_t distance, uint32_t width,
                           int32_t current_error_q9) {
    return flux_residual_band(distance, width, phase->current_q9 - current_error_q9,
                              phase->current_q9 + current_error_q9);
}

/* Tolerated error of an integral that is too small, by a cold winding, or too large, by a warm one, Wb, Q2.29, since
 * the phase was without current. */
static int32_t drift_since_zero_q29(const common_t *common, const flux_residual_phase_t *phase, bool small) {
    const uint32_t age = age_of(common, phase);
    const int64_t device_q29 = (int64_t)common->residual->device_q29 * age;
    const int64_t resistive_q29 = small ? applied_flux_cold_q29(phase->drop_q29)
                                        : applied_flux_warm_q29(&machine_tables, phase->drop_q29) + device_q29;
    const int64_t drift_q29 = common->moving_drift_q29 * (int32_t)age;
    return fixed_saturate(common->residual->sample.period_flux_q29 / 4 +
                          applied_flux_independent(drift_q29, resistive_q29));
}

/* An integral that is too old to contradict the angle. */
static bool is_old(const common_t *common, const flux_residual_phase_t *phase) {
    return age_of(common, phase) > common->parameters->rate_hz >> AGE_SHIFT;
}

/* False when no angle at all explains the integral at the measured current, by the tolerances of contradicts(): then
 * the phase, its sensor or the voltage is at fault, not the encoder. */
static bool fits_an_angle(const common_t *common, const flux_residual_phase_t *phase) {
    const flux_band_t band = band_of(phase, 0, HALF_REV, CURRENT_ERROR_Q9);
    const int32_t least_q29 = band.least_q29 - (band.least_q29 >> GAIN_SHIFT);
    const int32_t most_q29 = fixed_add(band.most_q29, band.most_q29 >> GAIN_SHIFT);
    return phase->voltage_q29 >= fixed_subtract(least_q29, drift_since_zero_q29(common, phase, true)) &&
           phase->voltage_q29 <= fixed_add(most_q29, drift_since_zero_q29(common, phase, false));
}

/* First-order step of a value towards another, by a part in Q15. */
static int32_t leak(int32_t value, int32_t towards, int32_t part_q15) {
    return fixed_add(value, fixed_multiply(fixed_subtract(towards, value), part_q15, 15));
}

/* Fastest parting that a rotor can cause whose motion the encoder does not show, per control period, Wb, Q2.29: its
 * back-EMF a sixteenth of the DC-link voltage, above which a rotor that turned before is found by its travel
 * (monitors/protection.h), or a free rotor's from rest after 32 degrees. What parts faster is a fault of the
 * phase. [SR-21] */
static int32_t fastest_parting_q29(const common_t *common) {
    const int32_t turning_q29 = common->residual->sample.period_flux_q29 / 16;
    const int32_t from_rest_q29 = fixed_saturate(8 * (int64_t)common->parameters->flux_error_q29);
    return fixed_max(turning_q29, from_rest_q29);
}

/* [SR-21] */
static void refer(const common_t *common, angle_evidence_phase_t *state, const flux_residual_phase_t *phase,
                  int32_t excess_q29, int32_t table_q29) {
    state->referred = true;
    state->current_q9 = phase->current_q9;
    state->excess_q29 = state->last_excess_q29 = excess_q29;
    state->table_q29 = state->last_table_q29 = table_q29;
    state->referred_at = common->residual->sample.periods;
    state->zero_at = phase->zero_at;
    state->drop_q29 = 0;
    state->moved = 0;
}

/* True when integral and tables have parted since the encoder has been at its present count. [SR-21] */
static bool has_moved(const common_t *common, angle_evidence_phase_t *state, const flux_residual_phase_t *phase,
                      uint32_t distance) {
    const uint32_t rate_hz = common->parameters->rate_hz, periods = common->residual->elapsed;
    const flux_band_t band = band_of(phase, distance, common->parameters->half_count, 0);
    const int32_t table_q29 = band.least_q29 / 2 + band.most_q29 / 2;
    const int32_t excess_q29 = fixed_subtract(phase->voltage_q29, table_q29);
    const bool renewed = !state->referred || state->zero_at != phase->zero_at;
    if (renewed || phase->current_q9 > state->current_q9 + state->current_q9 / 8) {
        refer(common, state, phase, excess_q29, table_q29);
        return false;
    }
    const uint32_t leak_periods = rate_hz >> LEAK_SHIFT;
    const uint32_t age = common->residual->sample.periods - state->referred_at;
    const uint32_t summed = age < leak_periods ? age : leak_periods;
    state->drop_q29 = fixed_add(state->drop_q29, phase->step_drop_q29);
    const bool falls = excess_q29 < state->excess_q29;
    const int32_t resistive_q29 =
        falls ? applied_flux_cold_q29(state->drop_q29) : applied_flux_warm_q29(&machine_tables, state->drop_q29);
    const int32_t drift_q29 =
        fixed_saturate(applied_flux_independent(common->drift_q29 * (int32_t)summed, resistive_q29));
    const int32_t change_q29 = fixed_abs(fixed_subtract(excess_q29, state->excess_q29));
    const int32_t tolerance_q29 = drift_q29 + (band.most_q29 - band.least_q29) + (table_q29 >> SHAPE_SHIFT) +
                                  (fixed_abs(table_q29 - state->table_q29) >> GAIN_SHIFT);
    /* At another angle the tables err by a part of what the current has changed. */
    const int32_t jump_q29 = fixed_abs(fixed_subtract(excess_q29, state->last_excess_q29)) -
                             fixed_abs(table_q29 - state->last_table_q29) / 2;
    state->last_excess_q29 = excess_q29;
    state->last_table_q29 = table_q29;
    const int64_t fastest_q29 = fastest_parting_q29(common);
    if ((change_q29 > tolerance_q29 / 2 && change_q29 > fastest_q29 * age) ||
        (jump_q29 > tolerance_q29 / 2 && jump_q29 > fastest_q29 * periods)) {
        refer(common, state, phase, excess_q29, table_q29);
        return false;
    }
    state->moved = change_q29 > tolerance_q29 ? state->moved + periods : 0;
    const int32_t part_q15 = (int32_t)((fixed_min_u32(periods, leak_periods) << 15) / leak_periods);
    state->excess_q29 = leak(state->excess_q29, excess_q29, part_q15);
    state->table_q29 = leak(state->table_q29, table_q29, part_q15);
    state->drop_q29 = leak(state->drop_q29, 0, part_q15);
    return state->moved > rate_hz >> FROZEN_SHIFT;
}

/* Counts the periods for which the flux linkage has contradicted the angle. True when it does, or is beyond half of its
 * tolerance. [SR-22] */
static bool contradicts(const common_t *common, angle_evidence_phase_t *state, const flux_residual_phase_t *phase,
                        uint32_t distance) {
    const angle_evidence_parameters_t *parameters = common->parameters;
    if (is_old(common, phase)) {
        return state->contradicted > 0;
    }
    const int32_t flux_q29 = phase->voltage_q29;
    const flux_band_t band = band_of(phase, distance, parameters->angle_max + parameters->half_count, CURRENT_ERROR_Q9);
    const bool below = flux_q29 < band.least_q29;
    const int32_t drift_q29 = drift_since_zero_q29(common, phase, below);
    const int32_t limit_q29 = below ? band.least_q29 : band.most_q29;
    const int32_t beyond_q29 = below ? fixed_subtract(limit_q29, flux_q29) : fixed_subtract(flux_q29, limit_q29);
    const int32_t tolerance_q29 = fixed_add(limit_q29 >> GAIN_SHIFT, drift_q29);
    if (beyond_q29 <= tolerance_q29 || !fits_an_angle(common, phase)) {
        state->contradicted = 0;
        return beyond_q29 > tolerance_q29 / 2;
    }
    state->contradicted += state->contradicted == 0 ? 1 : common->residual->elapsed;
    return true;
}

/* True from a current that moves without a voltage, at the smallest inductance and beyond what the rotor's motion does,
 * until the phase is without current again: a connection or sensor that fails for a moment leaves the integral wrong.
 */
static bool interrupted(const common_t *common, angle_evidence_phase_t *state, const flux_residual_phase_t *phase) {
    const int32_t moved_q9 = fixed_abs(phase->current_q9 - state->last_current_q9);
    const int64_t moved_q29 = fixed_abs(fixed_subtract(phase->voltage_q29, state->last_flux_q29));
    const int64_t most_q29 = moved_q29 + (int64_t)common->residual->sample.period_flux_q29 * common->residual->elapsed;
    if (state->conducts && phase_map_flux_q29(&machine_tables, 0, moved_q9) > most_q29) {
        state->interrupted = true;
        state->interrupted_zero_at = phase->zero_at;
    }
    state->conducts = true;
    state->last_current_q9 = phase->current_q9;
    state->last_flux_q29 = phase->voltage_q29;
    state->interrupted = state->interrupted && state->interrupted_zero_at == phase->zero_at;
    return state->interrupted;
}

/* True while a phase has shown a contradiction in the last quarter of a second. [SR-22] */
static bool shows(const common_t *common, angle_evidence_phase_t *state) {
    const uint32_t period = common->residual->sample.periods;
    if (state->contradicted >= PERSISTENT_PERIODS) {
        state->shown_from = state->shown ? state->shown_from : period;
        state->shown = true;
        state->shown_at = period;
    }
    return state->shown;
}

/* Notes how long a phase that is checked has been consistent with the angle. [SR-22] */
static void note_agreement(const common_t *common, angle_evidence_phase_t *state) {
    state->agrees = state->contradicted == 0 ? state->agrees + common->residual->elapsed : 0;
    if (state->agrees > common->parameters->rate_hz >> AGREES_SHIFT) {
        state->agreed = true;
        state->agreed_at = common->residual->sample.periods;
    }
}

/* Forgets what is longer ago than it counts, before the number of the period comes round. [SR-22] */
static void forget_old(const common_t *common, angle_evidence_t *state) {
    const uint32_t period = common->residual->sample.periods, rate_hz = common->parameters->rate_hz;
    state->advanced = state->advanced && period - state->advanced_at <= rate_hz >> ALONE_SHIFT;
    for (unsigned phase = 0; phase < common->residual->phases; phase++) {
        angle_evidence_phase_t *one = &state->phase[phase];
        one->agreed = one->agreed && period - one->agreed_at <= rate_hz >> SHOWN_SHIFT;
        one->shown = one->shown && period - one->shown_at <= rate_hz >> SHOWN_SHIFT;
    }
}

/* True when two of the other phases, or all that are not lost, have been consistent with the angle in the last quarter
 * of a second. One that is left is enough: what it has shown, it contradicts when it conducts the next time, if the
 * encoder is wrong. [SR-22] */
static bool others_agree(const common_t *common, const angle_evidence_t *state, unsigned index) {
    bool all = true;
    unsigned agreeing = 0;
    for (unsigned other = 0; other < common->residual->phases; other++) {
        const angle_evidence_phase_t *phase = &state->phase[other];
        if (other != index && (common->residual->sample.lost_phases >> other & 1u) == 0) {
            all &= phase->agreed;
            agreeing += phase->agreed;
        }
    }
    return all || agreeing >= AGREEING_PHASES;
}

/* True while the encoder shows a rotor that turns the way the torque drives it. [SR-22] */
static bool advances(const common_t *common, angle_evidence_t *state) {
    const flux_sample_t *sample = &common->residual->sample;
    const int32_t least = common->parameters->advance_min;
    const int32_t travel = (int32_t)(sample->encoder_angle - state->waypoint);
    const int32_t advance = sample->torque_q24 < 0 ? fixed_subtract(0, travel) : travel;
    if (advance < 0 || advance >= least) {
        state->waypoint = sample->encoder_angle;
    }
    if (advance >= least) {
        state->advanced = true;
        state->advanced_at = sample->periods;
    }
    return state->advanced;
}

/* [SR-21] [SR-22] */
static void check_phase(const common_t *common, angle_evidence_t *state, unsigned index, bool counted,
                        flux_evidence_t *evidence) {
    angle_evidence_phase_t *phase_state = &state->phase[index];
    const flux_residual_phase_t *phase = &common->residual->phase[index];
    const bool conducts = phase->current_q9 >= common->parameters->current_min_q9;
    if (!conducts) {
        phase_state->conducts = false;
    }
    if (conducts && phase->known && !interrupted(common, phase_state, phase)) {
        const uint32_t angle = common->electrical - index * common->parameters->commutation.stroke;
        const uint32_t distance = phase_map_distance(angle);
        state->parted |= !counted && has_moved(common, phase_state, phase, distance);
        evidence->suspicious |= contradicts(common, phase_state, phase, distance);
        note_agreement(common, phase_state);
    } else {
        phase_state->referred = false;
        phase_state->contradicted = 0;
        phase_state->agrees = 0;
    }
    evidence->contradicts |= (uint32_t)shows(common, phase_state) << index;
}

/* A run that has ended leaves nothing that counts but `parted`: an advance is forgotten sooner than a contradiction may
 * last. [SR-22] */
static void forget(angle_evidence_t *state, uint32_t encoder_angle) {
    state->counted = false;
    state->waypoint = encoder_angle;
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        state->phase[phase].referred = false;
        state->phase[phase].contradicted = 0;
        state->phase[phase].shown = false;
        state->phase[phase].agreed = false;
        state->phase[phase].agrees = 0;
    }
}

/* [SR-21] [SR-22] */
COLD void angle_evidence_step(const angle_evidence_parameters_t *parameters, angle_evidence_t *state,
                              const flux_residual_t *residual, flux_evidence_t *evidence) {
    const uint32_t encoder_angle = residual->sample.encoder_angle;
    const bool counted = state->started && encoder_angle != state->encoder_angle;
    state->started = true;
    state->encoder_angle = encoder_angle;
    if (counted) {
        state->parted = false;
        state->counted = true;
        for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
            state->phase[phase].referred = false;
        }
    }
    if (residual->sample.run) {
        const common_t common = common_of(parameters, residual, state->counted);
        forget_old(&common, state);
        const bool next_decides = advances(&common, state);
        for (unsigned phase = 0; phase < residual->phases; phase++) {
            check_phase(&common, state, phase, counted, evidence);
            const uint32_t since = residual->sample.periods - state->phase[phase].shown_from;
            const bool waits = next_decides && since <= parameters->rate_hz >> WAIT_SHIFT;
            evidence->contradicts_alone |= state->phase[phase].contradicted > parameters->rate_hz >> ALONE_SHIFT &&
                                           !waits && !others_agree(&common, state, phase);
        }
    } else {
        forget(state, encoder_angle);
    }
    evidence->parted = state->parted;
}
