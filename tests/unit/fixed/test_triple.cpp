// Products by their upper word, and three numbers at a time: the C beside the instructions. That the instructions have
// the same bits is tested on the target, where both are built.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "fixed/triple.h"
}

namespace {

constexpr int32_t ENDS[] = {INT32_MIN, INT32_MIN + 1, -1, 0, 1, INT32_MAX};

int32_t any(std::mt19937 &random) {
    return random() % 4 == 0 ? ENDS[random() % 6] : int32_t(uint32_t(random())) >> (random() % 32);
}

int32_t saturated(long double value) {
    return int32_t(std::clamp(value, -2147483648.0L, 2147483647.0L));
}

long double rounded_product(int32_t a, int32_t b) {
    return std::floor(((long double)a * b + 2147483648.0L) / 4294967296.0L);
}

TEST(MultiplyHigh, is_the_nearest_of_its_format_halves_upwards) {
    std::mt19937 random(1);
    for (int i = 0; i < 200000; i++) {
        const int32_t a = any(random), b = any(random), sum = any(random) / 2;
        ASSERT_EQ(fixed_multiply_high(a, b), rounded_product(a, b)) << a << " " << b;
        ASSERT_EQ(fixed_multiply_high_add(sum, a, b), sum + rounded_product(a, b)) << a << " " << b;
    }
    EXPECT_EQ(fixed_multiply_high(1 << 16, 1 << 15), 1);
    EXPECT_EQ(fixed_multiply_high(-(1 << 16), 1 << 15), 0);
    EXPECT_EQ(fixed_multiply_high(INT32_MIN, INT32_MIN), 1 << 30);
}

TEST(MultiplyHigh, a_sum_with_the_double_saturates_twice) {
    std::mt19937 random(2);
    for (int i = 0; i < 200000; i++) {
        const int32_t a = any(random), b = any(random);
        ASSERT_EQ(fixed_add_twice(a, b), saturated((long double)a + saturated(2.0L * b))) << a << " " << b;
    }
}

TEST(MultiplyHigh, numbers_are_held_within_any_number_of_bits) {
    for (unsigned bits = 1; bits <= 32; bits++) {
        const int64_t end = int64_t(1) << (bits - 1);
        for (const int64_t value : {-end - 1, -end, -end + 1, int64_t(-1), int64_t(0), end - 2, end - 1, end}) {
            if (value >= INT32_MIN && value <= INT32_MAX) {
                EXPECT_EQ(fixed_saturate_bits(int32_t(value), bits), std::clamp(value, -end, end - 1)) << bits;
            }
        }
    }
}

TEST(Triple, dot_and_scaled_sum_round_each_product) {
    std::mt19937 random(3);
    for (int i = 0; i < 100000; i++) {
        int32_t a[3], b[3], sum[3];
        for (unsigned k = 0; k < 3; k++) {
            a[k] = any(random) / 2;
            b[k] = any(random) / 2;
            sum[k] = any(random) / 2;
        }
        const int32_t scale = any(random) / 2;
        ASSERT_EQ(triple_dot(a, b[0], b[1], b[2]),
                  rounded_product(a[0], b[0]) + rounded_product(a[1], b[1]) + rounded_product(a[2], b[2]));
        int32_t added[3] = {sum[0], sum[1], sum[2]};
        triple_add_scaled(added, a, scale);
        for (unsigned k = 0; k < 3; k++) {
            ASSERT_EQ(added[k], sum[k] + rounded_product(a[k], scale));
        }
    }
}

TEST(Triple, moves_by_inertia_and_direction_and_tells_the_dot_from_before) {
    std::mt19937 random(4);
    int saturations = 0;
    for (int i = 0; i < 100000; i++) {
        triple_moving_t start;
        int32_t direction[3];
        for (unsigned k = 0; k < 3; k++) {
            start.value[k] = any(random);
            start.change[k] = any(random);
            direction[k] = any(random) / 2;
        }
        const int32_t scale = any(random), inertia_q32 = any(random);
        triple_moving_t moved = start, told = start;
        triple_move(&moved, direction, scale, inertia_q32);
        ASSERT_EQ(triple_dot_and_move(&told, direction, scale, inertia_q32),
                  triple_dot(start.value, direction[0], direction[1], direction[2]));
        for (unsigned k = 0; k < 3; k++) {
            const auto change = rounded_product(start.change[k], inertia_q32) + rounded_product(scale, direction[k]);
            ASSERT_EQ(moved.change[k], change);
            ASSERT_EQ(moved.value[k], saturated((long double)start.value[k] + saturated(2.0L * change)));
            ASSERT_EQ(told.change[k], moved.change[k]);
            ASSERT_EQ(told.value[k], moved.value[k]);
            saturations += moved.value[k] == INT32_MAX || moved.value[k] == INT32_MIN;
        }
    }
    EXPECT_GT(saturations, 1000);
}

// A weight that neither error nor inertia moves must stay where it is, for hours.
TEST(Triple, what_is_left_of_a_change_dies_out_with_any_inertia) {
    const int32_t direction[3] = {1 << 30, -(1 << 30), 0};
    for (const int32_t inertia_q32 : {0, 1 << 27, INT32_MAX}) {
        triple_moving_t moving = {{5, -5, 0}, {1 << 30, -(1 << 30), -1}};
        for (int k = 0; k < 40; k++) {
            triple_move(&moving, direction, 0, inertia_q32);
        }
        const triple_moving_t rest = moving;
        triple_move(&moving, direction, 0, inertia_q32);
        for (unsigned k = 0; k < 3; k++) {
            EXPECT_EQ(rest.change[k], 0);
            EXPECT_EQ(moving.value[k], rest.value[k]);
        }
    }
}

} // namespace
