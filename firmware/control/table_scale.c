#include "control/table_scale.h"

#include "fixed/compiler.h"
#include "fixed/divide.h"
#include "fixed/fixed.h"

/* Sums of (1) and (2) forget a sixteenth with each interval. */
#define FORGET_BITS 4

/* Coarser sums, so that sixteen intervals of the largest current for half a second fit. */
#define ENERGY_COARSER 9
#define SQUARE_COARSER 8
#define CHARGE_COARSER 9
#define FLUX_COARSER 8

/* Values to divide are scaled below 2^SCALED_BITS. */
#define SCALED_BITS 30

/* Least work of an interval, part of its largest current times its largest flux linkage: of less, as of a phase that
 * drives and brakes in turn, the ratio says little. */
#define WORK_SHIFT 4

/* Largest flux linkage of a sample for (1), part of the largest one: with more it is hardly another equation than (2).
 */
#define END_SHIFT 2

static int32_t multiply_q30(int32_t value, int32_t factor_q30) {
    return fixed_multiply(value, factor_q30, 30);
}

COLD void table_scale_reset(table_scale_t *scale) {
    *scale = (table_scale_t){
        .scale_q30 = TABLE_SCALE_ONE_Q30, .smooth_q30 = TABLE_SCALE_ONE_Q30, .smooth_complement = ~TABLE_SCALE_ONE_Q30};
}

COLD table_scale_factors_t table_scale_factors(int32_t scale_q30, int32_t period_q40,
                                               const flux_observer_parameters_t *flux) {
    const int32_t inverse_q30 = fixed_saturate(fixed_divide((INT64_C(1) << 60) + scale_q30 / 2, scale_q30));
    return (table_scale_factors_t){
        .excess_q31 = 2 * (scale_q30 - TABLE_SCALE_ONE_Q30),
        .inverse_excess_q31 = 2 * (inverse_q30 - TABLE_SCALE_ONE_Q30),
        .period_q40 = multiply_q30(period_q40, inverse_q30),
        .flux = {.gain_q30 = flux->gain_q30,
                 .resistance_period_q40 = multiply_q30(flux->resistance_period_q40, inverse_q30)},
    };
}

static uint64_t magnitude(int64_t value) {
    return value < 0 ? 0 - (uint64_t)value : (uint64_t)value;
}

/* Weighted flux linkage over weighted charge, as a resistance times Ts, ohm s, Q-9.40; 0 before the first interval. */
static int32_t resistance_q40(int64_t flux, int64_t charge) {
    const unsigned shift = fixed_shift_below((uint64_t)charge, SCALED_BITS);
    const int64_t scaled = fixed_clamp_64(flux >> shift, -(INT64_C(1) << 42), INT64_C(1) << 42);
    return fixed_saturate(fixed_divide(scaled * (1 << 20), (charge >> shift) + 1));
}

/* s and R - R0 from the sums, unless these do not tell. */
static void solve(table_scale_t *scale) {
    const int32_t by_voltage_q40 = resistance_q40(scale->end, scale->charge);
    const int32_t by_table_q40 = resistance_q40(scale->end_table, scale->charge);
    const uint64_t magnitudes =
        magnitude(scale->applied_q30) | magnitude(scale->table_q30) | magnitude(scale->square_q10);
    const unsigned shift = fixed_shift_below(magnitudes, SCALED_BITS);
    /* Q10 Q40 to Q30. */
    const int32_t square = (int32_t)(scale->square_q10 >> shift);
    const int64_t applied = (scale->applied_q30 >> shift) - (fixed_product(square, by_voltage_q40) >> 20);
    const int64_t table = (scale->table_q30 >> shift) - (fixed_product(square, by_table_q40) >> 20);
    if (table <= scale->table_q30 >> shift >> 1 || applied <= 0 || applied >> 32 != 0) {
        return;
    }
    const int32_t found_q30 = fixed_saturate(fixed_divide(applied << 30, table));
    scale->scale_q30 = fixed_clamp(found_q30, TABLE_SCALE_MIN_Q30, TABLE_SCALE_MAX_Q30);
    const int32_t difference_q30 = fixed_abs(scale->scale_q30 - TABLE_SCALE_ONE_Q30);
    scale->differs = difference_q30 > (scale->differs ? TABLE_SCALE_ONE_Q30 / 80 : TABLE_SCALE_ONE_Q30 / 40);
    scale->resistance_q40 = fixed_subtract(by_voltage_q40, multiply_q30(by_table_q40, scale->scale_q30));
}

static void add_to(int64_t *sum, int64_t value) {
    *sum += value - (*sum >> FORGET_BITS);
}

/* Ends the interval of a phase. */
static void end(table_scale_t *scale, const table_scale_phase_t *phase, int32_t least_q9) {
    const int64_t most_q39 = fixed_product(phase->most_q9, phase->most_q29) * 2;
    if (phase->most_q9 < least_q9 || magnitude(phase->table_q39) < (uint64_t)(most_q39 >> WORK_SHIFT)) {
        return;
    }
    const int64_t sign = phase->table_q39 < 0 ? -1 : 1;
    add_to(&scale->applied_q30, sign * (phase->applied_q39 >> ENERGY_COARSER));
    add_to(&scale->table_q30, sign * (phase->table_q39 >> ENERGY_COARSER));
    add_to(&scale->square_q10, sign * (phase->square_q18 >> SQUARE_COARSER));
    if (phase->tail_charge > 0) {
        add_to(&scale->end, phase->tail);
        add_to(&scale->end_table, phase->tail_table);
        add_to(&scale->charge, phase->tail_charge);
    }
    if (scale->intervals < TABLE_SCALE_INTERVALS_MIN) {
        scale->intervals++;
    }
    if (scale->intervals >= TABLE_SCALE_INTERVALS_MIN) {
        solve(scale);
    }
}

/* Memory of the readings without a current: 2^8. */
#define REST_BITS 8

/* Longest interval: half a second at 100 kHz of the largest current. */
#define CHARGE_MAX_Q10 (INT64_C(1) << 40)

/* Mean square of a current that changes linearly, A^2, Q18, within 8 LSB: a third of below 2^34, without a division of
 * 64 bits. */
static int64_t mean_square_q18(int32_t before_q9, int32_t now_q9) {
    const int32_t third_q32 = 0x55555556;
    const int64_t sum_q9 = (int64_t)before_q9 + now_q9;
    const int64_t square_q18 = sum_q9 * sum_q9 - (int64_t)before_q9 * now_q9;
    return 8 * (int64_t)fixed_multiply_high((int32_t)(square_q18 >> 3), third_q32);
}

/* Trapezoidal rule. */
static void integrate(table_scale_phase_t *phase, const table_scale_sample_t *sample) {
    const int32_t before_q9 = phase->current_q9, now_q9 = sample->current_q9;
    const int32_t twice_q9 = before_q9 + now_q9;
    /* Drops are there with the current: from about the middle of the interval in which it begins. */
    phase->drops_q29 = fixed_add(phase->drops_q29, before_q9 > 0 ? sample->drop_q29 : sample->drop_q29 / 2);
    const int32_t flux_q29 = fixed_subtract(fixed_subtract(sample->flux_q29, phase->corrections_q29), phase->drops_q29);
    const int64_t periods = sample->periods;
    phase->applied_q39 += fixed_product(twice_q9, fixed_subtract(flux_q29, phase->flux_q29));
    phase->table_q39 += fixed_product(twice_q9, fixed_subtract(sample->table_q29, phase->table_q29));
    phase->charge_q10 += twice_q9 * periods;
    phase->square_q18 += mean_square_q18(before_q9, now_q9) * periods;
    phase->current_q9 = now_q9;
    phase->flux_q29 = flux_q29;
    phase->table_q29 = sample->table_q29;
    phase->most_q9 = fixed_max(now_q9, phase->most_q9);
    phase->most_q29 = fixed_max(sample->table_q29, phase->most_q29);
}

/* Reading of the sensor without a current: the least of the last readings, of which noise makes none larger. */
static int32_t rest_q17(const table_scale_phase_t *phase, int32_t current_q9) {
    const int32_t now_q17 = current_q9 * (1 << REST_BITS);
    return now_q17 < phase->rest_q17 ? now_q17 : phase->rest_q17 + ((now_q17 - phase->rest_q17) >> REST_BITS);
}

/* Adds a sample near the end of the interval to (1). There flux linkage and current are in proportion, so that what a
 * sensor reads without a current can be taken away from both. */
static void close(table_scale_phase_t *phase, const table_scale_sample_t *sample) {
    const int32_t current_q9 = sample->current_q9, rest_q9 = phase->rest_q17 >> REST_BITS;
    const int32_t limit_q29 = phase->most_q29 >> END_SHIFT;
    if (current_q9 <= rest_q9 || phase->table_q29 >= limit_q29) {
        return;
    }
    const int32_t charge = (int32_t)(phase->charge_q10 >> CHARGE_COARSER);
    const int32_t weight_q8 = (limit_q29 - phase->table_q29) / ((limit_q29 >> 8) + 1);
    const int32_t weighted = (int32_t)((int64_t)charge * weight_q8 >> 8);
    const int64_t table_q38 = fixed_product(phase->table_q29 >> FLUX_COARSER, current_q9 - rest_q9);
    phase->tail += fixed_product(weighted, phase->flux_q29 >> FLUX_COARSER);
    phase->tail_table += fixed_product(weighted, (int32_t)fixed_divide(table_q38, current_q9));
    phase->tail_charge += fixed_product(weighted, charge);
}

COLD void table_scale_add(table_scale_t *scale, unsigned index, const table_scale_sample_t *sample, int32_t least_q9) {
    table_scale_phase_t *phase = &scale->phase[index];
    if (sample->zero) {
        if (phase->whole) {
            end(scale, phase, least_q9);
        }
        *phase = (table_scale_phase_t){.whole = true, .rest_q17 = rest_q17(phase, sample->current_q9)};
        return;
    }
    phase->whole = phase->whole && !sample->lost && phase->charge_q10 < CHARGE_MAX_Q10;
    if (!phase->whole) {
        return;
    }
    phase->ended = phase->ended || (sample->none && phase->current_q9 > sample->current_q9);
    if (!phase->ended) {
        integrate(phase, sample);
        close(phase, sample);
    }
    phase->corrections_q29 = fixed_add(phase->corrections_q29, sample->correction_q29);
}

COLD void table_scale_follow(table_scale_t *scale, int32_t factor_q30, int32_t part_q31) {
    const bool differs = scale->differs || factor_q30 != TABLE_SCALE_ONE_Q30;
    const int32_t found_q30 = differs ? scale->scale_q30 : TABLE_SCALE_ONE_Q30;
    const int32_t target_q30 =
        fixed_clamp(multiply_q30(found_q30, factor_q30), TABLE_SCALE_MIN_Q30, TABLE_SCALE_MAX_Q30);
    const bool intact = scale->smooth_q30 == ~scale->smooth_complement;
    const int32_t smooth_q30 = intact ? scale->smooth_q30 : TABLE_SCALE_ONE_Q30;
    scale->smooth_q30 = smooth_q30 + fixed_multiply(fixed_subtract(target_q30, smooth_q30), part_q31, 31);
    scale->smooth_complement = ~scale->smooth_q30;
    scale->smooth_resistance_q40 +=
        fixed_multiply(fixed_subtract(scale->resistance_q40, scale->smooth_resistance_q40), part_q31 / 4, 31);
}
