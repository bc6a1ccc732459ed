/* [SR-28] */
#include "monitors/phase_balance.h"

#include "control/applied_flux.h"
#include "control/machine_tables.h"
#include "fixed/compiler.h"
#include "fixed/divide.h"
#include "fixed/fixed.h"

#define REVOLUTIONS 8u
#define SLOWEST_MS 100u

/* Windows in succession in which all ratios are small. */
#define SMALL_WINDOWS 2u

/* Part of a window for which a phase has to conduct: 1/10. */
#define CONDUCTING_PART 10u

/* Phases of which one that differs from all others is the wrong one. */
#define COMPARED_MIN 3u

/* Time without a zero of the current after which drift may be most of the integral, ms. */
#define RECENT_MS 10u

/* True of a phase that conducts above the currents whose errors are the converter's, for so short a time that a
 * warm winding and the error of the voltage are less than half of the flux linkage. */
static bool counts(const flux_residual_t *residual, const flux_residual_phase_t *phase) {
    const uint32_t recent = RECENT_MS * residual->sample.periods_per_ms;
    const uint32_t age = residual->sample.periods - phase->zero_at;
    if (!phase->known || age >= recent || phase->current_q9 <= machine_tables.current_range_q9 / 32) {
        return false;
    }
    const int32_t part_q29 = residual->sample.period_flux_q29 / 64;
    const int32_t voltage_q29 = residual->device_q29 > part_q29 ? residual->device_q29 : part_q29;
    const int64_t warm_q29 = applied_flux_warm_q29(&machine_tables, phase->drop_q29);
    return warm_q29 + fixed_product(voltage_q29, (int32_t)age) < phase->table_q29 / 2;
}

static void add(phase_balance_t *balance, const flux_residual_t *residual) {
    for (unsigned index = 0; index < residual->phases; index++) {
        const flux_residual_phase_t *phase = &residual->phase[index];
        phase_balance_phase_t *sums = &balance->phase[index];
        if (counts(residual, phase)) {
            const int32_t cold_q29 = applied_flux_cold_q29(phase->drop_q29);
            sums->flux_sum_q21 += (uint64_t)(fixed_non_negative(phase->voltage_q29) >> 8) * residual->elapsed;
            sums->cold_sum_q21 += (uint64_t)(cold_q29 >> 8) * residual->elapsed;
            sums->table_sum_q21 += (uint64_t)(phase->table_q29 >> 8) * residual->elapsed;
            sums->conducting += residual->elapsed;
        }
    }
}

static void begin(phase_balance_t *balance) {
    balance->turned = 0;
    balance->periods = 0;
    for (unsigned index = 0; index < HAL_PHASES_MAX; index++) {
        phase_balance_phase_t *phase = &balance->phase[index];
        phase->flux_sum_q21 = phase->cold_sum_q21 = phase->table_sum_q21 = 0;
        phase->conducting = 0;
    }
}

/* Ratio of a phase, of a cold winding or of one as its parameter says, Q8, 0..65535; 0 when it has hardly conducted. */
static uint32_t ratio_q8(const phase_balance_t *balance, unsigned index, bool cold) {
    const phase_balance_phase_t *phase = &balance->phase[index];
    if (phase->conducting < balance->periods / CONDUCTING_PART || phase->table_sum_q21 == 0) {
        return 0;
    }
    const uint64_t sum_q21 = phase->flux_sum_q21 + (cold ? phase->cold_sum_q21 : 0);
    const int64_t ratio = fixed_divide((int64_t)sum_q21 << 8, (int64_t)phase->table_sum_q21);
    return ratio < UINT16_MAX ? (uint32_t)ratio : UINT16_MAX;
}

/* More than 4/3 of the largest of the others, or less than 3/4 of the smallest. A lost phase has the ratio 0. */
static bool differs(const uint32_t *ratios_q8, unsigned phases, unsigned index) {
    uint32_t least_q8 = UINT32_MAX, most_q8 = 0;
    for (unsigned other = 0; other < phases; other++) {
        if (other != index && ratios_q8[other] > 0) {
            least_q8 = ratios_q8[other] < least_q8 ? ratios_q8[other] : least_q8;
            most_q8 = ratios_q8[other] > most_q8 ? ratios_q8[other] : most_q8;
        }
    }
    return ratios_q8[index] > 0 && (3u * ratios_q8[index] > 4u * most_q8 || 4u * ratios_q8[index] < 3u * least_q8);
}

/* At the end of a window. */
static void judge(phase_balance_t *balance, const flux_residual_t *residual, uint32_t least_q8) {
    const uint32_t lost_phases = residual->sample.lost_phases;
    const unsigned phases = residual->phases;
    uint32_t ratios_q8[HAL_PHASES_MAX] = {0};
    uint32_t judged = lost_phases;
    bool small = true;
    for (unsigned index = 0; index < phases; index++) {
        ratios_q8[index] = ratio_q8(balance, index, false);
        judged |= (uint32_t)(ratios_q8[index] > 0) << index;
        small &= ratio_q8(balance, index, true) < least_q8;
    }
    const bool all = judged == (1u << phases) - 1u;
    const bool comparable = all && phases - (lost_phases != 0) >= COMPARED_MIN;
    uint32_t unbalanced = 0;
    for (unsigned index = 0; index < phases; index++) {
        unbalanced |= (uint32_t)(comparable && differs(ratios_q8, phases, index)) << index;
    }
    balance->small_windows = all && small ? balance->small_windows + 1u : 0;
    balance->unbalanced |= unbalanced;
    balance->all_small |= unbalanced == 0 && balance->small_windows >= SMALL_WINDOWS;
}

COLD void phase_balance_step(phase_balance_t *balance, const flux_residual_t *residual, uint32_t least_q8,
                             flux_evidence_t *evidence) {
    if (!residual->sample.run) {
        *balance = (phase_balance_t){0};
        return;
    }
    add(balance, residual);
    balance->periods += residual->elapsed;
    balance->turned += (uint32_t)fixed_abs(residual->step);
    if (balance->turned >> 32 >= REVOLUTIONS) {
        if (balance->periods < REVOLUTIONS * SLOWEST_MS * residual->sample.periods_per_ms) {
            judge(balance, residual, least_q8);
        }
        begin(balance);
    }
    evidence->unbalanced = balance->unbalanced;
    evidence->all_small = balance->all_small;
}
