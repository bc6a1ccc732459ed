// Trend of the innovation: detection of a load that moves.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>
#include <utility>

#include <gtest/gtest.h>

extern "C" {
#include "control/moving_load.h"
}

#include "support/fixed_point.h"

namespace {

using namespace fixed_point;
constexpr unsigned ENCODER_BITS = 17, STAGES = 9, WIDENING = 4;
constexpr int32_t COUNT = 1 << (32 - ENCODER_BITS);
constexpr uint32_t RATE_HZ = 40000;
constexpr uint32_t FAST = uint32_t(8.381966 * COUNT); // rotation per period, far from ratios
constexpr uint32_t TRIGGER_TICKS = RATE_HZ / 500;

moving_load_settings_t settings(unsigned encoder_bits = ENCODER_BITS, uint32_t rate_hz = RATE_HZ) {
    return {.encoder_bits = encoder_bits, .control_rate_hz = rate_hz, .stages = STAGES, .trigger_ticks = TRIGGER_TICKS};
}

// After six samples at a constant rotation per period.
uint32_t rounding_of(const moving_load_parameters_t &parameters, uint32_t angle_step) {
    moving_load_rounding_t rounding{};
    uint32_t result = 0;
    for (int k = 0; k < 6; k++) {
        EXPECT_EQ(result, 0u);
        result = moving_load_rounding_q4(&parameters, &rounding, angle_step);
    }
    return result;
}

TEST(MovingLoad, a_least_distance_that_has_changed_in_memory_to_0_divides_nothing) {
    const moving_load_settings_t of = settings();
    const moving_load_parameters_t parameters = moving_load_configure(&of);
    for (int changed = 1; changed < 6; changed++) {
        moving_load_rounding_t rounding{};
        for (int k = 0; k < 6; k++) {
            rounding.least = k == changed ? 0 : rounding.least;
            moving_load_rounding_q4(&parameters, &rounding, FAST);
        }
        EXPECT_GT(rounding.rounding_q4, 0u);
    }
}

class Detector {
  public:
    explicit Detector(const moving_load_settings_t &of = settings()) : parameters(moving_load_configure(&of)) {}

    uint32_t step(int32_t innovation, uint32_t angle_step = FAST, bool from_edge = false, bool hold = false,
                  bool triggered = false, bool beat = false) {
        const observer_bandwidth_sample_t sample = {
            .innovation = innovation,
            .from_edge = from_edge,
            .stage = OBSERVER_BANDWIDTH_BEAT_STAGE - (beat ? state.withheld : std::max(state.withheld, 1u)),
            .trigger = triggered ? OBSERVER_TRIGGER_IN_STEADY_STATE : OBSERVER_TRIGGER_NONE,
        };
        return moving_load_step(&parameters, &state, &sample,
                                moving_load_rounding_q4(&parameters, &rounding_state, angle_step), hold);
    }
    // Longest sequence of samples with withheld stages.
    uint32_t run(uint32_t samples, int32_t innovation, uint32_t angle_step = FAST) {
        uint32_t withheld = 0;
        for (uint32_t k = 0; k < samples; k++) {
            withheld += step(innovation, angle_step) > 0;
        }
        return withheld;
    }

    moving_load_parameters_t parameters;
    moving_load_t state{};
    moving_load_rounding_t rounding_state{};
};

TEST(MovingLoad, a_constant_innovation_of_a_seventh_of_a_count_withholds_and_of_a_ninth_does_not) {
    for (const int32_t sign : {1, -1}) {
        Detector moving, constant;
        moving.run(RATE_HZ / 50, sign * COUNT / 7);
        EXPECT_EQ(moving.step(sign * COUNT / 7), STAGES);
        EXPECT_EQ(constant.run(RATE_HZ, sign * COUNT / 9), 0u);
    }
}

TEST(MovingLoad, a_trend_in_the_stage_of_a_beat_withholds_it_and_one_1_6_ms_later_four_more) {
    Detector detector;
    uint32_t withheld = 0;
    while (withheld == 0) {
        withheld = detector.step(COUNT / 4, FAST, false, false, false, true);
    }
    EXPECT_EQ(withheld, 1u);
    uint32_t periods = 0;
    while (detector.step(COUNT / 4) == 1) {
        periods++;
    }
    EXPECT_EQ(detector.state.withheld, 1 + WIDENING);
    EXPECT_NEAR(periods * 1e3 / RATE_HZ, 1.6, 0.06);
}

TEST(MovingLoad, a_trend_withholds_four_more_stages_each_time_constant_up_to_all) {
    Detector detector;
    while (detector.step(COUNT / 4) == 0) {
    }
    EXPECT_EQ(detector.state.withheld, 1 + WIDENING) << "besides the beat's";
    uint32_t periods = 1;
    while (detector.step(COUNT / 4) == 1 + WIDENING) {
        periods++;
    }
    EXPECT_EQ(periods, detector.parameters.time_constant);
    EXPECT_EQ(detector.state.withheld, STAGES);
    EXPECT_EQ(detector.run(RATE_HZ, COUNT / 4), RATE_HZ);
    EXPECT_EQ(detector.state.withheld, STAGES);
}

TEST(MovingLoad, a_trend_that_the_wider_bandwidth_ends_withholds_no_more) {
    Detector detector;
    while (detector.step(COUNT / 6) == 0) {
    }
    for (uint32_t k = 0; k < RATE_HZ / 50; k++) {
        ASSERT_EQ(detector.step(COUNT / 10), 1 + WIDENING);
    }
}

TEST(MovingLoad, trends_in_the_stage_of_a_beat_alone_withhold_it_for_up_to_0_8_s) {
    Detector detector;
    uint32_t longest = 0, held = 0;
    for (uint32_t k = 0; k < 6 * RATE_HZ; k++) {
        const bool beat = detector.state.withheld == 0;
        const uint32_t withheld = detector.step(beat ? COUNT / 4 : 0, FAST, false, false, false, beat);
        ASSERT_LE(withheld, 1u);
        held = withheld > 0 ? held + 1 : 0;
        longest = held > longest ? held : longest;
    }
    EXPECT_GT(longest, RATE_HZ * 3 / 4);
    EXPECT_LE(longest, RATE_HZ * 33 / 40);
}

TEST(MovingLoad, rounding_to_counts_withholds_nothing_at_any_speed) {
    for (const unsigned bits : {8u, 12u, 17u, 20u}) {
        Detector detector(settings(bits));
        const uint32_t count = 1u << (32 - bits);
        for (double counts = 1e-4; counts < 20.0; counts *= 1.7) {
            uint32_t angle = 0;
            const auto step = uint32_t(counts * count);
            for (uint32_t k = 0; k < 2 * RATE_HZ; k++) {
                angle += step;
                const int32_t innovation = int32_t(angle / count * count + count / 2 - angle);
                ASSERT_EQ(detector.step(innovation, step), 0u) << bits << " bits, " << counts << " counts a period";
            }
        }
    }
}

// Innovation of a rotor that turns at a constant rate, of the middle of the count.
bool withholds_rounding(unsigned bits, double counts, double time_s) {
    Detector detector(settings(bits));
    const double count = std::ldexp(1.0, int(32 - bits));
    uint32_t withheld = 0;
    for (uint32_t k = 0; k < uint32_t(time_s * RATE_HZ); k++) {
        const double at = std::fmod(k * counts, 1.0);
        withheld += detector.step(int32_t((0.5 - at) * count), uint32_t(counts * count)) > 0;
    }
    return withheld > 0;
}

TEST(MovingLoad, rounding_withholds_nothing_near_any_ratio_of_counts) {
    for (const unsigned bits : {10u, 14u, 17u}) {
        for (int q = 1; q <= 9; q++) {
            for (const int p : {1, 2, 5, 7, 11, 55}) {
                for (const double beat_hz : {0.0, 0.7, 8.0, 60.0, 250.0, 1100.0}) {
                    for (const double side : {-1.0, 1.0}) {
                        const double counts = (p + side * beat_hz / RATE_HZ) / q;
                        ASSERT_FALSE(withholds_rounding(bits, counts, 0.3)) << bits << " bits " << counts;
                    }
                }
            }
        }
    }
}

TEST(MovingLoad, rounding_is_that_of_the_sawtooth_near_ratios_and_small_elsewhere) {
    Detector detector;
    const auto rounding = [&](double counts) {
        return rounding_of(detector.parameters, uint32_t(counts * COUNT)) / 16.0 / COUNT;
    };
    for (int q = 1; q <= 6; q++) {
        EXPECT_NEAR(rounding(7.0 + 1.0 / q), 0.5 / (q == 1 ? 1 : q), 0.01) << q;
    }
    // 375 Hz: 0.6 of a sawtooth within 1.6 ms; 4 n is 2.4.
    EXPECT_NEAR(rounding(5.0 + 375.0 / RATE_HZ), 0.5 / 3.0, 0.01);
    EXPECT_NEAR(rounding(5.5 - 375.0 / RATE_HZ / 2.0), 0.25 / 3.0, 0.01);
    EXPECT_LT(rounding(5.381966), 1.0 / 40.0) << "the golden section";
    double most = 0.0, mean = 0.0;
    for (int k = 0; k < 1000; k++) {
        const double at = rounding(20.0 + k / 1000.0);
        most = std::max(most, at);
        mean += at / 1000.0;
    }
    EXPECT_NEAR(most, 0.5, 0.01);
    EXPECT_LT(mean, 1.0 / 16.0) << "the threshold hardly rises at most speeds";
    const moving_load_settings_t ideal = settings(32);
    const moving_load_parameters_t parameters = moving_load_configure(&ideal);
    EXPECT_LE(rounding_of(parameters, 12345), 8u);
}

TEST(MovingLoad, a_trend_after_a_trigger_counts_after_the_first_stage_and_three_time_constants) {
    Detector detector;
    detector.step(COUNT, FAST, false, false, true);
    uint32_t periods = 1;
    while (detector.step(COUNT) == 0) {
        ASSERT_LT(++periods, RATE_HZ);
    }
    EXPECT_NEAR(periods * 1e3 / RATE_HZ, 2.0 + 3 * 1.6, 0.1);
}

TEST(MovingLoad, a_trigger_releases_what_its_own_step_has_withheld_once) {
    Detector detector;
    while (detector.step(-COUNT / 2) == 0) {
    }
    EXPECT_EQ(detector.step(-2 * COUNT, FAST, false, false, true), 0u) << "a load step";
    while (detector.step(-COUNT / 2) == 0) {
    }
    EXPECT_EQ(detector.step(-2 * COUNT, FAST, false, false, true), 1 + WIDENING) << "a load that moves";
}

TEST(MovingLoad, stages_are_released_after_25_ms_one_each_5_ms) {
    for (const uint32_t rate_hz : {20000u, 40000u, 1000000u}) {
        Detector detector(settings(ENCODER_BITS, rate_hz));
        while (detector.step(COUNT) < STAGES) {
        }
        const uint32_t withheld = detector.run(rate_hz, 0);
        // The trend itself decays within milliseconds.
        EXPECT_NEAR(withheld * 1e3 / rate_hz, 25.0 + (STAGES - 1) * 5.0, 4.0) << rate_hz;
    }
}

TEST(MovingLoad, a_trend_during_the_release_doubles_the_hold_up_to_0_8_s_and_a_quiet_time_ends_that) {
    Detector detector;
    double hold_ms = 0.0;
    for (int repeat = 0; repeat < 8; repeat++) {
        while (detector.step(COUNT) < STAGES) {
        }
        uint32_t periods = 0;
        while (detector.step(0) == STAGES) {
            periods++;
        }
        const double next_ms = periods * 1e3 / RATE_HZ;
        if (repeat > 0) {
            EXPECT_NEAR(next_ms, std::min(2.0 * hold_ms, 800.0), 10.0) << repeat;
        }
        hold_ms = next_ms;
    }
    EXPECT_NEAR(hold_ms, 800.0, 10.0);
    detector.run(10 * RATE_HZ, 0);
    while (detector.step(COUNT) < STAGES) {
    }
    EXPECT_NEAR(detector.run(RATE_HZ, 0) * 1e3 / RATE_HZ, 65.0, 6.0);
}

TEST(MovingLoad, a_quiet_time_of_the_last_hold_and_then_of_each_half_of_it_halves_the_next_one) {
    for (const auto &[quiet_s, next_ms] : {std::pair{0.9, 800.0}, {1.1, 800.0}, {1.3, 400.0}, {1.45, 200.0}}) {
        Detector detector;
        for (int repeat = 0; repeat < 8; repeat++) { // up to a hold of 0.8 s
            while (detector.step(COUNT) < STAGES) {
            }
            while (detector.step(0) == STAGES) {
            }
        }
        while (detector.step(0) > 0) {
        }
        detector.run(uint32_t(quiet_s * RATE_HZ), 0);
        while (detector.step(COUNT) < STAGES) {
        }
        uint32_t periods = 0;
        while (detector.step(0) == STAGES) {
            periods++;
        }
        EXPECT_NEAR(periods * 1e3 / RATE_HZ, next_ms, 10.0) << quiet_s;
    }
}

TEST(MovingLoad, hold_keeps_what_is_withheld_and_withholds_nothing_itself) {
    Detector moving;
    for (uint32_t k = 0; k < RATE_HZ; k++) {
        ASSERT_EQ(moving.step(0, FAST, false, true), 0u);
    }
    moving.run(RATE_HZ / 50, COUNT);
    for (uint32_t k = 0; k < 2 * RATE_HZ; k++) {
        ASSERT_EQ(moving.step(0, FAST, false, true), STAGES);
    }
    EXPECT_LT(moving.run(RATE_HZ, 0), RATE_HZ / 5) << "released without it";
}

TEST(MovingLoad, edges_have_a_threshold_of_0_7_urad) {
    const double urad = REV / (2.0 * PI) * 1e-6;
    for (const double trend_urad : {0.65, 0.75}) {
        Detector detector;
        uint32_t withheld = 0;
        for (uint32_t k = 0; k < RATE_HZ / 10; k++) {
            withheld += detector.step(int32_t(trend_urad * urad), FAST, true) > 0;
        }
        EXPECT_EQ(withheld > 0, trend_urad > 0.7);
    }
}

TEST(MovingLoad, the_largest_innovations_overflow_nothing) {
    Detector detector;
    std::mt19937 random(1);
    for (uint32_t k = 0; k < RATE_HZ; k++) {
        EXPECT_LE(detector.step(random() % 2 ? (1 << 27) - 1 : -(1 << 27), uint32_t(random()) >> 10), STAGES);
    }
}

// A distance from a ratio is rounded down to 2^-15 count, the result to 1 LSB.
TEST(MovingLoad, rounding_is_that_of_its_formula_for_any_encoder_and_rotation) {
    std::mt19937 random(2);
    int beats = 0;
    for (int i = 0; i < 100000; i++) {
        const unsigned bits = 8 + random() % 25;
        const moving_load_settings_t of = settings(bits, 20000 + random() % 80000);
        const moving_load_parameters_t parameters = moving_load_configure(&of);
        const double count = std::ldexp(1.0, int(32 - bits)), periods = parameters.time_constant;
        // Anywhere, or near a ratio.
        const double near = (1 + random() % 12) / double(1 + random() % 6) + (random() / REV - 0.5) * 0.02;
        const auto angle_step = i % 2 ? uint32_t(random()) >> random() % 16 : uint32_t(std::fabs(near) * count);
        const double counts = angle_step / count;
        double least = 0.0, most = 0.0;
        for (int q = 1; q <= 6; q++) {
            const double distance = std::fabs(q * counts - std::round(q * counts));
            const double closer = std::max(distance - 1.0 / 32768.0, 0.0);
            least = std::max(least, 0.5 / q / (1.0 + std::floor(4.0 * distance * periods)));
            most = std::max(most, 0.5 / q / (1.0 + std::floor(4.0 * closer * periods)));
        }
        const double rounding = rounding_of(parameters, angle_step);
        ASSERT_GT(rounding, least * 16.0 * count - 1.0) << bits << " bits, " << counts;
        ASSERT_LE(rounding, most * 16.0 * count) << bits << " bits, " << counts;
        beats += most > 1.0 / 16.0;
    }
    EXPECT_GT(beats, 10000);
}

TEST(MovingLoad, rounding_is_that_of_a_rotation_of_up_to_11_samples_ago) {
    const moving_load_settings_t of = settings();
    const moving_load_parameters_t parameters = moving_load_configure(&of);
    const uint32_t slow = uint32_t(0.01 * COUNT), fast = FAST;
    ASSERT_GT(rounding_of(parameters, slow), 2 * rounding_of(parameters, fast));
    moving_load_rounding_t rounding{};
    for (int change = 0; change < 24; change++) { // at each of the six places
        const uint32_t angle_step = change % 2 == 0 ? slow : fast;
        for (int k = 0; k < 11 + change % 7; k++) {
            moving_load_rounding_q4(&parameters, &rounding, angle_step);
        }
        EXPECT_EQ(rounding.rounding_q4, rounding_of(parameters, angle_step)) << change;
    }
}

TEST(MovingLoad, the_trend_moves_by_its_exact_product_rounded_down) {
    Detector detector;
    std::mt19937 random(3);
    int64_t expected_q36 = 0;
    for (int k = 0; k < 20000; k++) {
        const int32_t innovation = int32_t(random() % uint32_t(COUNT / 4)) - COUNT / 8;
        const int64_t trend_q4 = expected_q36 >> 32; // rounded down
        expected_q36 += (int64_t(innovation) * 16 - trend_q4) * detector.parameters.gain_q32;
        detector.step(innovation);
        ASSERT_EQ(detector.state.trend_q36, expected_q36) << k;
    }
    EXPECT_NE(expected_q36, 0);
}

TEST(MovingLoad, triggers_after_the_first_release_do_not_keep_a_load_that_has_moved_from_being_forgotten) {
    Detector detector;
    while (detector.step(COUNT / 4) == 0) {
    }
    EXPECT_EQ(detector.step(0, FAST, false, false, true), 0u) << "it may have been a load step";
    ASSERT_GT(detector.state.hold_ticks, 0u);
    for (uint32_t k = 1; k <= RATE_HZ / 2; k++) {
        EXPECT_EQ(detector.step(0, FAST, false, false, k % (RATE_HZ / 100) == 0), 0u);
    }
    EXPECT_EQ(detector.state.hold_ticks, 0u) << "the next one is a first one";
}

} // namespace
