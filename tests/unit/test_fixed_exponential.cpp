// e^-x over every x that does not underflow.
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "fixed/exponential.h"
}

namespace {

constexpr double ONE_Q31 = 2147483648.0;
constexpr uint32_t UNDERFLOW_Q16 = 22u << 16; // e^-22 is 0.6 LSB

TEST(Exponential, is_within_its_bound_for_every_x) {
    double worst = 0.0;
    for (uint32_t x_q16 = 0; x_q16 <= UNDERFLOW_Q16; x_q16++) {
        const double exact = std::exp(-double(x_q16) / 65536.0);
        const double error = std::fabs(exponential_negative_q31(x_q16) / ONE_Q31 - exact);
        ASSERT_LE(error, 1.6e-5 * exact + 1.0 / ONE_Q31) << x_q16;
        if (x_q16 < 4u << 16) {
            worst = std::max(worst, error / exact);
        }
    }
    /* h^2 / 8 with h = ln 2 / 64 is 1.466e-5: no better can be had from the table. */
    EXPECT_GT(worst, 1.46e-5);
    EXPECT_LT(worst, 1.49e-5);
}

TEST(Exponential, never_rises) {
    uint32_t last = exponential_negative_q31(0);
    for (uint32_t x_q16 = 1; x_q16 <= UNDERFLOW_Q16; x_q16++) {
        const uint32_t value = exponential_negative_q31(x_q16);
        ASSERT_LE(value, last) << x_q16;
        last = value;
    }
}

TEST(Exponential, starts_at_one_and_ends_at_zero) {
    EXPECT_EQ(exponential_negative_q31(0), 0x80000000u);
    EXPECT_EQ(exponential_negative_q31(UINT32_MAX), 0u);
    std::mt19937 random(1);
    for (int i = 0; i < 200000; i++) {
        const auto x_q16 = uint32_t(random());
        const double exact = std::exp(-double(x_q16) / 65536.0);
        ASSERT_LE(std::fabs(exponential_negative_q31(x_q16) / ONE_Q31 - exact), 1.6e-5 * exact + 1.0 / ONE_Q31);
        ASSERT_TRUE(x_q16 <= UNDERFLOW_Q16 || exponential_negative_q31(x_q16) == 0);
    }
}

} // namespace
