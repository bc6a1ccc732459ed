// 2^-y over every y that does not underflow.
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "fixed/exponential.h"
}

namespace {

constexpr double ONE_Q31 = 2147483648.0;
constexpr double ONE_Q17 = 131072.0;
constexpr uint32_t UNDERFLOW_Q17 = 32u << 17; // half an LSB

TEST(Exponential, is_within_its_bound_for_every_octave) {
    double worst = 0.0;
    for (uint32_t octaves_q17 = 0; octaves_q17 <= UNDERFLOW_Q17; octaves_q17++) {
        const double exact = std::exp2(-double(octaves_q17) / ONE_Q17);
        const double error = std::fabs(exponential_octaves_q31(octaves_q17) / ONE_Q31 - exact);
        ASSERT_LE(error, 1.6e-5 * exact + 1.0 / ONE_Q31) << octaves_q17;
        if (octaves_q17 < 4u << 17) {
            worst = std::max(worst, error / exact);
        }
    }
    /* h^2 / 8 with h = ln 2 / 64 is 1.466e-5: no better can be had from the table. */
    EXPECT_GT(worst, 1.46e-5);
    EXPECT_LT(worst, 1.5e-5);
}

TEST(Exponential, never_rises) {
    uint32_t last = exponential_octaves_q31(0);
    for (uint32_t octaves_q17 = 1; octaves_q17 <= UNDERFLOW_Q17; octaves_q17++) {
        const uint32_t value = exponential_octaves_q31(octaves_q17);
        ASSERT_LE(value, last) << octaves_q17;
        last = value;
    }
}

TEST(Exponential, starts_at_one_and_ends_at_zero) {
    EXPECT_EQ(exponential_octaves_q31(0), 0x80000000u);
    EXPECT_EQ(exponential_octaves_q31(1u << 17), 0x40000000u);
    EXPECT_EQ(exponential_octaves_q31(UINT32_MAX), 0u);
    std::mt19937 random(1);
    for (int i = 0; i < 200000; i++) {
        const auto octaves_q17 = uint32_t(random());
        ASSERT_TRUE(octaves_q17 < UNDERFLOW_Q17 || exponential_octaves_q31(octaves_q17) == 0);
    }
}

} // namespace
