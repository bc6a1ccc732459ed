// The activation functions over their whole input range.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "fixed/sigmoid.h"
}

#include "twins.h"

namespace {

constexpr int32_t END_Q12 = 13 << 12; // the table ends at 12

double symmetric(int32_t x_q12) {
    return std::tanh(0.5 * x_q12 / twins::Q12);
}

double logistic(int32_t x_q12) {
    return 1.0 / (1.0 + std::exp(-x_q12 / twins::Q12));
}

TEST(Sigmoid, every_table_entry_is_the_rounded_formula) {
    for (int32_t entry = 0; entry <= 384; entry++) {
        const double exact = 32768.0 * std::tanh(entry / 64.0);
        ASSERT_EQ(sigmoid_symmetric_q15(entry * 128), std::min(32767, int32_t(std::lround(exact)))) << entry;
    }
}

TEST(Sigmoid, symmetric_is_within_its_bound_odd_and_never_falls) {
    double worst = 0.0;
    int32_t last = -32768;
    for (int32_t x_q12 = -END_Q12; x_q12 <= END_Q12; x_q12++) {
        const int32_t value = sigmoid_symmetric_q15(x_q12);
        worst = std::max(worst, std::fabs(value / twins::Q15 - symmetric(x_q12)));
        ASSERT_EQ(value, -sigmoid_symmetric_q15(-x_q12)) << x_q12;
        ASSERT_GE(value, last) << x_q12;
        ASSERT_LE(std::abs(value), 32767);
        last = value;
    }
    EXPECT_LT(worst, 6e-5);
    EXPECT_GT(worst, 3e-5);
}

TEST(Sigmoid, symmetric_saturates_over_the_rest_of_the_range) {
    EXPECT_EQ(sigmoid_symmetric_q15(INT32_MAX), 32767);
    EXPECT_EQ(sigmoid_symmetric_q15(INT32_MIN), -32767);
    std::mt19937 random(1);
    for (int i = 0; i < 100000; i++) {
        const auto x_q12 = int32_t(uint32_t(random()));
        if (std::llabs(x_q12) > END_Q12) {
            ASSERT_EQ(sigmoid_symmetric_q15(x_q12), x_q12 > 0 ? 32767 : -32767) << x_q12;
            ASSERT_EQ(sigmoid_logistic_q15(x_q12), x_q12 > 0 ? 32768 : 1) << x_q12;
        }
    }
}

TEST(Sigmoid, logistic_is_within_its_bound_and_never_falls) {
    double worst = 0.0;
    int32_t last = 0;
    for (int32_t x_q12 = -END_Q12; x_q12 <= END_Q12; x_q12++) {
        const int32_t value = sigmoid_logistic_q15(x_q12);
        worst = std::max(worst, std::fabs(value / twins::Q15 - logistic(x_q12)));
        ASSERT_GE(value, last) << x_q12;
        ASSERT_GE(value, 1);
        ASSERT_LE(value, 32768);
        last = value;
    }
    EXPECT_LT(worst, 5e-5);
    EXPECT_GT(worst, 2e-5);
    EXPECT_EQ(sigmoid_logistic_q15(0), 16384);
}

TEST(Sigmoid, slopes_are_truncated_by_less_than_one_lsb) {
    for (int32_t f_q15 = -32768; f_q15 <= 32768; f_q15++) {
        const double f = f_q15 / twins::Q15;
        const double exact = 32768.0 * (1.0 - f * f) / 2.0;
        const int32_t slope = sigmoid_symmetric_slope_q15(f_q15);
        ASSERT_LE(slope, exact) << f_q15;
        ASSERT_GT(slope, exact - 1.0) << f_q15;
    }
    for (int32_t g_q15 = 0; g_q15 <= 32768; g_q15++) {
        const double g = g_q15 / twins::Q15;
        const double exact = 32768.0 * g * (1.0 - g);
        const int32_t slope = sigmoid_logistic_slope_q15(g_q15);
        ASSERT_LE(slope, exact) << g_q15;
        ASSERT_GT(slope, exact - 1.0) << g_q15;
    }
}

TEST(Sigmoid, slopes_are_the_derivatives_of_the_functions) {
    const double step = 1.0 / 64.0;
    for (int32_t x_q12 = -END_Q12; x_q12 <= END_Q12; x_q12 += 17) {
        const double x = x_q12 / twins::Q12;
        const double f_slope = (std::tanh(0.5 * (x + step)) - std::tanh(0.5 * (x - step))) / (2.0 * step);
        EXPECT_NEAR(sigmoid_symmetric_slope_q15(sigmoid_symmetric_q15(x_q12)) / twins::Q15, f_slope, 1e-4) << x;
        const double g_slope = 0.5 * f_slope;
        EXPECT_NEAR(sigmoid_logistic_slope_q15(sigmoid_logistic_q15(x_q12)) / twins::Q15, g_slope, 1e-4) << x;
    }
}

} // namespace
