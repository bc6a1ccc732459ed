// Linear interpolation against double precision.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "fixed/interpolate.h"
}

namespace {

void expect_nearest(const int16_t (&table)[2], uint32_t fraction, unsigned fraction_bits) {
    const int32_t value = interpolate_linear(table, 0, fraction, fraction_bits);
    const double exact = table[0] + (double(table[1]) - table[0]) * fraction / double(1u << fraction_bits);
    ASSERT_LE(std::fabs(value - exact), 0.5) << table[0] << " " << table[1] << " at " << fraction;
    ASSERT_GE(value, std::min(table[0], table[1]));
    ASSERT_LE(value, std::max(table[0], table[1]));
}

TEST(Interpolate, is_rounded_to_nearest_between_extreme_entries_for_every_fraction) {
    for (const auto &[low, high] : {std::pair{INT16_MIN, INT16_MAX}, {INT16_MAX, INT16_MIN}, {0, 1}, {-1, 0}, {5, 5}}) {
        const int16_t table[2] = {int16_t(low), int16_t(high)};
        for (uint32_t fraction = 0; fraction < 65536; fraction++) {
            ASSERT_NO_FATAL_FAILURE(expect_nearest(table, fraction, 16));
        }
    }
}

TEST(Interpolate, is_rounded_to_nearest_for_random_entries_and_all_fraction_widths) {
    std::mt19937 random(1);
    for (int i = 0; i < 200000; i++) {
        const int16_t table[2] = {int16_t(random()), int16_t(random())};
        const unsigned bits = 1 + random() % 16;
        ASSERT_NO_FATAL_FAILURE(expect_nearest(table, random() % (1u << bits), bits));
    }
}

TEST(Interpolate, equals_the_entry_at_fraction_zero) {
    const int16_t table[4] = {-32768, 12, 32767, -7};
    for (uint32_t index = 0; index < 3; index++) {
        EXPECT_EQ(interpolate_linear(table, index, 0, 7), table[index]);
    }
}

} // namespace
