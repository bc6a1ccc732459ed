// The activation functions over their whole input range.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "fixed/sigmoid.h"
}

#include "support/reference_models.h"

namespace {

using namespace fixed_point;
constexpr int32_t END_Q23 = 8 << 23; // of the table
constexpr int32_t STRIDE_Q23 = 1009;

double symmetric(int32_t x_q23) {
    return std::tanh(0.5 * x_q23 / Q23);
}

double logistic(int32_t x_q23) {
    return 1.0 / (1.0 + std::exp(-x_q23 / Q23));
}

TEST(Sigmoid, every_table_entry_is_its_formula_rounded) {
    for (int32_t entry = -SIGMOID_STEPS; entry <= SIGMOID_STEPS; entry++) {
        const double f = std::tanh(entry / 32.0), second_derivative = -0.5 * f * (1.0 - f * f), step = 1.0 / 16.0;
        const double shifted = 32768.0 * (f - second_derivative * step * step / 16.0);
        ASSERT_EQ(sigmoid_symmetric_q15[SIGMOID_STEPS + entry], std::lround(shifted)) << entry;
    }
}

TEST(Sigmoid, symmetric_error_is_within_its_bound_and_the_function_is_odd_and_monotonic) {
    double worst = 0.0;
    int32_t last = INT32_MIN;
    for (int32_t x_q23 = -END_Q23; x_q23 < END_Q23; x_q23 += STRIDE_Q23) {
        const int32_t value = sigmoid_symmetric_q27(x_q23);
        worst = std::max(worst, std::fabs(value / Q27 - symmetric(x_q23)));
        // Except for the bits of x that do not enter the interpolation.
        ASSERT_NEAR(value, -sigmoid_symmetric_q27(-x_q23), 1100.0) << x_q23;
        ASSERT_GE(value, last) << x_q23;
        last = value;
    }
    EXPECT_LT(worst, 8e-5);
    EXPECT_GT(worst, 5e-5);
}

TEST(Sigmoid, symmetric_saturates_beyond_the_table_within_its_bound) {
    const int32_t end_q27 = sigmoid_symmetric_q27(END_Q23 - 1);
    EXPECT_EQ(sigmoid_symmetric_q27(INT32_MAX), end_q27);
    EXPECT_EQ(sigmoid_symmetric_q27(INT32_MIN), -(sigmoid_symmetric_q15[2 * SIGMOID_STEPS] << 12));
    EXPECT_NEAR(end_q27 / Q27, 1.0, 7e-4);
    EXPECT_LT(end_q27, (1 << 27) - (1 << 16));
    std::mt19937 random(1);
    for (int i = 0; i < 100000; i++) {
        const auto x_q23 = int32_t(uint32_t(random()));
        if (std::llabs(x_q23) > END_Q23) {
            ASSERT_EQ(sigmoid_symmetric_q27(x_q23), sigmoid_symmetric_q27(x_q23 > 0 ? INT32_MAX : INT32_MIN)) << x_q23;
            ASSERT_NEAR(sigmoid_logistic_q28(sigmoid_symmetric_q27(x_q23)) / Q28, logistic(x_q23), 3.5e-4);
        }
    }
}

TEST(Sigmoid, logistic_error_is_within_its_bound) {
    double worst = 0.0;
    for (int32_t x_q23 = -END_Q23; x_q23 < END_Q23; x_q23 += STRIDE_Q23) {
        const int32_t value = sigmoid_logistic_q28(sigmoid_symmetric_q27(x_q23));
        worst = std::max(worst, std::fabs(value / Q28 - logistic(x_q23)));
        ASSERT_GT(value, 0);
        ASSERT_LT(value, 1 << 28);
    }
    EXPECT_LT(worst, 4e-5);
    EXPECT_GT(worst, 2e-5);
    EXPECT_EQ(sigmoid_logistic_q28(sigmoid_symmetric_q27(0)), 1 << 27);
}

TEST(Sigmoid, slope_errors_are_within_their_bounds_and_slopes_are_non_negative) {
    const int32_t end_q27 = (1 << 27) - (1 << 12);
    for (int32_t f_q27 = -end_q27; f_q27 <= end_q27; f_q27 += 97) {
        const double f = f_q27 / Q27;
        const int32_t slope_q32 = sigmoid_symmetric_slope_q32(f_q27);
        ASSERT_GE(slope_q32, 0);
        ASSERT_NEAR(slope_q32 / Q32, (1.0 - f * f) / 2.0, 1.0 / (1 << 22)) << f_q27;
        const double g = 0.5 + 0.5 * f;
        ASSERT_NEAR(sigmoid_logistic_slope_q33(f_q27) / (2.0 * Q32), g * (1.0 - g), 1.0 / (1 << 23));
    }
    EXPECT_NEAR(sigmoid_symmetric_slope_q32(0), 1u << 31, 1 << 10);
}

TEST(Sigmoid, slopes_are_the_derivatives_of_the_functions) {
    const double step = 1.0 / 64.0;
    for (int32_t x_q23 = -END_Q23; x_q23 < END_Q23; x_q23 += 17 << 11) {
        const double x = x_q23 / Q23;
        const double f_slope = (std::tanh(0.5 * (x + step)) - std::tanh(0.5 * (x - step))) / (2.0 * step);
        const int32_t f_q27 = sigmoid_symmetric_q27(x_q23);
        EXPECT_NEAR(sigmoid_symmetric_slope_q32(f_q27) / Q32, f_slope, 1e-4) << x;
        EXPECT_NEAR(sigmoid_logistic_slope_q33(f_q27) / Q32 / 2.0, 0.5 * f_slope, 1e-4) << x;
    }
}

} // namespace
