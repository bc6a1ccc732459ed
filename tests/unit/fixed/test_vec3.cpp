// High-word products and vectors of three: the C alternatives. That the instructions give the same bits is tested on
// the target, where both are built.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "fixed/vec3.h"
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

TEST(MultiplyHigh, rounds_to_neasettled_and_halves_upwards) {
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

TEST(MultiplyHigh, add_twice_saturates_the_double_and_the_sum) {
    std::mt19937 random(2);
    for (int i = 0; i < 200000; i++) {
        const int32_t a = any(random), b = any(random);
        ASSERT_EQ(fixed_add_twice(a, b), saturated((long double)a + saturated(2.0L * b))) << a << " " << b;
    }
}

TEST(MultiplyHigh, saturates_to_any_number_of_bits) {
    for (unsigned bits = 1; bits <= 32; bits++) {
        const int64_t end = int64_t(1) << (bits - 1);
        for (const int64_t value : {-end - 1, -end, -end + 1, int64_t(-1), int64_t(0), end - 2, end - 1, end}) {
            if (value >= INT32_MIN && value <= INT32_MAX) {
                EXPECT_EQ(fixed_saturate_bits(int32_t(value), bits), std::clamp(value, -end, end - 1)) << bits;
            }
        }
    }
}

TEST(Vec3, dot_product_and_scaled_sum_round_each_product) {
    std::mt19937 random(3);
    for (int i = 0; i < 100000; i++) {
        int32_t a[3], b[3], sum[3];
        for (unsigned k = 0; k < 3; k++) {
            a[k] = any(random) / 2;
            b[k] = any(random) / 2;
            sum[k] = any(random) / 2;
        }
        const int32_t scale = any(random) / 2;
        ASSERT_EQ(vec3_dot(a, b[0], b[1], b[2]),
                  rounded_product(a[0], b[0]) + rounded_product(a[1], b[1]) + rounded_product(a[2], b[2]));
        int32_t added[3] = {sum[0], sum[1], sum[2]};
        vec3_add_scaled(added, a, scale);
        for (unsigned k = 0; k < 3; k++) {
            ASSERT_EQ(added[k], sum[k] + rounded_product(a[k], scale));
        }
    }
}

TEST(Vec3, a_momentum_step_adds_momentum_and_gradient_and_returns_the_dot_product_before_it) {
    std::mt19937 random(4);
    int saturations = 0;
    for (int i = 0; i < 100000; i++) {
        vec3_momentum_t start;
        int32_t direction[3];
        for (unsigned k = 0; k < 3; k++) {
            start.value[k] = any(random);
            start.increment[k] = any(random);
            direction[k] = any(random) / 2;
        }
        const int32_t scale = any(random), momentum_q32 = any(random);
        vec3_momentum_t moved = start, with_dot = start;
        ASSERT_EQ(vec3_momentum_step(&moved, direction, scale, momentum_q32), &moved + 1);
        int32_t dot = 0;
        ASSERT_EQ(vec3_dot_and_momentum_step(&with_dot, direction, scale, momentum_q32, &dot), &with_dot + 1);
        ASSERT_EQ(dot, vec3_dot(start.value, direction[0], direction[1], direction[2]));
        for (unsigned k = 0; k < 3; k++) {
            const auto increment =
                rounded_product(start.increment[k], momentum_q32) + rounded_product(scale, direction[k]);
            ASSERT_EQ(moved.increment[k], increment);
            ASSERT_EQ(moved.value[k], saturated((long double)start.value[k] + saturated(2.0L * increment)));
            ASSERT_EQ(with_dot.increment[k], moved.increment[k]);
            ASSERT_EQ(with_dot.value[k], moved.value[k]);
            saturations += moved.value[k] == INT32_MAX || moved.value[k] == INT32_MIN;
        }
    }
    EXPECT_GT(saturations, 1000);
}

// A weight without error must become constant, not drift for hours.
TEST(Vec3, increments_without_a_gradient_decay_to_zero_with_any_momentum) {
    const int32_t direction[3] = {1 << 30, -(1 << 30), 0};
    for (const int32_t momentum_q32 : {0, 1 << 27, INT32_MAX}) {
        vec3_momentum_t vector = {{5, -5, 0}, {1 << 30, -(1 << 30), -1}};
        for (int k = 0; k < 40; k++) {
            vec3_momentum_step(&vector, direction, 0, momentum_q32);
        }
        const vec3_momentum_t settled = vector;
        vec3_momentum_step(&vector, direction, 0, momentum_q32);
        for (unsigned k = 0; k < 3; k++) {
            EXPECT_EQ(settled.increment[k], 0);
            EXPECT_EQ(vector.value[k], settled.value[k]);
        }
    }
}

} // namespace
