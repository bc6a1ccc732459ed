// Dual 16-bit multiply-accumulate against 64-bit arithmetic.
#include <algorithm>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "fixed/dual16.h"
}

namespace {

TEST(Dual16, is_exact_wherever_the_sum_fits) {
    std::mt19937 random(1);
    const auto any = [&] {
        const int16_t ends[] = {INT16_MIN, INT16_MIN + 1, -1, 0, 1, INT16_MAX};
        return random() % 4 == 0 ? ends[random() % 6] : int16_t(random());
    };
    int compared = 0;
    for (int i = 0; i < 1000000; i++) {
        const int16_t value[3] = {any(), any(), any()};
        const int16_t *two = &value[random() % 2]; // aligned to 32 bits or not
        const int16_t first = any(), second = any();
        const int32_t sum = random() % 4 == 0 ? 0 : int32_t(uint32_t(random()));
        const int64_t exact = sum + int64_t(two[0]) * first + int64_t(two[1]) * second;
        const int64_t products = exact - sum;
        if (std::max(exact, products) > INT32_MAX || std::min(exact, sum + int64_t(two[0]) * first) < INT32_MIN ||
            sum + int64_t(two[0]) * first > INT32_MAX) {
            continue;
        }
        ASSERT_EQ(dual16_multiply_add(two, dual16_pack(first, second), sum), exact);
        compared++;
    }
    EXPECT_GT(compared, 300000);
}

} // namespace
