// Bandwidth scheduling of the load observer: decay, triggers and hold-off, against its reference model.
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/observer_bandwidth.h"
}

#include "support/reference_builders.h"

namespace {

using namespace fixed_point;
constexpr uint32_t TRANSIENT_RAD_S = 9000, MOVING_RAD_S = 1800, STEADY_RAD_S = 250;
constexpr double TORQUE_MAX_NM = 19.1, INERTIA = 0.02;
constexpr unsigned ENCODER_BITS = 17;
constexpr int32_t COUNT = 1 << (32 - ENCODER_BITS);
constexpr uint32_t RATE_HZ = 40000;
const int32_t INERTIA_Q30 = to_fixed(INERTIA, Q30);
constexpr unsigned LAST_STAGE = OBSERVER_BANDWIDTH_STAGES - 1;
constexpr unsigned STEADY_STAGE = OBSERVER_BANDWIDTH_STEADY_STAGE;

observer_bandwidth_parameters_t configure(uint32_t transient_rad_s = TRANSIENT_RAD_S, uint32_t rate_hz = RATE_HZ,
                                          unsigned encoder_bits = ENCODER_BITS) {
    const observer_bandwidth_settings_t settings = {
        .transient_rad_s = transient_rad_s,
        .moving_rad_s = MOVING_RAD_S,
        .steady_rad_s = STEADY_RAD_S,
        .encoder_bits = encoder_bits,
        .control_rate_hz = rate_hz,
        .inertia_q30 = INERTIA_Q30,
        .torque_max_q24 = to_fixed(TORQUE_MAX_NM, Q24),
    };
    return observer_bandwidth_configure(&settings);
}

class Bandwidth {
  public:
    explicit Bandwidth(const observer_bandwidth_parameters_t &p, double rate_hz = RATE_HZ)
        : parameters(p), model(reference_model::model_of(p, rate_hz)) {
        observer_bandwidth_reset(&state);
        limits.withheld_stages = 1; // no beat
        limits.holdoff_ticks = p.schedule.retrigger_holdoff_ticks;
    }

    // One sample of both; true when the firmware triggered.
    bool step(int32_t innovation, bool from_edge = false) {
        const load_observer_gains_t *gains =
            observer_bandwidth_step(&parameters, &state, &limits, innovation, &from_edge);
        EXPECT_EQ(gains, &parameters.stage[parameters.schedule.adaptive ? state.stage : LAST_STAGE].gains);
        const bool triggered = parameters.schedule.adaptive && state.ticks == 0;
        EXPECT_TRUE(!triggered || state.trigger != OBSERVER_TRIGGER_NONE);
        if (updating) {
            update(innovation, from_edge);
        }
        model.step(innovation / REV, from_edge);
        triggers += triggered;
        return triggered;
    }

    void update(int32_t innovation, bool from_edge) {
        const observer_bandwidth_sample_t sample = {
            .innovation = innovation, .from_edge = from_edge, .stage = state.stage, .trigger = state.trigger};
        observer_bandwidth_update(&parameters.schedule, &statistics, &sample, angle_step, rounding_q4, 0, &limits);
        state.trigger = OBSERVER_TRIGGER_NONE;
    }

    bool steady() const {
        return !parameters.schedule.adaptive || state.stage >= parameters.schedule.steady_stage_edge;
    }

    void settle(bool from_edge = false) {
        while (!steady()) {
            step(0, from_edge);
        }
    }

    double rad_s() const { return parameters.stage[state.stage].bandwidth_rad_s; }

    observer_bandwidth_parameters_t parameters;
    observer_bandwidth_t state{};
    observer_bandwidth_limits_t limits{};
    observer_bandwidth_statistics_t statistics{};
    bool updating = true; // the statistics, with every sample
    uint32_t angle_step = COUNT, rounding_q4 = 0;
    reference_model::bandwidth_t model;
    unsigned triggers = 0;
};

TEST(ObserverBandwidth, decays_as_5_over_time_within_11_percent_from_the_transient_to_the_steady_bandwidth) {
    for (const uint32_t rate_hz : {20000u, 40000u, 50000u, 100000u, 1000000u}) {
        Bandwidth bandwidth(configure(TRANSIENT_RAD_S, rate_hz), rate_hz);
        EXPECT_EQ(bandwidth.rad_s(), TRANSIENT_RAD_S) << "transient at the start";
        double most = 0.0, least = 0.0;
        for (uint32_t k = 0; k < rate_hz / 40; k++) {
            ASSERT_FALSE(bandwidth.step(0));
            const double deviation = bandwidth.rad_s() / bandwidth.model.bandwidth_rad_s - 1.0;
            // Stages last whole periods, bandwidths are integers; the last stage but one is cut off by the steady
            // bandwidth.
            const bool last = bandwidth.model.bandwidth_rad_s < STEADY_RAD_S * 1.3;
            ASSERT_NEAR(deviation, 0.0, (last ? 0.18 : 0.108) + 1.0 / (k + 1) + 1.0 / STEADY_RAD_S) << k;
            most = std::max(most, deviation);
            least = std::min(least, deviation);
        }
        EXPECT_GT(most, 0.05);
        EXPECT_LT(least, -0.05);
        EXPECT_TRUE(bandwidth.steady());
        EXPECT_EQ(bandwidth.rad_s(), STEADY_RAD_S);
    }
}

TEST(ObserverBandwidth, every_stage_has_the_gains_of_its_bandwidth) {
    const observer_bandwidth_parameters_t p = configure();
    for (unsigned stage = 0; stage < OBSERVER_BANDWIDTH_STAGES; stage++) {
        const load_observer_gains_t gains = load_observer_gains(p.stage[stage].bandwidth_rad_s, RATE_HZ, INERTIA_Q30);
        EXPECT_EQ(p.stage[stage].gains.angle_gain_q28, gains.angle_gain_q28);
        EXPECT_EQ(p.stage[stage].gains.speed_gain_q24, gains.speed_gain_q24);
        EXPECT_EQ(p.stage[stage].gains.load_gain_q28, gains.load_gain_q28);
        EXPECT_EQ(p.stage[stage].gains.load_factor_q4, gains.load_factor_q4);
        if (stage > 0 && stage < STEADY_STAGE) {
            EXPECT_NEAR(p.stage[stage].bandwidth_rad_s, p.stage[stage - 1].bandwidth_rad_s * 13.0 / 16.0, 2.0);
            EXPECT_GT(p.stage[stage].end_ticks, p.stage[stage - 1].end_ticks);
        }
    }
}

TEST(ObserverBandwidth, a_narrow_schedule_ends_early_and_stays_at_the_steady_bandwidth) {
    const observer_bandwidth_parameters_t p = configure(STEADY_RAD_S * 2);
    for (unsigned stage = 0; stage < LAST_STAGE; stage++) {
        EXPECT_GE(p.stage[stage].bandwidth_rad_s, STEADY_RAD_S);
    }
    EXPECT_EQ(p.stage[0].bandwidth_rad_s, STEADY_RAD_S * 2);
    EXPECT_EQ(p.stage[4].bandwidth_rad_s, STEADY_RAD_S);
    EXPECT_EQ(p.stage[STEADY_STAGE].bandwidth_rad_s, STEADY_RAD_S);
}

TEST(ObserverBandwidth, an_innovation_above_1_25_counts_or_8_urad_of_an_edge_triggers_and_a_smaller_one_does_not) {
    // Plus 0.3 urad, the innovation with an ideal encoder.
    const double urad = REV / (2.0 * PI) * 1e-6;
    for (const bool from_edge : {false, true}) {
        const double threshold = from_edge ? 8.0 * urad : 1.25 * COUNT;
        for (const double side : {1.0, -1.0}) {
            Bandwidth bandwidth(configure());
            bandwidth.settle(from_edge);
            // A single sample, because many would raise the mean innovation.
            const int32_t below = int32_t(side * (from_edge ? threshold : 1.1 * COUNT)) - (from_edge ? int(side) : 0);
            EXPECT_FALSE(bandwidth.step(below, from_edge));
            EXPECT_TRUE(bandwidth.step(int32_t(side * (threshold + 0.5 * urad)), from_edge));
            EXPECT_EQ(bandwidth.rad_s(), from_edge ? TRANSIENT_RAD_S : 3186);
        }
    }
    const observer_bandwidth_parameters_t ideal = configure(TRANSIENT_RAD_S, RATE_HZ, 32);
    EXPECT_NEAR(ideal.schedule.threshold_count / urad, 0.3, 0.01) << "an ideal encoder";
    EXPECT_EQ(ideal.schedule.trigger_stage_count, 0) << "triggers the full transient bandwidth";
}

TEST(ObserverBandwidth, the_time_since_a_trigger_does_not_come_round_and_the_next_one_comes_as_soon) {
    Bandwidth bandwidth(configure());
    bandwidth.settle();
    for (const uint32_t ticks : {(1u << 24) - 1u, uint32_t(INT32_MAX) - 1u, uint32_t(INT32_MAX)}) {
        bandwidth.state.ticks = ticks;
        ASSERT_FALSE(bandwidth.step(0));
        EXPECT_EQ(bandwidth.state.ticks, std::min(ticks + 1u, uint32_t(INT32_MAX)));
        EXPECT_TRUE(bandwidth.steady());
        EXPECT_TRUE(bandwidth.step(2 * COUNT)) << ticks;
        bandwidth.settle();
    }
}

TEST(ObserverBandwidth, equal_transient_and_steady_bandwidths_never_trigger) {
    Bandwidth bandwidth(configure(STEADY_RAD_S));
    for (const int32_t innovation : {0, COUNT, -(1 << 27), (1 << 27) - 1}) {
        for (const bool from_edge : {false, true}) {
            EXPECT_FALSE(bandwidth.step(innovation, from_edge));
            EXPECT_EQ(bandwidth.rad_s(), STEADY_RAD_S);
        }
    }
}

TEST(ObserverBandwidth, the_largest_innovations_of_either_sign_trigger_and_overflow_nothing) {
    for (const int32_t innovation : {(1 << 27) - 1, -(1 << 27)}) {
        Bandwidth bandwidth(configure());
        bandwidth.settle();
        EXPECT_TRUE(bandwidth.step(innovation));
        for (int k = 0; k < 400000; k++) {
            bandwidth.step(innovation);
            ASSERT_GE(bandwidth.statistics.mean_innovation_q32, 0);
        }
        EXPECT_GT(bandwidth.triggers, 2u);
    }
}

TEST(ObserverBandwidth, triggers_with_its_reference_model_and_has_the_same_mean_innovation) {
    for (const uint32_t rate_hz : {20000u, 40000u, 100000u}) {
        Bandwidth bandwidth(configure(TRANSIENT_RAD_S, rate_hz), rate_hz);
        std::mt19937 random(3);
        for (uint32_t k = 0; k < 3 * rate_hz; k++) {
            // Mostly the half count of an encoder; a load step every 0.2 s, with three counts for 0.5 ms.
            const bool step = k % (rate_hz / 5) < rate_hz / 2000;
            bandwidth.step(step ? 3 * COUNT : int32_t(random() % uint32_t(COUNT)) - COUNT / 2);
        }
        EXPECT_EQ(bandwidth.triggers, bandwidth.model.triggers) << rate_hz;
        EXPECT_GE(bandwidth.triggers, 14u) << "each load step";
        EXPECT_LE(bandwidth.triggers, 16u) << "and nothing else";
        EXPECT_NEAR(bandwidth.statistics.mean_innovation_q32 / Q32, bandwidth.model.mean_innovation * REV,
                    0.01 * bandwidth.model.mean_innovation * REV);
        EXPECT_NEAR(bandwidth.model.mean_innovation * REV, COUNT / 4.0, COUNT / 16.0);
    }
}

TEST(ObserverBandwidth,
     self_caused_triggers_extend_the_holdoff_and_a_load_step_after_a_quiet_second_triggers_immediately) {
    Bandwidth bandwidth(configure());
    bandwidth.settle();
    // Above the threshold during a transient and for 2 ms after: innovations that the transient itself causes.
    unsigned last_second = 0;
    int quiet = 0;
    for (int k = 0; k < 3 * int(RATE_HZ); k++) {
        quiet = bandwidth.steady() ? quiet + 1 : 0;
        const bool triggered = bandwidth.step(k == 0 || quiet < 80 ? (k % 2 == 0 ? 2 : -2) * COUNT : 0);
        last_second += triggered && k >= 2 * int(RATE_HZ);
    }
    EXPECT_GT(bandwidth.triggers, 2u);
    EXPECT_LT(last_second, 1000u / 3) << "with the minimum hold-off, 1 ms, it would be a thousand";
    for (int k = 0; k < int(RATE_HZ); k++) {
        bandwidth.step(0);
    }
    EXPECT_TRUE(bandwidth.step(2 * COUNT));
}

TEST(ObserverBandwidth, triggers_extend_the_holdoff_to_at_most_256_ms) {
    for (const uint32_t rate_hz : {20000u, 40000u, 100000u}) {
        Bandwidth bandwidth(configure(TRANSIENT_RAD_S, rate_hz), rate_hz);
        for (int k = 0; k < 100; k++) {
            bandwidth.state.trigger = OBSERVER_TRIGGER_IN_STEADY_STATE;
            bandwidth.update(2 * COUNT, false);
            EXPECT_LE(bandwidth.limits.holdoff_ticks * 1e3 / rate_hz, 256.0) << rate_hz;
        }
        EXPECT_GT(bandwidth.limits.holdoff_ticks * 1e3 / rate_hz, 255.0) << rate_hz;
    }
}

TEST(ObserverBandwidth, a_trigger_in_steady_state_doubles_the_extension_and_one_in_the_decay_adds_a_quarter) {
    for (const auto &[trigger, factor] : {std::pair{OBSERVER_TRIGGER_IN_STEADY_STATE, 2.0},
                                          {OBSERVER_TRIGGER_IN_DECAY, 1.25},
                                          {OBSERVER_TRIGGER_NONE, 1.0}}) {
        Bandwidth bandwidth(configure());
        bandwidth.statistics.holdoff_extension_q16 = 8u << 16;
        bandwidth.state.trigger = trigger;
        bandwidth.update(0, false);
        const double increment = trigger == OBSERVER_TRIGGER_NONE ? 0.0 : 0.25;
        EXPECT_NEAR(bandwidth.statistics.holdoff_extension_q16 / 65536.0, 8.0 * factor + increment, 0.01) << factor;
    }
}

TEST(ObserverBandwidth, a_trigger_counts_when_its_sample_and_the_next_ones_are_left_out_of_the_statistics) {
    Bandwidth bandwidth(configure());
    bandwidth.settle();
    bandwidth.updating = false;
    for (int k = 0; k < 5; k++) {
        bandwidth.step(k == 0 ? 2 * COUNT : 0);
        EXPECT_EQ(bandwidth.state.trigger, OBSERVER_TRIGGER_IN_STEADY_STATE);
        EXPECT_EQ(bandwidth.statistics.holdoff_extension_q16, 0u);
    }
    bandwidth.update(0, false);
    EXPECT_NEAR(bandwidth.statistics.holdoff_extension_q16 / 65536.0, 0.25, 0.01);
    EXPECT_EQ(bandwidth.limits.holdoff_ticks, RATE_HZ / 1000 + RATE_HZ / 1000 / 4 - 1);
    EXPECT_EQ(bandwidth.state.trigger, OBSERVER_TRIGGER_NONE);
}

TEST(ObserverBandwidth, a_slowly_growing_innovation_raises_the_threshold_and_does_not_trigger) {
    // From half a count, a good model, to four counts, a bad one, within two seconds.
    Bandwidth bandwidth(configure());
    bandwidth.settle();
    std::mt19937 random(5);
    for (uint32_t k = 0; k < 3 * RATE_HZ; k++) {
        const double half_counts = std::min(1.0 + 3.5 * k / RATE_HZ, 8.0);
        const double uniform = random() / REV * 2.0 - 1.0;
        ASSERT_FALSE(bandwidth.step(int32_t(uniform * half_counts * COUNT / 2.0))) << k;
    }
    EXPECT_NEAR(bandwidth.statistics.mean_innovation_q32 / Q32, 2.0 * COUNT, 0.15 * COUNT) << "their mean magnitude";
    EXPECT_NEAR(bandwidth.statistics.mean_innovation_q32 / Q32, bandwidth.model.mean_innovation * REV, 0.01 * COUNT);
    // An innovation far above the mean still triggers.
    EXPECT_TRUE(bandwidth.step(12 * COUNT));
}

// J w0^2 2 pi / 2^bits: a count as torque.
double count_Nm(double rad_s, unsigned bits) {
    return INERTIA * rad_s * rad_s * 2.0 * PI / std::ldexp(1.0, int(bits));
}

TEST(ObserverBandwidth, no_stage_is_wider_than_the_encoder_allows_and_the_next_wider_one_would_be) {
    for (unsigned bits = 8; bits <= 15; bits++) {
        const observer_bandwidth_parameters_t p = configure(TRANSIENT_RAD_S, RATE_HZ, bits);
        const auto largest_Nm = [&](unsigned stage) { return count_Nm(p.stage[stage].bandwidth_rad_s, bits); };
        const unsigned trigger = p.schedule.trigger_stage_count, moving = p.schedule.moving_stage;
        const unsigned steady_rad_s = p.stage[STEADY_STAGE].bandwidth_rad_s;
        EXPECT_LE(trigger, moving);
        EXPECT_TRUE(trigger == STEADY_STAGE || largest_Nm(trigger) <= TORQUE_MAX_NM * 0.63) << bits;
        EXPECT_GT(largest_Nm(trigger - 1), TORQUE_MAX_NM * 0.62) << bits;
        EXPECT_TRUE(moving == STEADY_STAGE || largest_Nm(moving) <= TORQUE_MAX_NM * 0.16) << bits;
        EXPECT_TRUE(steady_rad_s == 100 || count_Nm(steady_rad_s, bits) <= TORQUE_MAX_NM * 0.05) << bits;
        EXPECT_TRUE(steady_rad_s == STEADY_RAD_S || count_Nm(steady_rad_s + 1, bits) > TORQUE_MAX_NM * 0.049) << bits;
    }
}

TEST(ObserverBandwidth, a_fine_encoder_keeps_the_bandwidths_of_the_settings) {
    const observer_bandwidth_parameters_t p = configure();
    EXPECT_EQ(configure(TRANSIENT_RAD_S, RATE_HZ, 19).schedule.trigger_stage_count, 3) << "coarser than edges";
    EXPECT_EQ(p.stage[STEADY_STAGE].bandwidth_rad_s, STEADY_RAD_S);
    EXPECT_EQ(p.schedule.steady_stage_edge, STEADY_STAGE);
    EXPECT_LE(p.stage[p.schedule.moving_stage].bandwidth_rad_s, MOVING_RAD_S);
    EXPECT_GT(p.stage[p.schedule.moving_stage - 1].bandwidth_rad_s, MOVING_RAD_S);
}

TEST(ObserverBandwidth, withheld_stages_are_left_at_once_and_not_entered) {
    Bandwidth bandwidth(configure());
    bandwidth.settle();
    bandwidth.updating = false;
    bandwidth.limits.withheld_stages = 9;
    bandwidth.step(0);
    EXPECT_EQ(bandwidth.state.stage, LAST_STAGE - 9);
    for (uint32_t k = 0; k < RATE_HZ; k++) {
        bandwidth.step(0);
    }
    EXPECT_EQ(bandwidth.state.stage, LAST_STAGE - 9);
    EXPECT_FALSE(bandwidth.steady());
    bandwidth.limits.withheld_stages = 0;
    for (unsigned stage = LAST_STAGE - 8; stage <= LAST_STAGE; stage++) {
        bandwidth.step(0);
        EXPECT_EQ(bandwidth.state.stage, stage) << "one stage a sample";
    }
}

TEST(ObserverBandwidth, rare_edges_of_a_coarse_encoder_count_as_counts_and_frequent_ones_do_not) {
    constexpr unsigned COARSE_BITS = 10;
    const observer_bandwidth_parameters_t p = configure(TRANSIENT_RAD_S, RATE_HZ, COARSE_BITS);
    const uint32_t count = 1u << (32 - COARSE_BITS);
    ASSERT_LT(p.stage[STEADY_STAGE].bandwidth_rad_s, STEADY_RAD_S) << "a count would be worth too much torque";
    EXPECT_GE(p.stage[p.schedule.steady_stage_edge].bandwidth_rad_s, STEADY_RAD_S) << "an edge is not";
    EXPECT_LT(p.stage[p.schedule.steady_stage_edge].bandwidth_rad_s, STEADY_RAD_S * 16 / 13 * 16 / 13);
    for (const bool frequent : {false, true}) {
        Bandwidth bandwidth(p);
        bandwidth.angle_step = frequent ? count / 4 : count / 4 - 1; // one each 100 us
        for (uint32_t k = 0; k < RATE_HZ; k++) {
            bandwidth.step(0, true);
        }
        EXPECT_EQ(bandwidth.state.stage, frequent ? p.schedule.steady_stage_edge : STEADY_STAGE);
        EXPECT_EQ(bandwidth.step(int32_t(count), true), frequent);
        EXPECT_EQ(bandwidth.limits.trigger_stage_edge, frequent ? 0 : p.schedule.trigger_stage_count);
    }
}

// A rotation per period of `counts`, with the rounding of moving_load.h as a part of a count.
double rad_s_after_a_second(unsigned bits, double counts, double rounding, bool from_edge) {
    Bandwidth bandwidth(configure(TRANSIENT_RAD_S, RATE_HZ, bits));
    const double count = std::ldexp(1.0, int(32 - bits));
    bandwidth.angle_step = uint32_t(counts * count);
    bandwidth.rounding_q4 = uint32_t(16.0 * rounding * count);
    for (uint32_t k = 0; k < RATE_HZ; k++) {
        bandwidth.step(0, from_edge);
    }
    EXPECT_TRUE(bandwidth.steady());
    return bandwidth.rad_s();
}

TEST(ObserverBandwidth, a_beat_of_the_rounding_narrows_the_steady_bandwidth_and_nothing_else_does) {
    const double beat_rad_s = configure(TRANSIENT_RAD_S, RATE_HZ, 15).stage[LAST_STAGE].bandwidth_rad_s;
    EXPECT_LT(beat_rad_s, STEADY_RAD_S * 0.6);
    EXPECT_EQ(rad_s_after_a_second(15, 3.0, 0.5, false), beat_rad_s);
    EXPECT_EQ(rad_s_after_a_second(15, 3.0, 1.0 / 23.0, false), beat_rad_s);
    EXPECT_EQ(rad_s_after_a_second(15, 3.0, 1.0 / 25.0, false), STEADY_RAD_S) << "fast enough";
    EXPECT_EQ(rad_s_after_a_second(15, 0.51, 0.5, false), beat_rad_s);
    EXPECT_EQ(rad_s_after_a_second(15, 0.49, 0.5, false), STEADY_RAD_S) << "less than half a count in a period";
    EXPECT_EQ(rad_s_after_a_second(15, 3.0, 0.5, true), STEADY_RAD_S) << "edges";
}

TEST(ObserverBandwidth, in_a_beat_a_count_is_worth_at_least_a_512th_of_the_torque) {
    for (unsigned bits = 8; bits <= 32; bits++) {
        const observer_bandwidth_parameters_t p = configure(TRANSIENT_RAD_S, RATE_HZ, bits);
        const unsigned beat_rad_s = p.stage[LAST_STAGE].bandwidth_rad_s,
                       steady_rad_s = p.stage[STEADY_STAGE].bandwidth_rad_s;
        EXPECT_LE(beat_rad_s, steady_rad_s) << bits;
        EXPECT_GE(beat_rad_s, 100u) << bits;
        if (beat_rad_s < steady_rad_s) {
            EXPECT_GT(count_Nm(beat_rad_s, bits), TORQUE_MAX_NM / 513.0) << bits;
        }
        EXPECT_TRUE(beat_rad_s == 100 || count_Nm(beat_rad_s - 1, bits) <= TORQUE_MAX_NM / 511.0) << bits;
    }
}

TEST(ObserverBandwidth, a_trigger_ends_the_bandwidth_of_a_beat_and_the_decay_returns_to_it) {
    const observer_bandwidth_parameters_t p = configure(TRANSIENT_RAD_S, RATE_HZ, 14);
    Bandwidth bandwidth(p);
    bandwidth.angle_step = 1u << 18;
    bandwidth.rounding_q4 = 8u << 18;
    for (uint32_t k = 0; k < RATE_HZ / 5; k++) {
        bandwidth.step(0);
    }
    ASSERT_EQ(bandwidth.state.stage, LAST_STAGE);
    EXPECT_TRUE(bandwidth.step(2 << 18));
    EXPECT_EQ(bandwidth.state.stage, p.schedule.trigger_stage_count);
    uint32_t periods = 0;
    while (bandwidth.state.stage < LAST_STAGE) {
        bandwidth.step(0);
        ASSERT_LT(++periods, RATE_HZ);
    }
    EXPECT_NEAR(periods / double(RATE_HZ), 5.5 / p.stage[LAST_STAGE].bandwidth_rad_s, 1e-3);
}

// Error of a schedule a / t: d(angle) = w - 3 w0 e, dw = L - 3 w0^2 e, dL = -w0^3 e, with the load step at t = 1.2 ms.
double error_growth(double a) {
    double e = 0.0, w = 0.0, load = 1.0, first = 0.0;
    constexpr double STEP_S = 1e-7;
    for (double t = 1.2e-3; t < 25e-3; t += STEP_S) {
        const double w0 = a / t;
        const double de = w - 3.0 * w0 * e, dw = load - 3.0 * w0 * w0 * e, dload = -w0 * w0 * w0 * e;
        e += de * STEP_S;
        w += dw * STEP_S;
        load += dload * STEP_S;
        first = t < 6e-3 ? e : first;
    }
    return std::fabs(e / first);
}

TEST(ObserverBandwidth, a_decay_as_5_over_time_forgets_the_load_step_and_one_as_3_5_over_time_does_not) {
    EXPECT_LT(error_growth(5.0), 0.9);
    EXPECT_GT(error_growth(3.5), 2.0);
}

TEST(ObserverBandwidth, the_mean_of_the_innovation_moves_by_its_exact_product_rounded_down) {
    Bandwidth bandwidth(configure());
    bandwidth.settle();
    std::mt19937 random(4);
    int64_t expected_q32 = bandwidth.statistics.mean_innovation_q32;
    for (int k = 0; k < 20000; k++) {
        const int32_t innovation = int32_t(random() % uint32_t(COUNT)) - COUNT / 2; // below the threshold
        expected_q32 += (std::abs(int64_t(innovation)) - (expected_q32 >> 32)) *
                        bandwidth.parameters.schedule.mean_innovation_gain_q32;
        bandwidth.update(innovation, false);
        ASSERT_EQ(bandwidth.statistics.mean_innovation_q32, expected_q32) << k;
    }
    EXPECT_GT(expected_q32 >> 32, COUNT / 8);
}

} // namespace
