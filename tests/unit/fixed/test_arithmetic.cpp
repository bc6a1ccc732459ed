// Saturating arithmetic against 128-bit integers.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <random>
#include <vector>

#include <gtest/gtest.h>

extern "C" {
#include "fixed/fixed.h"
}

namespace {

__extension__ typedef __int128 wide_t;

const std::vector<int32_t> CORNERS = {
    INT32_MIN, INT32_MIN + 1, -0x40000001, -0x40000000, -65536,     -32769,        -32768,   -3, -2, -1, 0, 1, 2, 3,
    32767,     32768,         65535,       0x3FFFFFFF,  0x40000000, INT32_MAX - 1, INT32_MAX};

// Corners and random numbers of every magnitude.
std::vector<int32_t> samples(unsigned seed, int count) {
    std::vector<int32_t> values = CORNERS;
    std::mt19937 random(seed);
    for (int i = 0; i < count; i++) {
        const auto value = int32_t(uint32_t(random()));
        values.push_back(value >> (random() % 31));
    }
    return values;
}

int32_t saturated(wide_t value) {
    return value > INT32_MAX ? INT32_MAX : value < INT32_MIN ? INT32_MIN : int32_t(value);
}

// floor(value / 2^shift + 1/2)
wide_t halves_up(wide_t value, unsigned shift) {
    const wide_t one = wide_t(1) << shift;
    const wide_t sum = value + one / 2;
    const wide_t quotient = sum / one;
    return sum % one < 0 ? quotient - 1 : quotient;
}

TEST(FixedArithmetic, saturate_keeps_what_fits_and_clips_the_rest) {
    for (const int32_t value : CORNERS) {
        EXPECT_EQ(fixed_saturate(value), value);
    }
    EXPECT_EQ(fixed_saturate(int64_t(INT32_MAX) + 1), INT32_MAX);
    EXPECT_EQ(fixed_saturate(int64_t(INT32_MIN) - 1), INT32_MIN);
    EXPECT_EQ(fixed_saturate(INT64_MAX), INT32_MAX);
    EXPECT_EQ(fixed_saturate(INT64_MIN), INT32_MIN);
}

TEST(FixedArithmetic, clamp_limits_at_both_ends) {
    EXPECT_EQ(fixed_clamp(6, -5, 5), 5);
    EXPECT_EQ(fixed_clamp(5, -5, 5), 5);
    EXPECT_EQ(fixed_clamp(-5, -5, 5), -5);
    EXPECT_EQ(fixed_clamp(-6, -5, 5), -5);
    EXPECT_EQ(fixed_clamp(INT32_MIN, INT32_MIN, INT32_MAX), INT32_MIN);
    EXPECT_EQ(fixed_clamp(7, 3, 3), 3);
}

TEST(FixedArithmetic, sum_difference_and_magnitude_saturate) {
    const std::vector<int32_t> values = samples(1, 300);
    for (const int32_t a : values) {
        ASSERT_EQ(fixed_abs(a), saturated(a < 0 ? -wide_t(a) : wide_t(a)));
        for (const int32_t b : values) {
            ASSERT_EQ(fixed_add(a, b), saturated(wide_t(a) + b)) << a << " + " << b;
            ASSERT_EQ(fixed_subtract(a, b), saturated(wide_t(a) - b)) << a << " - " << b;
        }
    }
}

TEST(FixedArithmetic, products_are_exact_accumulation_wraps_and_the_high_word_is_rounded) {
    const std::vector<int32_t> values = samples(7, 300);
    for (const int32_t a : values) {
        for (const int32_t b : values) {
            const wide_t product = wide_t(a) * b;
            ASSERT_EQ(fixed_product(a, b), int64_t(product));
            ASSERT_EQ(fixed_multiply_high(a, b), int32_t(halves_up(product, 32))) << a << " * " << b;
            for (const int64_t sum : {int64_t(0), int64_t(-1), INT64_MAX, INT64_MIN}) {
                ASSERT_EQ(fixed_accumulate(sum, a, b), int64_t(uint64_t(sum) + uint64_t(int64_t(product))));
            }
        }
    }
}

TEST(FixedArithmetic, shift_saturate_rounds_down_what_fits_and_saturates_the_rest_to_within_its_last_bits) {
    const auto expect = [](int64_t value, unsigned shift, int32_t result) {
        const wide_t exact = (wide_t(value) - (value < 0 ? (wide_t(1) << shift) - 1 : 0)) / (wide_t(1) << shift);
        if (saturated(exact) == exact) {
            ASSERT_EQ(result, exact) << value << " >> " << shift;
        } else {
            ASSERT_LE(std::abs(double(result) - double(saturated(exact))), std::ldexp(1.0, int(32 - shift)));
        }
    };
    const std::vector<int32_t> values = samples(8, 300);
    for (const int32_t a : values) {
        for (const int32_t b : values) {
            const int64_t value = int64_t(a) * b;
            expect(value, 1, fixed_shift_saturate(value, 1));
            expect(value, 4, fixed_shift_saturate(value, 4));
            expect(value, 14, fixed_shift_saturate(value, 14));
            expect(value, 28, fixed_shift_saturate(value, 28));
            expect(value, 31, fixed_shift_saturate(value, 31));
        }
    }
    EXPECT_GT(fixed_shift_saturate(INT64_MAX, 28), INT32_MAX - 16);
    EXPECT_LT(fixed_shift_saturate(INT64_MIN, 28), INT32_MIN + 16);
}

TEST(FixedArithmetic, shift_rounds_halves_towards_plus_infinity) {
    EXPECT_EQ(fixed_shift(1, 1), 1);
    EXPECT_EQ(fixed_shift(-1, 1), 0);
    EXPECT_EQ(fixed_shift(3, 1), 2);
    EXPECT_EQ(fixed_shift(-3, 1), -1);
    EXPECT_EQ(fixed_shift(-5, 2), -1);
    EXPECT_EQ(fixed_shift(-6, 2), -1);
    EXPECT_EQ(fixed_shift(-7, 2), -2);
}

TEST(FixedArithmetic, shift_is_exact_to_the_ends_of_its_range) {
    std::mt19937_64 random(2);
    for (unsigned shift = 1; shift <= 62; shift++) {
        const int64_t end = INT64_MAX - (int64_t(1) << (shift - 1));
        for (const int64_t value : {end, end - 1, INT64_MIN, INT64_MIN + 1, int64_t(0), int64_t(1), int64_t(-1)}) {
            ASSERT_TRUE(fixed_shift(value, shift) == halves_up(value, shift)) << value << " >> " << shift;
        }
        for (int i = 0; i < 2000; i++) {
            const int64_t value = int64_t(random()) >> (1 + random() % 60);
            const int64_t clipped = value > end ? end : value;
            ASSERT_TRUE(fixed_shift(clipped, shift) == halves_up(clipped, shift)) << clipped << " >> " << shift;
        }
    }
}

TEST(FixedArithmetic, product_is_rounded_and_saturated_for_all_arguments) {
    const std::vector<int32_t> values = samples(3, 80);
    for (unsigned shift = 1; shift <= 62; shift++) {
        for (const int32_t a : values) {
            for (const int32_t b : values) {
                ASSERT_EQ(fixed_multiply(a, b, shift), saturated(halves_up(wide_t(a) * b, shift)))
                    << a << " * " << b << " >> " << shift;
            }
        }
    }
}

TEST(FixedArithmetic, constants_are_the_nearest_numbers) {
    EXPECT_EQ(FIXED_CONSTANT(1, 2, 15), 16384);
    EXPECT_EQ(FIXED_CONSTANT(191, 10, 24), 320444826); // 320444825.6
    EXPECT_EQ(FIXED_CONSTANT(1, 3, 16), 21845);        // 21845.3
    EXPECT_EQ(FIXED_CONSTANT(2, 3, 16), 43691);        // 43690.7
    EXPECT_EQ(FIXED_CONSTANT(0, 7, 24), 0);
}

TEST(FixedArithmetic, magnitudes_and_saturations_to_fewer_bits_are_exact_for_any_value) {
    for (const int32_t value : samples(9, 20000)) {
        ASSERT_EQ(fixed_magnitude(value), uint32_t(std::llabs(int64_t(value))));
        ASSERT_EQ(fixed_non_negative(value), std::max(value, 0));
        ASSERT_EQ(fixed_saturate_u16(value), std::clamp(value, 0, 65535));
        ASSERT_EQ(fixed_clamp_64(int64_t(value) << 20, -(INT64_C(1) << 45), INT64_C(1) << 44),
                  std::clamp(int64_t(value) << 20, -(INT64_C(1) << 45), INT64_C(1) << 44));
        ASSERT_EQ(fixed_shift_up_saturate_bits(value >> 8, 8, 20),
                  std::clamp(value >> 8 << 8, -(1 << 19), (1 << 19) - 1));
        ASSERT_EQ(fixed_shift_up_saturate_bits(value >> 3, 3, 32), value >> 3 << 3);
    }
}

TEST(FixedArithmetic, shift_below_is_the_least_that_brings_a_magnitude_below_and_0_for_one_that_is) {
    for (unsigned bits : {1u, 30u, 63u}) {
        EXPECT_EQ(fixed_shift_below(0, bits), 0u);
        EXPECT_EQ(fixed_shift_below((UINT64_C(1) << bits) - 1, bits), 0u);
        EXPECT_EQ(fixed_shift_below(UINT64_C(1) << bits, bits), 1u);
        EXPECT_EQ(fixed_shift_below(UINT64_MAX, bits), 64u - bits);
    }
    EXPECT_EQ(fixed_shift_below(UINT64_C(5) << 40, 30), 13u);
}

TEST(FixedArithmetic, products_that_are_shifted_round_as_stated_and_saturate_to_within_their_last_bits) {
    const std::vector<int32_t> values = samples(10, 300);
    const auto expect = [](int32_t result, wide_t exact, unsigned shift) {
        if (saturated(exact) == exact) {
            ASSERT_EQ(result, int32_t(exact)) << shift;
        } else {
            ASSERT_LE(std::abs(double(result) - double(saturated(exact))), std::ldexp(1.0, int(32 - shift))) << shift;
        }
    };
    for (const int32_t a : values) {
        for (const int32_t b : values) {
            const wide_t product = wide_t(a) * b;
            ASSERT_NO_FATAL_FAILURE(expect(fixed_multiply_shift(a, b, 6), halves_up(product, 6), 6));
            ASSERT_NO_FATAL_FAILURE(expect(fixed_multiply_shift(a, b, 18), halves_up(product, 18), 18));
            ASSERT_NO_FATAL_FAILURE(expect(fixed_multiply_shift(a, b, 31), halves_up(product, 31), 31));
            ASSERT_NO_FATAL_FAILURE(expect(fixed_product_shift_saturate(a, b, 4), product >> 4, 4));
            ASSERT_NO_FATAL_FAILURE(expect(fixed_product_shift_saturate(a, b, 14), product >> 14, 14));
            ASSERT_NO_FATAL_FAILURE(expect(fixed_product_shift_saturate(a, b, 28), product >> 28, 28));
        }
    }
}

} // namespace
