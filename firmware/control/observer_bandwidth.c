#include "control/observer_bandwidth.h"

#include "fixed/divide.h"
#include "fixed/fixed.h"

#define LAST_STAGE (OBSERVER_BANDWIDTH_STAGES - 1)

/* 2^32 / 2 pi: 2^-32 turn a rad. 0.3 urad are what an ideal encoder leaves to the model: torque between the samples. */
#define UNITS_PER_RAD 683565276
#define THRESHOLD_IDEAL ((uint32_t)((int64_t)UNITS_PER_RAD * 3 / 10000000))
#define THRESHOLD_EDGE ((uint32_t)((int64_t)UNITS_PER_RAD * 8 / 1000000))

/* More than any innovation. */
#define THRESHOLD_NEVER UINT32_MAX

/* With the middle of a count of a coarse encoder the decay begins in stage 3, 0.54 of the widest. */
#define FIRST_STAGE_COARSE 3

/* The threshold is so many times the mean size of the innovation: of a uniform +-1/2 count that is one count, below
 * the least threshold. */
#define USUAL_FACTOR 4u
#define USUAL_1_S 40

/* A pause grows to 256 ms at most, and shrinks by e in 200 ms. */
#define PAUSE_LIMIT_Q16 (255u << 16)
#define PAUSE_GROWTH_Q16 (1u << 14)
#define FORGET_1_S 5

observer_bandwidth_parameters_t observer_bandwidth_configure(uint32_t widest_rad_s, uint32_t steady_rad_s,
                                                             unsigned encoder_bits, uint32_t control_rate_hz,
                                                             int32_t inertia_q30) {
    const uint32_t count = 1u << (32u - encoder_bits);
    const bool wakes = widest_rad_s > steady_rad_s;
    const uint32_t threshold_count = wakes ? count + count / 8 + THRESHOLD_IDEAL : THRESHOLD_NEVER;
    observer_bandwidth_parameters_t parameters = {
        .pause_ticks = control_rate_hz / 1000u,
        .forget_q32 = (65536u - (65536u * FORGET_1_S + control_rate_hz - 1) / control_rate_hz) << 16,
        .threshold_count = threshold_count,
        .threshold_edge = wakes ? THRESHOLD_EDGE : THRESHOLD_NEVER,
        .usual_share_q32 = (int32_t)fixed_divide((int64_t)USUAL_1_S << 32, control_rate_hz),
        .wakes = wakes,
        /* An encoder whose counts are finer than what an edge's time gives needs no edges. */
        .first_stage_count = threshold_count <= THRESHOLD_EDGE ? 0 : FIRST_STAGE_COARSE,
    };
    uint32_t bandwidth_q8 = widest_rad_s << 8;
    for (unsigned stage = 0; stage < OBSERVER_BANDWIDTH_STAGES; stage++) {
        const bool last = stage == LAST_STAGE || bandwidth_q8 >> 8 <= steady_rad_s;
        const uint32_t bandwidth_rad_s = last ? steady_rad_s : bandwidth_q8 >> 8;
        parameters.bandwidth_rad_s[stage] = (uint16_t)bandwidth_rad_s;
        parameters.gains[stage] = load_observer_gains(bandwidth_rad_s, control_rate_hz, inertia_q30);
        /* Where 3.5 / t is the middle of this bandwidth and the next: 1.1 of this stage's 3.5 / w. */
        parameters.end_ticks[stage] = control_rate_hz * 385u / 100u / bandwidth_rad_s;
        bandwidth_q8 = bandwidth_q8 / 16 * 13;
    }
    return parameters;
}

void observer_bandwidth_reset(observer_bandwidth_t *bandwidth) {
    *bandwidth = (observer_bandwidth_t){.stage = 0};
}

const load_observer_gains_t *observer_bandwidth_step(const observer_bandwidth_parameters_t *parameters,
                                                     observer_bandwidth_t *bandwidth, int32_t innovation,
                                                     bool from_edge) {
    if (!parameters->wakes) {
        return &parameters->gains[LAST_STAGE];
    }
    if (bandwidth->ticks < UINT32_MAX) {
        bandwidth->ticks++;
    }
    while (bandwidth->stage < LAST_STAGE && bandwidth->ticks >= parameters->end_ticks[bandwidth->stage]) {
        bandwidth->stage++;
    }
    const bool steady = bandwidth->stage == LAST_STAGE;
    const uint32_t least = from_edge ? parameters->threshold_edge : parameters->threshold_count;
    const int32_t mean = (int32_t)(bandwidth->usual_q32 >> 32); /* below 2^27, as every innovation */
    const uint32_t usual = (uint32_t)mean * USUAL_FACTOR;
    const uint32_t threshold = usual > least ? usual : least;
    const uint32_t size = (uint32_t)fixed_abs(innovation);
    if (steady) {
        /* What is beyond the threshold counts as the threshold: one load step does not make the observer deaf. */
        const int32_t held = (int32_t)(size < threshold ? size : threshold);
        bandwidth->usual_q32 = fixed_accumulate(bandwidth->usual_q32, held - mean, parameters->usual_share_q32);
    }
    bandwidth->pause_q16 = (uint32_t)(((uint64_t)bandwidth->pause_q16 * parameters->forget_q32) >> 32);
    if (size > threshold) {
        const uint32_t pause_ticks =
            parameters->pause_ticks + (uint32_t)(((uint64_t)parameters->pause_ticks * bandwidth->pause_q16) >> 16);
        if (bandwidth->ticks >= pause_ticks) {
            /* Out of the steady state it is a new event; within a decay it may be the rest of the last one. */
            const uint32_t growth_q16 = steady ? bandwidth->pause_q16 : bandwidth->pause_q16 / 4;
            const uint32_t longer_q16 = bandwidth->pause_q16 + growth_q16 + PAUSE_GROWTH_Q16;
            bandwidth->pause_q16 = longer_q16 < PAUSE_LIMIT_Q16 ? longer_q16 : PAUSE_LIMIT_Q16;
            bandwidth->stage = from_edge ? 0 : parameters->first_stage_count;
            bandwidth->ticks = 0;
        }
    }
    return &parameters->gains[bandwidth->stage];
}

bool observer_bandwidth_steady(const observer_bandwidth_parameters_t *parameters,
                               const observer_bandwidth_t *bandwidth) {
    return !parameters->wakes || bandwidth->stage == LAST_STAGE;
}
