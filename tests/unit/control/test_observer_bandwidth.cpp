// The observer's bandwidth over time: its decay, what wakes it and what does not, against the double-precision twin.
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/observer_bandwidth.h"
}

#include "support/reference_models.h"

namespace {

constexpr uint32_t WIDEST_RAD_S = 9000, STEADY_RAD_S = 250;
constexpr unsigned ENCODER_BITS = 17;
constexpr int32_t COUNT = 1 << (32 - ENCODER_BITS);
constexpr uint32_t RATE_HZ = 40000;
const int32_t INERTIA_Q30 = twins::to_fixed(0.02, twins::Q30);
constexpr unsigned LAST_STAGE = OBSERVER_BANDWIDTH_STAGES - 1;

observer_bandwidth_parameters_t configure(uint32_t widest_rad_s = WIDEST_RAD_S, uint32_t rate_hz = RATE_HZ,
                                          unsigned encoder_bits = ENCODER_BITS) {
    return observer_bandwidth_configure(widest_rad_s, STEADY_RAD_S, encoder_bits, rate_hz, INERTIA_Q30);
}

// Innovations in 2^-32 turn instead of turns, as the firmware's.
twins::bandwidth_t twin_of(const observer_bandwidth_parameters_t &p, double rate_hz) {
    twins::bandwidth_t twin{};
    twin.steady_rad_s = p.bandwidth_rad_s[LAST_STAGE];
    twin.first_count_rad_s = p.bandwidth_rad_s[p.first_stage_count];
    twin.first_edge_rad_s = p.bandwidth_rad_s[0];
    twin.rate_hz = rate_hz;
    twin.threshold_count = p.threshold_count;
    twin.threshold_edge = p.threshold_edge;
    twin.pause_s = p.pause_ticks / rate_hz;
    twin.kept = p.forget_q32 / twins::Q32;
    return twin;
}

class Bandwidth {
  public:
    explicit Bandwidth(const observer_bandwidth_parameters_t &p, double rate_hz = RATE_HZ)
        : parameters(p), twin(twin_of(p, rate_hz)) {
        observer_bandwidth_reset(&state);
    }

    // One sample of both; true when the firmware's woke.
    bool step(int32_t innovation, bool from_edge = false) {
        const load_observer_gains_t *gains = observer_bandwidth_step(&parameters, &state, innovation, from_edge);
        EXPECT_EQ(gains, &parameters.gains[parameters.wakes ? state.stage : LAST_STAGE]);
        twin.step(innovation, from_edge);
        const bool woke = parameters.wakes && state.ticks == 0;
        wakings += woke;
        return woke;
    }

    void settle() {
        while (!observer_bandwidth_steady(&parameters, &state)) {
            step(0);
        }
    }

    double rad_s() const { return parameters.bandwidth_rad_s[state.stage]; }

    observer_bandwidth_parameters_t parameters;
    observer_bandwidth_t state{};
    twins::bandwidth_t twin;
    unsigned wakings = 0;
};

TEST(ObserverBandwidth, decays_as_3_5_over_the_time_within_11_percent_from_the_widest_to_the_steady) {
    for (const uint32_t rate_hz : {20000u, 40000u, 50000u, 100000u, 1000000u}) {
        Bandwidth bandwidth(configure(WIDEST_RAD_S, rate_hz), rate_hz);
        EXPECT_EQ(bandwidth.rad_s(), WIDEST_RAD_S) << "awake at the start";
        double most = 0.0, least = 0.0;
        for (uint32_t k = 0; k < rate_hz / 40; k++) {
            ASSERT_FALSE(bandwidth.step(0));
            const double deviation = bandwidth.rad_s() / bandwidth.twin.bandwidth_rad_s - 1.0;
            // A stage lasts whole periods, its bandwidth is a whole number; the last but one is cut off by the steady.
            const bool last = bandwidth.twin.bandwidth_rad_s < STEADY_RAD_S * 1.3;
            ASSERT_NEAR(deviation, 0.0, (last ? 0.18 : 0.108) + 1.0 / (k + 1) + 1.0 / STEADY_RAD_S) << k;
            most = std::max(most, deviation);
            least = std::min(least, deviation);
        }
        EXPECT_GT(most, 0.05);
        EXPECT_LT(least, -0.05);
        EXPECT_TRUE(observer_bandwidth_steady(&bandwidth.parameters, &bandwidth.state));
        EXPECT_EQ(bandwidth.rad_s(), STEADY_RAD_S);
    }
}

TEST(ObserverBandwidth, every_stage_has_the_gains_of_its_bandwidth) {
    const observer_bandwidth_parameters_t p = configure();
    for (unsigned stage = 0; stage < OBSERVER_BANDWIDTH_STAGES; stage++) {
        const load_observer_gains_t gains = load_observer_gains(p.bandwidth_rad_s[stage], RATE_HZ, INERTIA_Q30);
        EXPECT_EQ(p.gains[stage].angle_gain_q28, gains.angle_gain_q28);
        EXPECT_EQ(p.gains[stage].speed_gain_q24, gains.speed_gain_q24);
        EXPECT_EQ(p.gains[stage].load_gain_q28, gains.load_gain_q28);
        EXPECT_EQ(p.gains[stage].load_factor_q4, gains.load_factor_q4);
        if (stage > 0 && stage < LAST_STAGE) {
            EXPECT_NEAR(p.bandwidth_rad_s[stage], p.bandwidth_rad_s[stage - 1] * 13.0 / 16.0, 2.0);
            EXPECT_GT(p.end_ticks[stage], p.end_ticks[stage - 1]);
        }
    }
}

TEST(ObserverBandwidth, a_narrow_schedule_ends_early_and_stays_at_the_steady_bandwidth) {
    const observer_bandwidth_parameters_t p = configure(STEADY_RAD_S * 2);
    for (unsigned stage = 0; stage < OBSERVER_BANDWIDTH_STAGES; stage++) {
        EXPECT_GE(p.bandwidth_rad_s[stage], STEADY_RAD_S);
    }
    EXPECT_EQ(p.bandwidth_rad_s[0], STEADY_RAD_S * 2);
    EXPECT_EQ(p.bandwidth_rad_s[4], STEADY_RAD_S);
    EXPECT_EQ(p.bandwidth_rad_s[LAST_STAGE], STEADY_RAD_S);
}

TEST(ObserverBandwidth, an_innovation_beyond_1_25_counts_or_8_urad_of_an_edge_wakes_and_less_does_not) {
    // Beside what an ideal encoder leaves, 0.3 urad.
    const double urad = twins::TURN / (2.0 * twins::PI) * 1e-6;
    for (const bool from_edge : {false, true}) {
        const double threshold = from_edge ? 8.0 * urad : 1.25 * COUNT;
        for (const double side : {1.0, -1.0}) {
            Bandwidth bandwidth(configure());
            bandwidth.settle();
            // What is usual rises with it: a single sample, not many.
            const int32_t below = int32_t(side * (from_edge ? threshold : 1.1 * COUNT)) - (from_edge ? int(side) : 0);
            EXPECT_FALSE(bandwidth.step(below, from_edge));
            EXPECT_TRUE(bandwidth.step(int32_t(side * (threshold + 0.5 * urad)), from_edge));
            EXPECT_EQ(bandwidth.rad_s(), bandwidth.parameters.bandwidth_rad_s[from_edge ? 0 : 3]);
        }
    }
    const observer_bandwidth_parameters_t ideal = configure(WIDEST_RAD_S, RATE_HZ, 32);
    EXPECT_NEAR(ideal.threshold_count / urad, 0.3, 0.01) << "an ideal encoder";
    EXPECT_EQ(ideal.first_stage_count, 0) << "wakes to the widest";
}

TEST(ObserverBandwidth, one_that_is_as_wide_as_the_steady_never_wakes) {
    Bandwidth bandwidth(configure(STEADY_RAD_S));
    for (const int32_t innovation : {0, COUNT, -(1 << 27), (1 << 27) - 1}) {
        for (const bool from_edge : {false, true}) {
            EXPECT_FALSE(bandwidth.step(innovation, from_edge));
            EXPECT_EQ(bandwidth.rad_s(), STEADY_RAD_S);
        }
    }
}

TEST(ObserverBandwidth, the_largest_innovations_of_either_sign_wake_and_overflow_nothing) {
    for (const int32_t innovation : {(1 << 27) - 1, -(1 << 27)}) {
        Bandwidth bandwidth(configure());
        bandwidth.settle();
        EXPECT_TRUE(bandwidth.step(innovation));
        for (int k = 0; k < 400000; k++) {
            bandwidth.step(innovation);
            ASSERT_GE(bandwidth.state.usual_q32, 0);
        }
        EXPECT_GT(bandwidth.wakings, 2u);
    }
}

TEST(ObserverBandwidth, wakes_when_its_twin_does_and_takes_the_same_innovations_for_usual) {
    for (const uint32_t rate_hz : {20000u, 40000u, 100000u}) {
        Bandwidth bandwidth(configure(WIDEST_RAD_S, rate_hz), rate_hz);
        std::mt19937 random(3);
        for (uint32_t k = 0; k < 3 * rate_hz; k++) {
            // Mostly the half count of an encoder; a load step every 0.2 s, with three counts for 0.5 ms.
            const bool step = k % (rate_hz / 5) < rate_hz / 2000;
            bandwidth.step(step ? 3 * COUNT : int32_t(random() % uint32_t(COUNT)) - COUNT / 2);
        }
        EXPECT_EQ(bandwidth.wakings, bandwidth.twin.wakings) << rate_hz;
        EXPECT_GE(bandwidth.wakings, 14u) << "each load step";
        EXPECT_LE(bandwidth.wakings, 16u) << "and nothing else";
        EXPECT_NEAR(bandwidth.state.usual_q32 / twins::Q32, bandwidth.twin.usual, 0.01 * bandwidth.twin.usual);
        EXPECT_NEAR(bandwidth.twin.usual, COUNT / 4.0, COUNT / 16.0);
    }
}

TEST(ObserverBandwidth, wakings_that_wakings_cause_pause_longer_and_a_load_step_after_a_quiet_second_wakes_at_once) {
    Bandwidth bandwidth(configure());
    bandwidth.settle();
    // Beyond the threshold as long as it is awake, and for 2 ms after: what it would stir up itself.
    unsigned last_second = 0;
    int quiet = 0;
    for (int k = 0; k < 3 * int(RATE_HZ); k++) {
        quiet = observer_bandwidth_steady(&bandwidth.parameters, &bandwidth.state) ? quiet + 1 : 0;
        const bool woke = bandwidth.step(k == 0 || quiet < 80 ? (k % 2 == 0 ? 2 : -2) * COUNT : 0);
        last_second += woke && k >= 2 * int(RATE_HZ);
    }
    EXPECT_GT(bandwidth.wakings, 2u);
    EXPECT_LT(last_second, 1000u / 3) << "with the least pause, 1 ms, it would be a thousand";
    for (int k = 0; k < int(RATE_HZ); k++) {
        bandwidth.step(0);
    }
    EXPECT_TRUE(bandwidth.step(2 * COUNT));
}

TEST(ObserverBandwidth, what_grows_slowly_is_usual_and_wakes_nobody) {
    // From the half count of a good model to the four of a bad one, in two seconds.
    Bandwidth bandwidth(configure());
    bandwidth.settle();
    std::mt19937 random(5);
    for (uint32_t k = 0; k < 3 * RATE_HZ; k++) {
        const double half_counts = std::min(1.0 + 3.5 * k / RATE_HZ, 8.0);
        const double uniform = random() / twins::TURN * 2.0 - 1.0;
        ASSERT_FALSE(bandwidth.step(int32_t(uniform * half_counts * COUNT / 2.0))) << k;
    }
    EXPECT_NEAR(bandwidth.state.usual_q32 / twins::Q32, 2.0 * COUNT, 0.15 * COUNT) << "their mean size";
    EXPECT_NEAR(bandwidth.state.usual_q32 / twins::Q32, bandwidth.twin.usual, 0.01 * COUNT);
    // What is far beyond the usual still wakes.
    EXPECT_TRUE(bandwidth.step(12 * COUNT));
}

} // namespace
