#include "monitors/phase_balance.h"

#include "fixed/compiler.h"
#include "fixed/divide.h"
#include "storage/fault.h"

#define REVOLUTIONS 8u
#define SLOWEST_MS 100u

/* Windows in succession in which the encoder is ahead. */
#define AHEAD_WINDOWS 2u

/* Part of a window for which a phase has to conduct: 1/10. */
#define CONDUCTING_PART 10u

/* Phases of which one that differs from all others is the wrong one. */
#define COMPARED_MIN 3u

static void add(phase_balance_t *balance, const phase_balance_sample_t *sample) {
    for (unsigned index = 0; index < sample->phases; index++) {
        phase_balance_phase_t *phase = &balance->phase[index];
        if (sample->known[index]) {
            const int32_t flux_q29 = sample->flux_q29[index];
            phase->flux_sum_q21 += (uint64_t)((flux_q29 > 0 ? flux_q29 : 0) >> 8) * sample->elapsed;
            phase->cold_sum_q21 += (uint64_t)(sample->cold_q29[index] >> 8) * sample->elapsed;
            phase->table_sum_q21 += (uint64_t)(sample->table_q29[index] >> 8) * sample->elapsed;
            phase->conducting += sample->elapsed;
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
static void judge(phase_balance_t *balance, const phase_balance_sample_t *sample) {
    const unsigned phases = sample->phases;
    uint32_t ratios_q8[HAL_PHASES_MAX] = {0};
    uint32_t judged = sample->lost;
    bool ahead = true;
    for (unsigned index = 0; index < phases; index++) {
        ratios_q8[index] = ratio_q8(balance, index, false);
        judged |= (uint32_t)(ratios_q8[index] > 0) << index;
        ahead &= ratio_q8(balance, index, true) < sample->least_q8;
    }
    const bool all = judged == (1u << phases) - 1u;
    const bool comparable = all && phases - (sample->lost != 0) >= COMPARED_MIN;
    uint32_t failed = 0;
    for (unsigned index = 0; index < phases; index++) {
        failed |= (uint32_t)(comparable && differs(ratios_q8, phases, index)) << index;
    }
    balance->ahead_windows = all && ahead ? balance->ahead_windows + 1u : 0;
    balance->phases |= failed;
    if (failed != 0) {
        balance->fault_mask |= (uint32_t)FAULT_BIT(FAULT_CURRENT_SENSOR);
    } else if (balance->ahead_windows >= AHEAD_WINDOWS) {
        balance->fault_mask |= (uint32_t)FAULT_BIT(FAULT_ENCODER_ANGLE);
    }
}

COLD uint32_t phase_balance_step(phase_balance_t *balance, const phase_balance_sample_t *sample) {
    if (!sample->run) {
        *balance = (phase_balance_t){0};
        return 0;
    }
    add(balance, sample);
    balance->periods += sample->elapsed;
    balance->turned += sample->step;
    if (balance->turned >> 32 < REVOLUTIONS) {
        return balance->fault_mask;
    }
    if (balance->periods < REVOLUTIONS * SLOWEST_MS * sample->periods_per_ms) {
        judge(balance, sample);
    }
    begin(balance);
    return balance->fault_mask;
}
