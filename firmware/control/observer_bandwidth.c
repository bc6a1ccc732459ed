#include "control/observer_bandwidth.h"

#include "fixed/divide.h"
#include "fixed/fixed.h"

#define LAST_STAGE (OBSERVER_BANDWIDTH_STAGES - 1)

/* 2^32 / 2 pi: 2^-32 rev per rad. With an ideal encoder the innovation is still up to 0.3 urad: the model does not know
 * the torque between the samples. */
#define UNITS_PER_RAD 683565276
#define THRESHOLD_IDEAL ((uint32_t)((int64_t)UNITS_PER_RAD * 3 / 10000000))
#define THRESHOLD_EDGE ((uint32_t)((int64_t)UNITS_PER_RAD * 8 / 1000000))

/* Above any innovation. */
#define THRESHOLD_NEVER UINT32_MAX

/* Angles from the middle of a count are noisier: their decay begins in stage 3, at 0.54 of the transient bandwidth. */
#define TRIGGER_STAGE_COARSE 3

/* Ratio of threshold and mean magnitude of the innovation. Quantisation, uniform over +-1/2 count, has a mean of 1/4
 * count and so a threshold of one count, below the fixed one. Low-pass bandwidth of the mean in 1/s. */
#define MEAN_INNOVATION_FACTOR 4u
#define MEAN_INNOVATION_1_S 40

/* Extension of the hold-off: at most 255 minimum hold-offs, at threshold_min 1/4 per trigger, time constant 200 ms. */
#define HOLDOFF_EXTENSION_MAX_Q16 (255u << 16)
#define HOLDOFF_INCREMENT_Q16 (1u << 14)
#define HOLDOFF_DECAY_1_S 5

observer_bandwidth_parameters_t observer_bandwidth_configure(uint32_t transient_rad_s, uint32_t steady_rad_s,
                                                             unsigned encoder_bits, uint32_t control_rate_hz,
                                                             int32_t inertia_q30) {
    const uint32_t count = 1u << (32u - encoder_bits);
    const bool adaptive = transient_rad_s > steady_rad_s;
    const uint32_t threshold_count = adaptive ? count + count / 8 + THRESHOLD_IDEAL : THRESHOLD_NEVER;
    observer_bandwidth_parameters_t parameters = {
        .retrigger_holdoff_ticks = control_rate_hz / 1000u,
        .holdoff_decay_q32 = (65536u - (65536u * HOLDOFF_DECAY_1_S + control_rate_hz - 1) / control_rate_hz) << 16,
        .threshold_count = threshold_count,
        .threshold_edge = adaptive ? THRESHOLD_EDGE : THRESHOLD_NEVER,
        .mean_innovation_gain_q32 = (int32_t)fixed_divide((int64_t)MEAN_INNOVATION_1_S << 32, control_rate_hz),
        .adaptive = adaptive,
        /* Counts finer than the resolution of an edge's time are as good as edges. */
        .trigger_stage_count = threshold_count <= THRESHOLD_EDGE ? 0 : TRIGGER_STAGE_COARSE,
    };
    uint32_t bandwidth_q8 = transient_rad_s << 8;
    for (unsigned stage = 0; stage < OBSERVER_BANDWIDTH_STAGES; stage++) {
        const bool last = stage == LAST_STAGE || bandwidth_q8 >> 8 <= steady_rad_s;
        const uint32_t bandwidth_rad_s = last ? steady_rad_s : bandwidth_q8 >> 8;
        parameters.bandwidth_rad_s[stage] = (uint16_t)bandwidth_rad_s;
        parameters.gains[stage] = load_observer_gains(bandwidth_rad_s, control_rate_hz, inertia_q30);
        /* 3.5 / t is then midway between the bandwidths of this stage and the next: t = 1.1 * 3.5 / w0. */
        parameters.end_ticks[stage] = control_rate_hz * 385u / 100u / bandwidth_rad_s;
        bandwidth_q8 = bandwidth_q8 / 16 * 13;
    }
    return parameters;
}

void observer_bandwidth_reset(observer_bandwidth_t *bandwidth) {
    *bandwidth = (observer_bandwidth_t){.stage = 0};
}

static uint32_t threshold_of(const observer_bandwidth_parameters_t *parameters, uint32_t threshold_mean,
                             bool from_edge) {
    const uint32_t threshold_min = from_edge ? parameters->threshold_edge : parameters->threshold_count;
    return threshold_mean > threshold_min ? threshold_mean : threshold_min;
}

static uint32_t threshold_of_mean(const observer_bandwidth_statistics_t *statistics) {
    const uint32_t mean = (uint32_t)(statistics->mean_innovation_q32 >> 32); /* below 2^27, as any innovation */
    return mean * MEAN_INNOVATION_FACTOR;
}

static unsigned adaptive_stage(const observer_bandwidth_parameters_t *parameters, observer_bandwidth_t *bandwidth,
                               const observer_bandwidth_limits_t *limits, int32_t innovation, bool from_edge) {
    if (bandwidth->ticks < UINT32_MAX) {
        bandwidth->ticks++;
    }
    /* One stage a sample: the ends of stages are further apart, but for those that already have the steady bandwidth.
     */
    if (bandwidth->stage < LAST_STAGE && bandwidth->ticks >= parameters->end_ticks[bandwidth->stage]) {
        bandwidth->stage++;
    }
    if ((uint32_t)fixed_abs(innovation) > threshold_of(parameters, limits->threshold_mean, from_edge) &&
        bandwidth->ticks >= parameters->retrigger_holdoff_ticks + limits->holdoff_extension_ticks) {
        bandwidth->trigger =
            bandwidth->stage == LAST_STAGE ? OBSERVER_TRIGGER_IN_STEADY_STATE : OBSERVER_TRIGGER_IN_DECAY;
        bandwidth->stage = from_edge ? 0 : parameters->trigger_stage_count;
        bandwidth->ticks = 0;
    }
    return bandwidth->stage;
}

const load_observer_gains_t *observer_bandwidth_step(const observer_bandwidth_parameters_t *parameters,
                                                     observer_bandwidth_t *bandwidth,
                                                     const observer_bandwidth_limits_t *limits, int32_t innovation,
                                                     bool from_edge) {
    const unsigned stage =
        parameters->adaptive ? adaptive_stage(parameters, bandwidth, limits, innovation, from_edge) : LAST_STAGE;
    return &parameters->gains[stage];
}

observer_bandwidth_limits_t observer_bandwidth_update(const observer_bandwidth_parameters_t *parameters,
                                                      observer_bandwidth_statistics_t *statistics,
                                                      const observer_bandwidth_sample_t *sample) {
    const bool triggered_steady = sample->trigger == OBSERVER_TRIGGER_IN_STEADY_STATE;
    const bool was_steady = sample->trigger == OBSERVER_TRIGGER_NONE ? sample->stage == LAST_STAGE : triggered_steady;
    if (was_steady) {
        /* Innovations are clipped at the threshold, so that a load step does not raise it. */
        const uint32_t threshold = threshold_of(parameters, threshold_of_mean(statistics), sample->from_edge);
        const uint32_t magnitude = (uint32_t)fixed_abs(sample->innovation);
        const int32_t clipped = (int32_t)(magnitude < threshold ? magnitude : threshold);
        const int32_t mean = (int32_t)(statistics->mean_innovation_q32 >> 32);
        statistics->mean_innovation_q32 =
            fixed_accumulate(statistics->mean_innovation_q32, clipped - mean, parameters->mean_innovation_gain_q32);
    }
    if (sample->trigger != OBSERVER_TRIGGER_NONE) {
        const uint32_t growth_q16 =
            triggered_steady ? statistics->holdoff_extension_q16 : statistics->holdoff_extension_q16 / 4;
        const uint32_t extension_q16 = statistics->holdoff_extension_q16 + growth_q16 + HOLDOFF_INCREMENT_Q16;
        statistics->holdoff_extension_q16 =
            extension_q16 < HOLDOFF_EXTENSION_MAX_Q16 ? extension_q16 : HOLDOFF_EXTENSION_MAX_Q16;
    }
    statistics->holdoff_extension_q16 =
        (uint32_t)(((uint64_t)statistics->holdoff_extension_q16 * parameters->holdoff_decay_q32) >> 32);
    return (observer_bandwidth_limits_t){
        .threshold_mean = threshold_of_mean(statistics),
        .holdoff_extension_ticks =
            (uint32_t)(((uint64_t)parameters->retrigger_holdoff_ticks * statistics->holdoff_extension_q16) >> 16),
    };
}

bool observer_bandwidth_steady(const observer_bandwidth_parameters_t *parameters, unsigned stage) {
    return !parameters->adaptive || stage == LAST_STAGE;
}
