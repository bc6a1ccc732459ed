// 2^-y for every y that does not underflow.
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "fixed/exp2.h"
}

#include "support/fixed_point.h"

namespace {

using namespace fixed_point;

constexpr uint32_t UNDERFLOW_Q17 = 32u << 17; // half an LSB

TEST(Exp2, error_is_within_its_bound_for_every_exponent) {
    double worst = 0.0;
    for (uint32_t exponent_q17 = 0; exponent_q17 <= UNDERFLOW_Q17; exponent_q17++) {
        const double exact = std::exp2(-double(exponent_q17) / Q17);
        const double error = std::fabs(exp2_negative_q31(exponent_q17) / Q31 - exact);
        ASSERT_LE(error, 1.6e-5 * exact + 1.0 / Q31) << exponent_q17;
        if (exponent_q17 < 4u << 17) {
            worst = std::max(worst, error / exact);
        }
    }
    /* h^2 / 8 with h = ln 2 / 64 is 1.466e-5: the limit of linear interpolation. */
    EXPECT_GT(worst, 1.46e-5);
    EXPECT_LT(worst, 1.5e-5);
}

TEST(Exp2, at_the_entries_of_the_table_the_error_is_their_rounding) {
    for (uint32_t step = 0; step < 64; step++) {
        const double exact_q30 = std::exp2(-double(step) / 64.0 + 30.0);
        EXPECT_LE(std::fabs(exp2_negative_q31(step << 11) / 2.0 - exact_q30), 0.5) << step;
    }
}

TEST(Exp2, decreases_monotonically) {
    uint32_t last = exp2_negative_q31(0);
    for (uint32_t exponent_q17 = 1; exponent_q17 <= UNDERFLOW_Q17; exponent_q17++) {
        const uint32_t value = exp2_negative_q31(exponent_q17);
        ASSERT_LE(value, last) << exponent_q17;
        last = value;
    }
}

TEST(Exp2, is_one_at_zero_and_zero_where_it_underflows) {
    EXPECT_EQ(exp2_negative_q31(0), 0x80000000u);
    EXPECT_EQ(exp2_negative_q31(1u << 17), 0x40000000u);
    EXPECT_EQ(exp2_negative_q31(UINT32_MAX), 0u);
    std::mt19937 random(1);
    for (int i = 0; i < 200000; i++) {
        const auto exponent_q17 = uint32_t(random());
        ASSERT_TRUE(exponent_q17 < UNDERFLOW_Q17 || exp2_negative_q31(exponent_q17) == 0);
    }
}

} // namespace
