#include "control/observer_bandwidth.h"

#include "control/machine_tables.h"
#include "fixed/divide.h"
#include "fixed/fixed.h"

#define LAST_STAGE (OBSERVER_BANDWIDTH_STAGES - 1)
#define STEADY_STAGE OBSERVER_BANDWIDTH_STEADY_STAGE

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

/* One count as torque, J w0^2 2 pi / 2^bits, at most 5/8, 1/6 and 1/20 of the drive's largest torque. */
#define TRIGGER_SHARE 10
#define MOVING_SHARE 40
#define STEADY_SHARE 128
#define STEADY_MIN_RAD_S 100u

/* 2 pi 512; a beat's rounding is a count by this. */
#define BEAT_SHARE 3217
#define BEAT_PARTS 24u

/* Edges are frequent from one each 100 us on. */
#define EDGE_RATE_MIN_HZ 10000u

/* T 2^bits / J in rad/s^2: 2 pi times the square of the bandwidth at which a count is worth the torque T. */
static uint64_t square_of_count(const observer_bandwidth_settings_t *settings) {
    return (uint64_t)load_observer_acceleration(settings->torque_max_q24, settings->inertia_q30)
           << (settings->encoder_bits + machine_tables.speed_exponent); /* below 2^(19 + 32 + 3) */
}

static bool within(uint32_t bandwidth_rad_s, uint64_t square, unsigned share) {
    return (uint64_t)bandwidth_rad_s * bandwidth_rad_s * share <= square;
}

static uint32_t limited_steady_rad_s(uint32_t steady_rad_s, uint64_t square) {
    uint32_t limited_rad_s = steady_rad_s;
    while (limited_rad_s > STEADY_MIN_RAD_S && !within(limited_rad_s, square, STEADY_SHARE)) {
        limited_rad_s--;
    }
    return limited_rad_s;
}

/* First stage from `first` on whose bandwidth is neither above a maximum nor worth more than a share of the torque. */
static uint8_t first_stage(const observer_bandwidth_parameters_t *parameters, unsigned first, uint32_t max_rad_s,
                           uint64_t square, unsigned share) {
    unsigned stage = first;
    while (stage < STEADY_STAGE && (parameters->stage[stage].bandwidth_rad_s > max_rad_s ||
                                    !within(parameters->stage[stage].bandwidth_rad_s, square, share))) {
        stage++;
    }
    return (uint8_t)stage;
}

/* Narrowest one at which a count is worth the share of the torque. */
static uint32_t beat_rad_s(uint32_t steady_rad_s, uint64_t square) {
    uint32_t bandwidth_rad_s = steady_rad_s;
    while (bandwidth_rad_s > STEADY_MIN_RAD_S && !within(bandwidth_rad_s - 1, square, BEAT_SHARE)) {
        bandwidth_rad_s--;
    }
    return bandwidth_rad_s;
}

static void configure_stages(const observer_bandwidth_settings_t *settings, observer_bandwidth_parameters_t *parameters,
                             uint32_t steady_rad_s, uint32_t last_rad_s) {
    uint32_t bandwidth_q8 = settings->transient_rad_s << 8;
    for (unsigned stage = 0; stage < OBSERVER_BANDWIDTH_STAGES; stage++) {
        const bool steady = stage >= STEADY_STAGE || bandwidth_q8 >> 8 <= steady_rad_s;
        const uint32_t decayed_rad_s = steady ? steady_rad_s : bandwidth_q8 >> 8;
        const uint32_t bandwidth_rad_s = stage == LAST_STAGE ? last_rad_s : decayed_rad_s;
        parameters->stage[stage] = (observer_bandwidth_stage_t){
            .gains = load_observer_gains(bandwidth_rad_s, settings->control_rate_hz, settings->inertia_q30),
            .bandwidth_rad_s = bandwidth_rad_s,
            /* 5 / t is then midway between the bandwidths of this stage and the next: t = 1.1 * 5 / w0. */
            .end_ticks = settings->control_rate_hz * 550u / 100u / bandwidth_rad_s,
        };
        bandwidth_q8 = bandwidth_q8 / 16 * 13;
    }
    parameters->stage[STEADY_STAGE].end_ticks = parameters->stage[LAST_STAGE].end_ticks; /* one step, however far */
}

observer_bandwidth_parameters_t observer_bandwidth_configure(const observer_bandwidth_settings_t *settings) {
    const uint32_t rate_hz = settings->control_rate_hz;
    const uint32_t count = 1u << (32u - settings->encoder_bits);
    const bool adaptive = settings->transient_rad_s > settings->steady_rad_s;
    const uint32_t threshold_count = adaptive ? count + count / 8 + THRESHOLD_IDEAL : THRESHOLD_NEVER;
    observer_bandwidth_parameters_t parameters = {
        .schedule = {
            .retrigger_holdoff_ticks = rate_hz / 1000u,
            .holdoff_decay_q32 = (65536u - (65536u * HOLDOFF_DECAY_1_S + rate_hz - 1) / rate_hz) << 16,
            .threshold_count = threshold_count,
            .threshold_edge = adaptive ? THRESHOLD_EDGE : THRESHOLD_NEVER,
            .mean_innovation_gain_q32 = (int32_t)fixed_divide((int64_t)MEAN_INNOVATION_1_S << 32, rate_hz),
            .threshold_error = 3u * count / 8u,
            .beat_step_min = count / 2,
            .beat_rounding_min_q4 = 16u * count / BEAT_PARTS,
            .edge_step_min = count / (rate_hz / EDGE_RATE_MIN_HZ),
            .adaptive = adaptive,
            .trigger_stage_count = LAST_STAGE,
            .moving_stage = LAST_STAGE,
            .steady_stage_edge = LAST_STAGE,
        }};
    if (!adaptive) {
        configure_stages(settings, &parameters, settings->steady_rad_s, settings->steady_rad_s);
        return parameters;
    }
    const uint64_t square = square_of_count(settings);
    const uint32_t steady_rad_s = limited_steady_rad_s(settings->steady_rad_s, square);
    configure_stages(settings, &parameters, steady_rad_s, beat_rad_s(steady_rad_s, square));
    /* Counts finer than the resolution of an edge's time are as good as edges. */
    const unsigned first = threshold_count <= THRESHOLD_EDGE ? 0 : TRIGGER_STAGE_COARSE;
    const uint8_t trigger_stage = first_stage(&parameters, first, settings->transient_rad_s, square, TRIGGER_SHARE);
    parameters.schedule.trigger_stage_count = trigger_stage;
    parameters.schedule.moving_stage =
        first_stage(&parameters, trigger_stage, settings->moving_rad_s, square, MOVING_SHARE);
    parameters.schedule.steady_stage_edge = STEADY_STAGE - (steady_rad_s < settings->steady_rad_s);
    return parameters;
}

void observer_bandwidth_reset(observer_bandwidth_t *bandwidth) {
    *bandwidth = (observer_bandwidth_t){.stage = 0};
}

static uint32_t threshold_of(const observer_bandwidth_schedule_t *schedule, uint32_t threshold_mean, bool from_edge) {
    const uint32_t threshold_min = from_edge ? schedule->threshold_edge : schedule->threshold_count;
    return fixed_max_u32(threshold_mean, threshold_min);
}

static uint32_t threshold_of_mean(const observer_bandwidth_statistics_t *statistics) {
    const uint32_t mean = (uint32_t)(statistics->mean_innovation_q32 >> 32); /* below 2^27, as any innovation */
    return mean * MEAN_INNOVATION_FACTOR;
}

static unsigned adaptive_stage(const observer_bandwidth_parameters_t *parameters, observer_bandwidth_t *bandwidth,
                               const observer_bandwidth_limits_t *limits, int32_t innovation, const bool *edge) {
    const bool from_edge = *edge;
    bandwidth->ticks = (uint32_t)fixed_add((int32_t)bandwidth->ticks, 1);
    /* One stage a sample: the ends of stages are further apart, but for those that already have the steady bandwidth.
     */
    const unsigned next =
        bandwidth->stage + (bandwidth->ticks >= observer_bandwidth_stage(parameters, bandwidth->stage)->end_ticks);
    const unsigned last = LAST_STAGE - limits->withheld_stages;
    bandwidth->stage = fixed_min_u32(next, last);
    if (fixed_magnitude(innovation) > threshold_of(&parameters->schedule, limits->threshold_mean, from_edge) &&
        bandwidth->ticks >= limits->holdoff_ticks) {
        bandwidth->trigger = bandwidth->stage >= parameters->schedule.steady_stage_edge
                                 ? OBSERVER_TRIGGER_IN_STEADY_STATE
                                 : OBSERVER_TRIGGER_IN_DECAY;
        bandwidth->stage = from_edge ? limits->trigger_stage_edge : parameters->schedule.trigger_stage_count;
        bandwidth->ticks = 0;
    }
    return bandwidth->stage;
}

const load_observer_gains_t *observer_bandwidth_step(const observer_bandwidth_parameters_t *parameters,
                                                     observer_bandwidth_t *bandwidth,
                                                     const observer_bandwidth_limits_t *limits, int32_t innovation,
                                                     const bool *from_edge) {
    const unsigned stage = parameters->schedule.adaptive
                               ? adaptive_stage(parameters, bandwidth, limits, innovation, from_edge)
                               : LAST_STAGE;
    return &observer_bandwidth_stage(parameters, stage)->gains;
}

void observer_bandwidth_update(const observer_bandwidth_schedule_t *schedule,
                               observer_bandwidth_statistics_t *statistics, const observer_bandwidth_sample_t *sample,
                               uint32_t angle_step, uint32_t rounding_q4, uint32_t withheld_stages,
                               observer_bandwidth_limits_t *limits) {
    const bool triggered_steady = sample->trigger == OBSERVER_TRIGGER_IN_STEADY_STATE;
    const bool was_steady =
        sample->trigger == OBSERVER_TRIGGER_NONE ? sample->stage >= schedule->steady_stage_edge : triggered_steady;
    if (was_steady) {
        /* Innovations are clipped at the threshold, so that a load step does not raise it. */
        const uint32_t threshold = threshold_of(schedule, threshold_of_mean(statistics), sample->from_edge);
        const uint32_t magnitude = fixed_magnitude(sample->innovation);
        const int32_t clipped = (int32_t)fixed_min_u32(magnitude, threshold);
        const int32_t mean = (int32_t)(statistics->mean_innovation_q32 >> 32);
        statistics->mean_innovation_q32 =
            fixed_accumulate(statistics->mean_innovation_q32, clipped - mean, schedule->mean_innovation_gain_q32);
    }
    if (sample->trigger != OBSERVER_TRIGGER_NONE) {
        const uint32_t growth_q16 =
            triggered_steady ? statistics->holdoff_extension_q16 : statistics->holdoff_extension_q16 / 4;
        const uint32_t extension_q16 = statistics->holdoff_extension_q16 + growth_q16 + HOLDOFF_INCREMENT_Q16;
        statistics->holdoff_extension_q16 = fixed_min_u32(extension_q16, HOLDOFF_EXTENSION_MAX_Q16);
    }
    statistics->holdoff_extension_q16 =
        (uint32_t)(((uint64_t)statistics->holdoff_extension_q16 * schedule->holdoff_decay_q32) >> 32);
    const bool frequent_edges = sample->from_edge && angle_step >= schedule->edge_step_min;
    const bool beat =
        !sample->from_edge && rounding_q4 >= schedule->beat_rounding_min_q4 && angle_step >= schedule->beat_step_min;
    const uint32_t withheld_min = frequent_edges ? LAST_STAGE - schedule->steady_stage_edge : !beat;
    const uint32_t threshold_beat = beat ? rounding_q4 / 8 + schedule->threshold_error : 0;
    const uint32_t threshold_mean = threshold_of(schedule, threshold_of_mean(statistics), frequent_edges);
    limits->threshold_mean = fixed_max_u32(threshold_mean, threshold_beat);
    limits->withheld_stages = (uint8_t)fixed_max_u32(withheld_stages, withheld_min);
    limits->trigger_stage_edge = frequent_edges ? 0 : schedule->trigger_stage_count;
    limits->holdoff_ticks =
        schedule->retrigger_holdoff_ticks +
        (uint32_t)(((uint64_t)(schedule->retrigger_holdoff_ticks << 16) * statistics->holdoff_extension_q16) >> 32);
}
