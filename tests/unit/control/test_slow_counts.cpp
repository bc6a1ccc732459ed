// Corrections of the load observer by slow counts: gains against their formulas in double precision, a rotor under
// load.
#include <cmath>
#include <cstdint>

#include <gtest/gtest.h>

extern "C" {
#include "control/slow_counts.h"
}

#include "support/reference_builders.h"

namespace {

using namespace fixed_point;
constexpr uint32_t RATE_HZ = 40000;
constexpr unsigned BITS = 10, SHIFT = 32 - BITS;
constexpr uint32_t COUNT = 1u << SHIFT;
constexpr double INERTIA = 0.02, COUNT_RAD = 2.0 * PI / (1 << BITS);
const int32_t INERTIA_Q30 = to_fixed(INERTIA, Q30);

struct SlowCounts : testing::Test {
    slow_counts_parameters_t parameters = slow_counts_configure(RATE_HZ, BITS, INERTIA_Q30);
    slow_counts_t counts = {};
    slow_counts_results_t results = {};

    bool step(uint32_t angle, uint32_t periods, uint32_t rotation = 0) {
        results.slow = slow_counts_step(&parameters, &counts, angle, rotation, periods);
        if (results.slow) {
            set(0);
        }
        return results.slow;
    }
    void set(int32_t slope_q24) {
        slow_counts_update(&parameters, &counts, slope_q24);
        slow_counts_set(&counts, &results);
    }
    bool wait(uint32_t periods, uint32_t angle = 0) {
        bool slow = false;
        for (uint32_t k = 0; k < periods; k++) {
            slow = step(angle, 1);
        }
        return slow;
    }
};

// In 1/s and N m / rad, from 2^-32 rev.
double speed_gain(const load_observer_gains_t &gains) {
    return gains.speed_gain_q24 / Q24 / Q22 * REV / (2.0 * PI);
}
double load_gain(const load_observer_gains_t &gains) {
    return -double(gains.load_gain_q28) / Q28 * (gains.load_factor_q4 / 16.0) / Q24 * REV / (2.0 * PI);
}

TEST_F(SlowCounts, are_those_of_half_a_millisecond_until_there_are_some_of_three_eighths) {
    EXPECT_FALSE(wait(19));
    EXPECT_TRUE(wait(1));
    EXPECT_TRUE(wait(1, COUNT)) << "the next one";
    EXPECT_TRUE(wait(19, COUNT));
    EXPECT_TRUE(wait(1, 2 * COUNT)) << "after 20 periods";
    EXPECT_TRUE(wait(14, 2 * COUNT));
    EXPECT_TRUE(wait(1, 3 * COUNT)) << "after 15";
    EXPECT_TRUE(wait(13, 3 * COUNT));
    EXPECT_FALSE(wait(1, 4 * COUNT)) << "after 14";
    EXPECT_FALSE(wait(18, 4 * COUNT));
    EXPECT_FALSE(wait(1, 5 * COUNT)) << "after 19, faster counts before";
    EXPECT_FALSE(wait(19, 5 * COUNT));
    EXPECT_TRUE(wait(1, 5 * COUNT));
}

TEST_F(SlowCounts, skipped_periods_count) {
    EXPECT_FALSE(wait(1));
    EXPECT_TRUE(step(0, 19));
}

TEST_F(SlowCounts, have_the_gains_of_samples_that_far_apart) {
    uint32_t passed = 0;
    for (const uint32_t periods : {21u, 41u, 60u, 100u, 159u, 160u, 161u, 400u, 1000u, 10000u}) {
        wait(periods - 1 - passed);
        passed = periods - 1;
        const double seconds = double(periods) / RATE_HZ, q = std::fmax(0.0, 1.0 - seconds * 250.0);
        EXPECT_NEAR(results.edge.angle_gain_q28 / Q28, 1.0 - q * q * q, 1e-5) << periods;
        const double l2 = 1.5 * (1.0 - q) * (1.0 - q) * (1.0 + q) / seconds;
        EXPECT_NEAR(speed_gain(results.edge), l2, 1e-3 * l2) << periods;
        const double l3 = std::pow(1.0 - q, 3) / seconds / seconds * INERTIA / 2.0; // half of it, see slow_counts.h
        EXPECT_NEAR(load_gain(results.edge), l3, 2e-3 * l3) << periods;
    }
    EXPECT_TRUE(wait(3000000)) << "the time saturates";
    EXPECT_GT(speed_gain(results.edge), 0.0);
}

// Each product is rounded to 2 LSB: within 1 LSB, of which the next one keeps its factor's part.
TEST_F(SlowCounts, have_gains_within_the_rounding_of_their_products) {
    for (const uint32_t rate_hz : {20000u, 40000u, 100000u}) {
        const slow_counts_parameters_t p = slow_counts_configure(rate_hz, BITS, INERTIA_Q30);
        const double l2 = p.deadbeat.speed_gain_q24, l3 = p.deadbeat.load_gain_q28;
        for (uint32_t periods = 1; periods < 8 * p.deadbeat_periods; periods++) {
            counts.interval = counts.periods = periods - 1;
            slow_counts_update(&p, &counts, 0);
            const load_observer_gains_t &edge = counts.edge;
            if (periods <= p.deadbeat_periods) {
                const double x = periods * p.step_q31 / Q31, q = INT32_MAX / Q31 - x;
                ASSERT_NEAR(edge.angle_gain_q28, Q28 * (1.0 - q * q * q), 1.3) << periods;
                ASSERT_NEAR(edge.speed_gain_q24, l2 * (1.0 - q * q), 1.0 + 2.0 * std::fabs(l2) / Q31) << periods;
                ASSERT_NEAR(edge.load_gain_q28, l3 * x / 2.0, 1.0 + 0.5 * std::fabs(l3) / Q31 + 1e-3) << periods;
            } else {
                const double y = double((p.deadbeat_periods << 16) / periods) / Q16;
                ASSERT_NEAR(edge.speed_gain_q24, l2 * y, 1.0 + 1e-3) << periods;
                ASSERT_NEAR(edge.load_gain_q28, l3 * y * y / 2.0, 1.0 + 0.5 + 1e-3) << periods;
            }
        }
    }
}

TEST_F(SlowCounts, tell_the_edge_when_they_change_and_an_interval_when_not) {
    wait(100, 5 * COUNT);
    load_observer_t observer = {};
    const auto angle = [&](double counts_predicted, uint32_t encoder_angle) {
        observer.angle_q64 = uint64_t(std::llround(counts_predicted * COUNT)) << 32;
        return slow_counts_angle(&results, &observer, encoder_angle, SHIFT);
    };
    EXPECT_EQ(angle(5.25, 5 * COUNT), 5 * COUNT + COUNT / 4) << "no innovation";
    EXPECT_EQ(angle(7.5, 5 * COUNT), 6 * COUNT - 1) << "not beyond the count";
    EXPECT_EQ(angle(4.5, 5 * COUNT), 5 * COUNT);
    EXPECT_EQ(angle(5.25, 6 * COUNT), 6 * COUNT) << "forwards";
    EXPECT_EQ(angle(5.25, 4 * COUNT), 5 * COUNT - 1) << "backwards";
    EXPECT_EQ(slow_counts_gains(&parameters, &results, 5 * COUNT), &parameters.deadbeat);
    EXPECT_EQ(slow_counts_gains(&parameters, &results, 6 * COUNT), &results.edge);
}

TEST_F(SlowCounts, have_the_gains_of_the_time_in_which_the_estimated_speed_passes_a_count) {
    wait(400);
    EXPECT_EQ(slow_counts_gains(&parameters, &results, 0), &results.edge) << "later than 4 ms";
    const double speed = speed_gain(results.edge), load = load_gain(results.edge);
    for (int k = 0; k < 300; k++) {
        step(0, 1, COUNT / 400);
    }
    EXPECT_EQ(speed_gain(results.edge), speed) << "the lateness does not make it smaller";
    EXPECT_EQ(load_gain(results.edge), load);
    step(0, 1, COUNT / 800);
    EXPECT_NEAR(speed_gain(results.edge) * 702, speed * 401, 0.01 * speed * 401) << "a slower one";
}

TEST_F(SlowCounts, bound_the_speed_by_four_counts_in_the_time_since_the_last_one) {
    wait(160);
    EXPECT_EQ(results.speed_max_q22, INT32_MAX) << "not within 4 ms";
    for (const uint32_t more : {1u, 39u, 200u, 3600u}) {
        wait(more);
        const double speed = 4 * COUNT_RAD * RATE_HZ / counts.periods;
        EXPECT_NEAR(results.speed_max_q22 / Q22, speed, 1e-3 * speed) << counts.periods;
        // The product is rounded to 2 LSB.
        const int64_t ratio_q16 = (int64_t(parameters.deadbeat_periods) << 16) / counts.periods;
        const int64_t product_q38 = parameters.late_speed_q22 * ratio_q16;
        EXPECT_LE(std::llabs((int64_t(results.speed_max_q22) << 16) - product_q38), 1 << 16) << counts.periods;
    }
    step(COUNT, 1);
    EXPECT_EQ(results.speed_max_q22, INT32_MAX) << "a count";
    wait(161, COUNT);
    EXPECT_LT(results.speed_max_q22, INT32_MAX) << "waits again";
}

TEST_F(SlowCounts, leave_an_angle_uncertain_by_a_quarter_of_a_count_for_each_4_ms) {
    wait(80);
    EXPECT_NEAR(slow_counts_uncertain_angle(&parameters, &counts), COUNT / 8, COUNT / 500);
    wait(400);
    step(COUNT, 1);
    EXPECT_NEAR(slow_counts_uncertain_angle(&parameters, &counts), 481.0 / 640.0 * COUNT, COUNT / 500)
        << "of the time between the last edges";
    wait(40000, COUNT);
    EXPECT_EQ(slow_counts_uncertain_angle(&parameters, &counts), 2 * COUNT) << "limited";
}

// The exact means of sqrt(u) coth(sqrt(u)) and sqrt(u) coth(sqrt(u) / 2).
TEST_F(SlowCounts, have_the_speed_gain_of_a_torque_that_changes_with_the_angle) {
    const auto factor = [](double u) {
        const double r = std::sqrt(std::fabs(u));
        const double speed = u < 0 ? r / std::tan(r) : r / std::tanh(r);
        const double load = u < 0 ? r / std::tan(r / 2) : r / std::tanh(r / 2);
        return (speed + load) / 2.0 / 1.5;
    };
    wait(799); // the next is 20 ms after the edge
    const double without = speed_gain(results.edge), load = load_gain(results.edge);
    for (const double u : {-2.2, -1.0, -0.1, 0.1, 1.0, 4.0, 10.0, 20.0, 35.0}) {
        const double slope = u * INERTIA / (0.02 * 0.02);
        set(to_fixed(slope / 50.0, Q24));
        EXPECT_NEAR(speed_gain(results.edge) / without, factor(u), (u < -2.0 ? 0.1 : 0.06) * factor(u)) << u;
        EXPECT_EQ(load_gain(results.edge), load) << u;
    }
    for (const double u : {-3.0, -100.0}) {
        set(to_fixed(u * INERTIA / 0.0004 / 50.0, Q24));
        EXPECT_NEAR(speed_gain(results.edge) / without, 0.62, 0.02) << "limited";
    }
    set(INT32_MAX);
    EXPECT_NEAR(speed_gain(results.edge) / without, 3.78, 0.1) << "limited";
    EXPECT_EQ(load_gain(results.edge), load);
}

// A rotor at constant speed and torque: the middle of a count would leave the estimates swinging by 0.3 rad/s.
TEST_F(SlowCounts, leave_a_rotor_at_constant_speed_no_error) {
    const load_observer_model_t model = load_observer_model(RATE_HZ, INERTIA_Q30, 0);
    const load_observer_inertia_t inertia = load_observer_inertia(&model, 0);
    load_observer_t observer;
    load_observer_reset(&observer, COUNT / 2);
    const double speed = 1.0, load = 3.0; // 6.1 ms a count
    double error = 0.0, load_error = 0.0;
    for (uint32_t k = 0; k < RATE_HZ; k++) {
        const double rad = speed * k / RATE_HZ;
        const uint32_t angle = uint32_t(uint64_t(std::floor(rad / COUNT_RAD)) << SHIFT);
        const uint32_t measured =
            results.slow ? slow_counts_angle(&results, &observer, angle, SHIFT) : angle + COUNT / 2;
        const load_observer_gains_t *gains = slow_counts_gains(&parameters, &results, angle);
        load_observer_step(&model, results.slow ? gains : &parameters.deadbeat, &inertia, &observer,
                           load_observer_innovation(&observer, measured), to_fixed(load, Q24));
        step(angle, 1, uint32_t(std::fabs(observer.speed_q22 / Q22) / RATE_HZ / (2.0 * PI) * REV));
        if (k > RATE_HZ / 2) {
            error = std::fmax(error, std::fabs(observer.speed_q22 / Q22 - speed));
            load_error = std::fmax(load_error, std::fabs(observer.load_torque_q24 / Q24 - load));
        }
    }
    EXPECT_GT(error, 0.0);
    EXPECT_LT(error, 0.02);
    EXPECT_LT(load_error, 0.1);
}

} // namespace
