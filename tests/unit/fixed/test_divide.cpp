// 64-bit division against the compiler's.
#include <cstdint>
#include <limits>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "fixed/divide.h"
}

namespace {

constexpr int64_t MINIMUM = std::numeric_limits<int64_t>::min();
constexpr int64_t MAXIMUM = std::numeric_limits<int64_t>::max();

TEST(Divide, equals_c_division_at_the_ends_of_both_ranges) {
    const int64_t numerators[] = {MINIMUM, MINIMUM + 1, -MAXIMUM / 2, -3, -2, -1, 0, 1, 2, 3, MAXIMUM / 2, MAXIMUM};
    const int64_t denominators[] = {1, 2, 3, 10, int64_t{1} << 32, MAXIMUM - 1, MAXIMUM};
    for (const int64_t numerator : numerators) {
        for (const int64_t denominator : denominators) {
            EXPECT_EQ(fixed_divide(numerator, denominator), numerator / denominator) << numerator << "/" << denominator;
        }
    }
}

TEST(Divide, equals_c_division_for_numbers_of_every_length) {
    std::mt19937_64 random(1);
    for (int i = 0; i < 200000; ++i) {
        const auto numerator = static_cast<int64_t>(random()) >> (random() % 64);
        const auto denominator = static_cast<int64_t>((random() >> 1 >> (random() % 63)) | 1);
        ASSERT_EQ(fixed_divide(numerator, denominator), numerator / denominator) << numerator << "/" << denominator;
    }
}

} // namespace
