// Torque of a free shaft: sums of variances and covariances against the factors that they have been made with.
#include <cmath>
#include <cstdint>

#include <gtest/gtest.h>

extern "C" {
#include "control/shaft_torque.h"
}

#include "support/fixed_point.h"
#include "support/flipped_bits.h"

namespace {

using namespace fixed_point;

constexpr double Q14 = one(14);
constexpr int32_t LEAST_Q14 = 5 << 14; // (N m)^2

class ShaftTorque : public testing::Test {
  protected:
    ShaftTorque() { parameters.variance_min_q14 = LEAST_Q14; }

    // Windows of a torque whose true value is `machine` times the tables', and is estimated with a factor.
    void windows(int count, double machine, double in_effect, double variance = 20.0, double correlation = 1.0) {
        for (int k = 0; k < count; k++) {
            const double of_tables = variance * (1.0 + 0.3 * std::sin(double(k)));
            sample.window++;
            sample.torque_variance_q14 = to_fixed(of_tables * in_effect * in_effect, Q14);
            sample.covariance_q14 = to_fixed(of_tables * in_effect * machine, Q14);
            sample.acceleration_variance_q14 = to_fixed(of_tables * machine * machine / correlation, Q14);
            sample.in_effect_q30 = to_fixed(in_effect, Q30);
            shaft_torque_step(&parameters, &state, &sample);
        }
    }

    double factor() const { return state.factor_q30 / Q30; }

    inertia_parameters_t parameters{};
    shaft_torque_t state{};
    shaft_torque_sample_t sample = {.counts = true, .scale_q30 = to_fixed(1.0, Q30)};
};

TEST_F(ShaftTorque, is_the_missing_factor_less_its_tolerance) {
    for (const double scale : {0.8, 1.0, 1.3}) {
        for (const double gain : {0.95, 0.97, 1.0, 1.01, 1.04, 1.06}) {
            for (const double in_effect : {0.9, 1.0, 1.2}) {
                state = {};
                sample.scale_q30 = to_fixed(scale * gain, Q30); // by the energy
                windows(100, scale, in_effect);
                const double missing = 1.0 / gain - 1.0, tolerance = 1.0 / 80.0;
                const double expected =
                    std::fabs(missing) < tolerance ? 0.0 : missing - std::copysign(tolerance, missing);
                EXPECT_NEAR(factor(), 1.0 + expected, 2e-4) << scale << " " << gain << " " << in_effect;
            }
        }
    }
}

// Sums of more than 30 bits.
TEST_F(ShaftTorque, is_the_missing_factor_of_a_drive_of_100_Nm) {
    parameters.variance_min_q14 = to_fixed(100.0 / 8.0 * 100.0 / 8.0, Q14);
    for (const double gain : {0.95, 1.0, 1.06}) {
        state = {};
        sample.scale_q30 = to_fixed(gain, Q30);
        windows(800, 1.0, 1.0, 250.0);
        ASSERT_GT(state.variance, 1 << 30);
        const double missing = 1.0 / gain - 1.0;
        EXPECT_NEAR(factor(), gain == 1.0 ? 1.0 : 1.0 + missing - std::copysign(1.0 / 80.0, missing), 2e-4) << gain;
    }
}

TEST_F(ShaftTorque, is_1_for_another_inertia) {
    for (const double ratio : {0.5, 0.9, 1.1, 2.0}) {
        state = {};
        windows(100, ratio, 1.0);
        EXPECT_EQ(state.factor_q30, 1 << 30) << ratio;
    }
}

TEST_F(ShaftTorque, is_1_without_strong_changes_that_the_acceleration_follows) {
    windows(40, 1.05, 1.0, 5.5); // too few
    EXPECT_EQ(state.factor_q30, 1 << 30);
    state = {};
    windows(100, 1.05, 1.0, 2.0); // too small
    EXPECT_EQ(state.factor_q30, 1 << 30);
    windows(100, 1.05, 1.0, 20.0, 0.9); // a load that moves
    EXPECT_EQ(state.factor_q30, 1 << 30);
    sample.counts = false;
    windows(100, 1.05, 1.0);
    EXPECT_EQ(state.factor_q30, 1 << 30);
    sample.counts = true;
    windows(100, 1.05, 1.0);
    EXPECT_NEAR(factor(), 1.05 - 1.0 / 80.0, 2e-4);
}

TEST_F(ShaftTorque, a_torque_against_which_the_shaft_accelerates_counts_nothing) {
    windows(200, -1.0, 1.0);
    EXPECT_EQ(factor(), 1.0);
    EXPECT_EQ(state.variance, 0);
    EXPECT_EQ(state.covariance, 0);
    windows(1, 1.0, 1.0);
    EXPECT_GT(state.variance, 0);
}

TEST_F(ShaftTorque, counts_a_window_once) {
    windows(1, 1.05, 1.0);
    const int64_t variance = state.variance;
    for (int k = 0; k < 100; k++) {
        shaft_torque_step(&parameters, &state, &sample);
    }
    EXPECT_EQ(state.variance, variance);
}

TEST_F(ShaftTorque, follows_a_change_of_the_gain_and_overflows_nothing) {
    windows(2000, 1.05, 1.0, 1000.0);
    windows(2000, 0.96, 1.0, 1000.0);
    EXPECT_NEAR(factor(), 0.96 + 1.0 / 80.0, 2e-3);
    for (int k = 0; k < 1000; k++) {
        sample = {.window = sample.window + 1,
                  .torque_variance_q14 = INT32_MAX,
                  .acceleration_variance_q14 = INT32_MAX,
                  .covariance_q14 = INT32_MAX,
                  .counts = true,
                  .in_effect_q30 = to_fixed(0.7, Q30),
                  .scale_q30 = to_fixed(1.4, Q30)};
        shaft_torque_step(&parameters, &state, &sample);
        ASSERT_GT(state.factor_q30, to_fixed(0.9, Q30));
        ASSERT_LT(state.factor_q30, to_fixed(1.1, Q30));
    }
}

// A factor beyond 1/12 is not used, whatever the sums are.
TEST_F(ShaftTorque, is_within_its_limits_with_any_bit_of_the_sums_changed) {
    windows(100, 1.05, 1.0);
    for (int64_t shaft_torque_t::*sum : {&shaft_torque_t::variance, &shaft_torque_t::covariance}) {
        with_each_bit_flipped(state.*sum, [&](int64_t flipped) {
            shaft_torque_t changed = state;
            changed.*sum = flipped;
            sample.window++;
            shaft_torque_step(&parameters, &changed, &sample);
            EXPECT_NEAR(changed.factor_q30 / Q30, 1.0, 1.0 / 12.0) << flipped;
        });
    }
}

} // namespace
