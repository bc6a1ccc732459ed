#include "monitors/phase_monitor.h"

#include "control/phase_map.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"
#include "fixed/formats.h"
#include "storage/fault.h"

/* 10 degrees electrical: 2.5 degrees of a rotor with four poles. */
#define ANGLE_TOLERANCE (UINT32_MAX / 36u)

/* Rotation after which a difference that an angle may explain is a fault: 1/32 electrical rev. */
#define TURN_MIN (1 << 27)

/* Time constant with which the integral follows the tables, ms. */
#define FOLLOW_MS 10u

/* Currents up to this multiple of the offset are small. Drops of the devices, and pulses that are too short to act,
 * then make the error of the voltage twice as large. */
#define SMALL_CURRENT 4

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

/* What all phases have in common. */
typedef struct {
    const machine_tables_t *tables;
    const phase_monitor_input_t *input;
    bool lost;         /* triggers were lost since the previous input: the integral is wrong */
    uint32_t elapsed;  /* control periods since the previous input */
    int32_t step;      /* rotation since then, 2^-32 electrical rev */
    int32_t offset_q9; /* tolerance of a current, A, Q7.9 */
    int32_t delay_q29; /* tolerance of a flux linkage, Wb, Q2.29 */
    /* Errors in a period, Wb, Q2.29: */
    int32_t voltage_q29; /* error of the voltage, by its sensor or by pulses that do not act */
    int32_t device_q29;  /* threshold of the devices */
    int32_t error_q29;   /* the larger one */
} common_t;

/* Largest and smallest flux linkage at a measured current, at a distance. */
NOINLINE static int32_t most_q29(const common_t *common, uint32_t distance, int32_t current_q9, int32_t offset_q9) {
    const int32_t table_q29 = phase_map_flux_q29(common->tables, distance, current_q9 + current_q9 / 10 + offset_q9);
    return fixed_add(table_q29, table_q29 / 20 * 3);
}

NOINLINE static int32_t least_q29(const common_t *common, uint32_t distance, int32_t current_q9) {
    const int32_t table_q29 = phase_map_flux_q29(common->tables, distance, (current_q9 - common->offset_q9) * 10 / 11);
    return table_q29 - table_q29 / 20 * 3;
}

NOINLINE static uint32_t distance_of(const phase_monitor_input_t *input, unsigned phase) {
    return phase_map_distance(input->electrical - phase * input->stroke - (uint32_t)input->misalignment[phase]);
}

/* Tolerance of the integral, Wb, Q2.29: what has accumulated since the phase was at rest, or in FOLLOW_MS, of the error
 * of the voltage and of what winding and devices take more or less, which are independent; and delays. */
static int32_t slack_q29(const common_t *common, const phase_monitor_phase_t *state, unsigned phase,
                         int64_t resistive_q29) {
    const int64_t voltage_q29 = (int64_t)common->voltage_q29 * (int32_t)state->conducting;
    /* An error at the largest flux linkage remains while it falls. */
    const int32_t fallen_q29 = state->peak_q29 - common->input->flux_q29[phase];
    return fixed_saturate(applied_flux_independent(voltage_q29, resistive_q29) + common->delay_q29 + fallen_q29 / 4);
}

/* Least and largest flux linkage that the voltage may have built up, Wb, Q2.29. */
static int32_t least_applied_q29(const common_t *common, const phase_monitor_phase_t *state, unsigned phase) {
    const int64_t devices_q29 = (int64_t)common->device_q29 * (int32_t)state->conducting;
    const int32_t warm_q29 = applied_flux_warm_q29(common->tables, state->followed_drop_q29);
    return fixed_subtract(common->input->flux_q29[phase], slack_q29(common, state, phase, warm_q29 + devices_q29));
}

static int32_t most_applied_q29(const common_t *common, const phase_monitor_phase_t *state, unsigned phase) {
    const int32_t cold_q29 = applied_flux_cold_q29(state->followed_drop_q29);
    return fixed_add(common->input->flux_q29[phase], slack_q29(common, state, phase, cold_q29));
}

/* R i over the periods between two inputs, Wb, Q2.29. */
static int32_t drop_step_q29(const phase_monitor_input_t *input, unsigned phase, uint32_t elapsed) {
    const int32_t period_q29 = fixed_multiply_high(input->current_q9[phase] << 12, input->resistance_period_q40);
    return fixed_non_negative(fixed_saturate((int64_t)period_q29 * (int32_t)(elapsed & 0xffffu)));
}

static bool small(const common_t *common, unsigned phase) {
    return common->input->current_q9[phase] <= SMALL_CURRENT * common->offset_q9;
}

/* Side and extent of a difference between voltage and current. */
typedef enum {
    AGREES,
    DOUBTFUL,      /* agrees within the tolerances, with hardly a current */
    NEARLY,        /* agrees within them, but not within half of them */
    WITHIN_ANGLES, /* differs at the measured angle */
    BEYOND_ANGLES  /* differs at any */
} difference_t;

/* The flux linkage by the tables is between the limits of both sides, so that most comparisons end with it. */
static difference_t compare(const common_t *common, phase_monitor_phase_t *state, unsigned phase, int *side) {
    const int32_t table_q29 = state->table_q29;
    const int32_t current_q9 = common->input->current_q9[phase];
    const int32_t flux_q29 = common->input->flux_q29[phase];
    int32_t high_q29 = least_applied_q29(common, state, phase);
    const int32_t low_q29 = most_applied_q29(common, state, phase);
    const bool is_small = small(common, phase);
    if (!is_small || flux_q29 < state->base_q29 || common->elapsed > common->input->periods_per_ms / 2u) {
        state->base_q29 = flux_q29;
    }
    if (is_small) { /* errors of the past do not count: only what has been built up since */
        high_q29 = fixed_subtract(flux_q29, fixed_add(state->base_q29, common->delay_q29));
        state->base_q29 =
            fixed_saturate(state->base_q29 + 2 * (int64_t)common->error_q29 * (int32_t)(common->elapsed & 0xffffu) +
                           applied_flux_warm_q29(common->tables, drop_step_q29(common->input, phase, common->elapsed)));
    }
    *side = 0;
    if (high_q29 <= table_q29 && low_q29 >= table_q29) {
        return AGREES;
    }
    const uint32_t distance = distance_of(common->input, phase);
    const uint32_t far = distance + ANGLE_TOLERANCE;
    const int32_t highest_q29 = most_q29(common, far < HALF_REV ? far : HALF_REV - 1, current_q9, common->offset_q9);
    if (high_q29 > highest_q29) {
        *side = 1;
        /* What tables of a wrong angle have added shows no more than an angle. */
        const int32_t by_voltage_q29 = fixed_subtract(high_q29, fixed_non_negative(state->followed_q29));
        return by_voltage_q29 > most_q29(common, HALF_REV - 1, current_q9, 0) ? BEYOND_ANGLES : WITHIN_ANGLES;
    }
    const int32_t lowest_q29 =
        least_q29(common, distance > ANGLE_TOLERANCE ? distance - ANGLE_TOLERANCE : 0, current_q9);
    if (low_q29 < lowest_q29) {
        *side = -1;
        return low_q29 < least_q29(common, 0, current_q9) ? BEYOND_ANGLES : WITHIN_ANGLES;
    }
    if (is_small) {
        return high_q29 > table_q29 ? DOUBTFUL : AGREES;
    }
    return high_q29 > table_q29 / 2 + highest_q29 / 2 || low_q29 < table_q29 / 2 + lowest_q29 / 2 ? NEARLY : AGREES;
}

/* Flux linkage that the opposite voltage removes within a period. */
static bool gone(const phase_monitor_input_t *input, unsigned phase) {
    return input->flux_q29[phase] < input->period_flux_q29;
}

/* Periods since the phase was at rest, those of a small current twice; what lies further back than FOLLOW_MS has been
 * corrected. */
static uint32_t conducting(const common_t *common, const phase_monitor_phase_t *state, unsigned phase) {
    const uint32_t follow = FOLLOW_MS * common->input->periods_per_ms;
    const uint32_t step = 2 * (common->elapsed < follow ? common->elapsed : follow);
    const uint32_t now = state->conducting;
    if (small(common, phase)) {
        return now + step < 2 * follow ? now + step : 2 * follow;
    }
    if (now > follow) {
        return now - follow > step ? now - step : follow;
    }
    return now + step / 2 < follow ? now + step / 2 : follow;
}

/* True when the voltage has left the phase without flux linkage, errors of the integral included. */
static bool at_rest(const common_t *common, phase_monitor_t *monitor, unsigned phase) {
    phase_monitor_phase_t *state = &monitor->phase[phase];
    const phase_monitor_input_t *input = common->input;
    const int32_t flux_q29 = input->flux_q29[phase];
    state->conducting = conducting(common, state, phase);
    state->peak_q29 = flux_q29 > state->peak_q29 ? flux_q29 : state->peak_q29;
    if (!input->off[phase] || flux_q29 > 0) {
        state->rest_q29 = 0;
        return false;
    }
    /* Since the previous input, if the phase was at 0 then already. */
    const uint32_t periods = state->rest_q29 == 0 ? 1 : common->elapsed & 0xffffu;
    monitor->suspicious |= input->current_q9[phase] > 2 * common->offset_q9;
    state->rest_q29 = fixed_saturate(state->rest_q29 + (int64_t)input->period_flux_q29 * (int32_t)periods);
    /* The integral of a cold winding is 0 before the flux linkage is. */
    const int32_t remains_q29 = applied_flux_cold_q29(state->followed_drop_q29);
    if (state->rest_q29 < fixed_add(fixed_add(state->peak_q29 / 4, common->delay_q29), remains_q29)) {
        return false;
    }
    if (input->current_q9[phase] <= 2 * common->offset_q9) {
        state->peak_q29 = 0;
        state->conducting = 0;
        return false;
    }
    return true;
}

/* True when the opposite voltage has removed a quarter of the flux linkage since the switches opened, and the tables
 * saw less than a quarter of that part disappear. Parts, because at a wrong angle the tables err by a factor; of a flux
 * linkage from which that may have taken away something. */
static bool does_not_fall(const common_t *common, phase_monitor_phase_t *state, unsigned phase) {
    const int32_t flux_q29 = common->input->flux_q29[phase];
    if (!common->input->off[phase] || !state->was_off || common->lost) {
        state->off_flux_q29 = flux_q29;
        state->off_all_q29 = fixed_add(fixed_add(flux_q29, fixed_clamp(-state->followed_q29, 0, INT32_MAX)),
                                       applied_flux_cold_q29(state->drop_q29));
        state->off_table_q29 = state->table_q29;
    }
    state->was_off = common->input->off[phase];
    const int32_t removed_q29 = fixed_subtract(fixed_subtract(state->off_flux_q29, flux_q29), 2 * common->delay_q29);
    const int32_t fallen_q29 = fixed_subtract(state->off_table_q29, state->table_q29);
    return !small(common, phase) && removed_q29 > state->off_all_q29 / 4 &&
           fixed_product(fallen_q29, state->off_all_q29) < fixed_product(removed_q29, state->off_table_q29) / 4;
}

/* True when the integral has gone only because the tables have taken most of it away, more than a warm winding and the
 * drops of the devices explain, a seventh of the error of the voltage, twice that after a small current: by voltage and
 * time alone
 * the current may flow, and it is the angle of the tables that is wrong. At most all of it: what is more has added up
 * in a long stroke. */
static bool taken_away(const common_t *common, const phase_monitor_phase_t *state) {
    const uint32_t age = common->input->periods - state->zero_at;
    const bool was_small = state->conducting > FOLLOW_MS * common->input->periods_per_ms;
    const int64_t drops_q29 = (int64_t)(common->error_q29 / 7 * (was_small ? 2 : 1)) * age;
    const int64_t taken_q29 = -(int64_t)state->followed_q29;
    const int32_t warm_q29 = applied_flux_warm_q29(common->tables, state->drop_q29);
    return taken_q29 > state->peak_q29 / 2 + drops_q29 + warm_q29 && taken_q29 < 2 * (int64_t)state->peak_q29;
}

/* A current that should not be: does it move? */
static uint32_t check_excess(const common_t *common, phase_monitor_phase_t *state, unsigned phase, bool excess) {
    const int32_t current_q9 = common->input->current_q9[phase];
    if (!excess) {
        const bool lasted = state->excess_periods >= common->input->periods_per_ms / 2u;
        state->excess_periods = 0;
        return lasted ? (uint32_t)FAULT_BIT(FAULT_CURRENT_SENSOR) : 0;
    }
    if (state->excess_periods == 0) {
        state->least_q9 = state->most_q9 = current_q9;
    }
    state->least_q9 = current_q9 < state->least_q9 ? current_q9 : state->least_q9;
    state->most_q9 = current_q9 > state->most_q9 ? current_q9 : state->most_q9;
    state->excess_periods += state->excess_periods == 0 ? 1 : common->elapsed;
    const int32_t moved_q9 = state->most_q9 - state->least_q9;
    if (state->excess_periods <= common->input->periods_per_ms / 4u) {
        return 0;
    }
    if (moved_q9 > common->offset_q9) {
        return (uint32_t)(taken_away(common, state) ? FAULT_BIT(FAULT_ENCODER_ANGLE) : FAULT_BIT(FAULT_PHASE_SHORTED));
    }
    const bool still = moved_q9 == 0 || state->excess_periods > STILL_MS * common->input->periods_per_ms;
    return still ? (uint32_t)FAULT_BIT(FAULT_CURRENT_SENSOR) : 0;
}

static uint32_t check_phase(const common_t *common, phase_monitor_t *monitor, unsigned phase) {
    phase_monitor_phase_t *state = &monitor->phase[phase];
    const bool rest = at_rest(common, monitor, phase);
    const bool remains = does_not_fall(common, state, phase);
    int side = 0;
    difference_t difference = AGREES;
    const bool off = (monitor->lost >> phase & 1u) != 0;
    if (common->input->run && !common->lost && !off) {
        difference = compare(common, state, phase, &side);
        monitor->agreed |= (uint32_t)(difference == AGREES && !small(common, phase)) << phase;
        monitor->nearly |= (uint32_t)(difference == NEARLY) << phase;
    }
    monitor->suspicious |= difference != AGREES && difference != NEARLY;
    const bool beyond = difference == BEYOND_ANGLES;
    state->turned =
        side == 0 || side != state->side ? 0 : fixed_saturate((int64_t)state->turned + fixed_abs(common->step));
    state->side = (int8_t)side;
    if (state->turned >= TURN_MIN) {
        monitor->doubted |= 1u << phase;
        monitor->doubted_side = side;
        monitor->quiet_turned_q24 = 0;
    }
    state->open_samples =
        beyond && side > 0 ? (uint8_t)(state->open_samples + (state->open_samples < OPEN_SAMPLES)) : 0;
    uint32_t failed = check_excess(common, state, phase, rest || remains || (beyond && side < 0));
    if (state->open_samples >= OPEN_SAMPLES) {
        failed |= (uint32_t)FAULT_BIT(FAULT_PHASE_OPEN);
    }
    return failed;
}

/* Differences that an angle may explain: the phase's, when it alone has them within an electrical revolution and
 * DOUBT_MS, in which all others have conducted within half of the tolerances, and then has one again; else they decide
 * nothing here, and may be the encoder's. A wrong angle shows most in a stroke that begins in its middle, as the first
 * one of a run, and may be within the tolerances in complete ones; a fault of the phase shows in the next stroke, too.
 */
static uint32_t judge_doubts(const common_t *common, phase_monitor_t *monitor) {
    const unsigned phases = common->tables->phases;
    if (monitor->doubted == 0) {
        monitor->doubted_at = common->input->periods;
        monitor->doubt_turned_q24 = 0;
        monitor->agreed = monitor->nearly = 0;
        return 0;
    }
    monitor->doubt_turned_q24 = fixed_add(monitor->doubt_turned_q24, common->step / 256);
    monitor->quiet_turned_q24 = fixed_add(monitor->quiet_turned_q24, common->step / 256);
    const uint32_t doubted = monitor->doubted;
    const bool alone = (doubted & (doubted - 1u)) == 0;
    const int32_t quiet_q24 = fixed_abs(monitor->quiet_turned_q24);
    if (fixed_abs(monitor->doubt_turned_q24) < 1 << 24 ||
        common->input->periods - monitor->doubted_at < DOUBT_MS * common->input->periods_per_ms ||
        (alone && quiet_q24 > AGAIN_Q24 && quiet_q24 < GONE_Q24)) {
        return 0;
    }
    monitor->doubted = 0;
    const uint32_t agreed = monitor->agreed & ~monitor->nearly;
    monitor->agreed = monitor->nearly = 0;
    const uint32_t all = (1u << phases) - 1u;
    if (!alone || quiet_q24 >= GONE_Q24 || ((doubted | agreed | monitor->lost) & all) != all) {
        return 0;
    }
    monitor->phases |= doubted;
    return (uint32_t)(monitor->doubted_side > 0 ? FAULT_BIT(FAULT_PHASE_OPEN) : FAULT_BIT(FAULT_PHASE_SHORTED));
}

/* Bit of each phase whose current is missing, judged less strictly than a fault, of which it only decides the name: it
 * is less than at the measured angle, or none while there is voltage, or ended within the last milliseconds before the
 * voltage had removed it. */
static uint32_t phases_that_lack(const common_t *common, const phase_monitor_t *monitor) {
    const phase_monitor_input_t *input = common->input;
    uint32_t lacking = 0;
    for (unsigned phase = 0; phase < common->tables->phases; phase++) {
        const phase_monitor_phase_t *state = &monitor->phase[phase];
        const bool vanished =
            state->vanished && input->periods - state->vanished_at < VANISHED_MS * input->periods_per_ms;
        const int32_t table_q29 = fixed_add(state->table_q29, state->table_q29 / 4);
        const bool less = least_applied_q29(common, state, phase) > table_q29;
        const bool none = !input->off[phase] && input->current_q9[phase] <= common->offset_q9 &&
                          input->flux_q29[phase] > common->delay_q29 / 2;
        lacking |= (uint32_t)(vanished || less || none) << phase;
    }
    return lacking;
}

/* What brings the integral nearer to the tables. */
static int32_t correction_of(const common_t *common, phase_monitor_phase_t *state, unsigned phase, bool zero) {
    const phase_monitor_input_t *input = common->input;
    const int32_t flux_q29 = input->flux_q29[phase];
    if (zero) {
        if (flux_q29 > fixed_add(state->peak_q29 / 8, 2 * common->delay_q29)) {
            state->vanished = true;
            state->vanished_at = input->periods;
        }
        state->zero_at = input->periods;
        state->followed_q29 = state->drop_q29 = state->followed_drop_q29 = 0;
        return -flux_q29;
    }
    if (input->off[phase] && gone(input, phase) && input->next_q29[phase] == 0) {
        /* The voltage alone ends it: without the corrections, too? */
        if (fixed_subtract(flux_q29, state->followed_q29) < input->period_flux_q29) {
            state->zero_at = input->periods;
            state->followed_q29 = 0;
        }
        return 0;
    }
    const int32_t error_q29 = state->table_q29 - flux_q29;
    const uint32_t follow = FOLLOW_MS * input->periods_per_ms;
    const bool set = common->lost || common->elapsed >= follow;
    const int32_t correction_q29 = set ? error_q29 : error_q29 / (int32_t)follow * (int32_t)common->elapsed;
    const int32_t drop_q29 = state->followed_drop_q29;
    state->followed_drop_q29 = set ? 0 : drop_q29 - drop_q29 / (int32_t)follow * (int32_t)common->elapsed;
    state->followed_q29 = fixed_add(state->followed_q29, correction_q29);
    return correction_q29;
}

int32_t phase_monitor_drop_q29(const phase_monitor_t *monitor, const phase_monitor_input_t *input, unsigned phase) {
    return fixed_add(monitor->phase[phase].drop_q29, drop_step_q29(input, phase, input->periods - monitor->periods));
}

static void add_drop(const common_t *common, phase_monitor_phase_t *state, unsigned phase) {
    const int32_t step_q29 = drop_step_q29(common->input, phase, common->elapsed);
    state->drop_q29 = fixed_add(state->drop_q29, step_q29);
    state->followed_drop_q29 = fixed_add(state->followed_drop_q29, step_q29);
}

static common_t common_of(const phase_monitor_t *monitor, const machine_tables_t *tables,
                          const phase_monitor_input_t *input) {
    const int32_t period_q29 = input->period_flux_q29;
    const uint32_t elapsed = input->periods - monitor->periods;
    const int32_t shortest_q29 =
        applied_flux_shortest_pulse_q29(period_q29, tables->minimum_pulse_ns, input->periods_per_ms);
    const int32_t voltage_q29 = shortest_q29 > period_q29 / 64 ? shortest_q29 : period_q29 / 64;
    const int32_t device_q29 = applied_flux_device_q29(tables, input->period_q40);
    return (common_t){
        .tables = tables,
        .input = input,
        .lost = input->late_interrupts != monitor->late_interrupts,
        .elapsed = elapsed,
        .step = (int32_t)(input->electrical - monitor->electrical),
        .offset_q9 = tables->current_range_q9 / 128,
        .delay_q29 = fixed_saturate(period_q29 + (int64_t)(period_q29 / 50) * (int32_t)input->periods_per_ms),
        .voltage_q29 = voltage_q29,
        .device_q29 = device_q29,
        .error_q29 = voltage_q29 > device_q29 ? voltage_q29 : device_q29,
    };
}

void phase_monitor_lose(phase_monitor_t *monitor, uint32_t phases) {
    monitor->lost = phases;
    monitor->failed = 0;
    monitor->doubted = 0;
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        monitor->phase[phase].excess_periods = 0;
        monitor->phase[phase].open_samples = 0;
        monitor->phase[phase].turned = 0;
    }
}

COLD uint32_t phase_monitor_step(phase_monitor_t *monitor, const machine_tables_t *tables,
                                 const phase_monitor_input_t *input, int32_t correction_q29[HAL_PHASES_MAX]) {
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        correction_q29[phase] = 0;
    }
    const common_t common = common_of(monitor, tables, input);
    if (common.elapsed == 0) {
        return monitor->failed;
    }
    monitor->late_interrupts = input->late_interrupts;
    monitor->lost_at = common.lost ? input->periods : monitor->lost_at;
    monitor->periods = input->periods;
    monitor->electrical = input->electrical;
    if (input->run && !monitor->run) {
        monitor->phases = 0;
        monitor->doubted = 0;
    }
    monitor->run = input->run;
    uint32_t failed = 0;
    uint32_t in_excess = 0;
    monitor->suspicious = false;
    for (unsigned phase = 0; phase < tables->phases; phase++) {
        const int32_t current_q9 = input->current_q9[phase];
        const bool zero = input->off[phase] && current_q9 <= common.offset_q9;
        monitor->phase[phase].table_q29 = zero ? 0 : phase_map_flux_q29(tables, distance_of(input, phase), current_q9);
        add_drop(&common, &monitor->phase[phase], phase);
        const uint32_t failed_of_phase = check_phase(&common, monitor, phase);
        in_excess |= (uint32_t)(monitor->phase[phase].excess_periods > 0) << phase;
        monitor->phases |= (uint32_t)(failed_of_phase != 0) << phase;
        failed |= failed_of_phase;
        correction_q29[phase] = correction_of(&common, &monitor->phase[phase], phase, zero);
    }
    monitor->suspicious |= in_excess != 0;
    if (input->run) {
        failed |= judge_doubts(&common, monitor);
    }
    /* The current that one phase lacks is read in another. */
    const uint32_t lacking = failed != 0 && input->run ? phases_that_lack(&common, monitor) : 0;
    if (((failed & (uint32_t)FAULT_BIT(FAULT_PHASE_OPEN)) != 0 && in_excess != 0) ||
        ((failed & (uint32_t)FAULT_BIT(FAULT_PHASE_SHORTED)) != 0 && (lacking & ~in_excess) != 0)) {
        failed = (uint32_t)FAULT_BIT(FAULT_CURRENT_SENSOR);
        monitor->phases |= in_excess | ((lacking & (lacking - 1u)) == 0 ? lacking : 0);
    }
    monitor->failed = input->run ? monitor->failed | failed : failed;
    return monitor->failed;
}
