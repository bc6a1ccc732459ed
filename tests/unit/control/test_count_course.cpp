// Course of the counts: its speed against the formula in double precision, and its limits.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/count_course.h"
#include "control/load_observer.h"
}

#include "support/reference_builders.h"
#include "support/wide_integer.h"

namespace {

using namespace fixed_point;
constexpr uint32_t RATE_HZ = 40000;
constexpr unsigned BITS = 10;
constexpr uint32_t COUNT = 1u << (32 - BITS);
constexpr double COUNT_RAD = 2.0 * PI / (1 << BITS);

struct CountCourse : testing::Test {
    count_course_parameters_t parameters =
        count_course_configure(load_observer_model(RATE_HZ, to_fixed(0.02, Q30), 0).angle_step_q32, BITS);
    count_course_t course = {};

    double step_rad_s(double reference_rad_s, uint32_t angle, uint32_t periods = 1) {
        return count_course_step(&parameters, &course, to_fixed(reference_rad_s, Q22), angle, periods) / Q22;
    }
};

TEST_F(CountCourse, is_the_integral_of_the_reference) {
    for (const double speed : {0.05, -0.05, 3.0, -3.0}) {
        const uint32_t start = 0xFFFFF000;
        count_course_begin(&course, start);
        double rad = 0.0;
        for (int k = 0; k < 20000; k++) {
            const uint32_t periods = k % 100 == 0 ? 3 : 1;
            rad += speed * periods / RATE_HZ;
            const auto follower = uint32_t(int64_t(start) + std::llround(rad / (2.0 * PI) * REV));
            EXPECT_NEAR(step_rad_s(speed, follower, periods), 0.0, 1e-5);
        }
    }
}

TEST_F(CountCourse, makes_up_for_a_count_in_the_time_of_a_count_between_a_tenth_and_a_quarter_of_a_second) {
    for (const double counts_per_s : {0.0, 1.0, 4.0, 7.0, 10.0, 1000.0}) {
        for (const double direction : {1.0, -1.0}) {
            const double speed = direction * counts_per_s * COUNT_RAD;
            for (const double counts : {-1.0, -0.5, -0.01, 0.25, 1.0}) {
                count_course_begin(&course, 0);
                const double rate = std::fmin(std::fmax(counts_per_s, 4.0), 10.0);
                const auto behind = uint32_t(std::llround((speed / RATE_HZ / COUNT_RAD - counts) * COUNT));
                EXPECT_NEAR(step_rad_s(speed, behind), rate * counts * COUNT_RAD, 1e-6) << speed << " " << counts;
            }
        }
    }
}

// Neither reversal nor more than twice the reference, where counts are so slow that they set the rate.
TEST_F(CountCourse, waits_for_a_rotor_that_is_more_than_a_count_off) {
    const double speed = 6.0 * COUNT_RAD;
    for (const int32_t off : {3, -3, 500, -500}) {
        count_course_begin(&course, 0);
        const auto angle = uint32_t(off * int32_t(COUNT));
        EXPECT_NEAR(speed + step_rad_s(speed, angle), off > 0 ? 0.0 : 2.0 * speed, 1e-5);
        EXPECT_EQ(int32_t(uint32_t(course.angle_q64 >> 32) - angle), (off > 0 ? -1 : 1) * int32_t(COUNT));
    }
}

TEST_F(CountCourse, is_rounded_to_4_lsb_and_its_angle_exact_for_any_encoder_reference_and_angle) {
    using namespace wide_integer;
    std::mt19937 random(1);
    double worst = 0.0;
    int within = 0;
    for (int i = 0; i < 200000; i++) {
        const unsigned bits = 8 + random() % 23;
        const count_course_parameters_t p = count_course_configure(parameters.angle_step_q32, bits);
        const int32_t count = 1 << (32 - bits);
        const int32_t reference_q22 = any(random);
        const uint32_t periods = 1 + random() % 8, start = uint32_t(random());
        const wide_t turned_q64 = wide_t(reference_q22) * p.angle_step_q32 * periods;
        const auto reached = uint32_t(uint64_t((wide_t(start) << 32) + turned_q64) >> 32);
        const int32_t ahead = any(random) >> random() % 8 >> random() % bits;
        count_course_begin(&course, start);
        const int32_t result_q22 = count_course_step(&p, &course, reference_q22, reached - uint32_t(ahead), periods);
        const int32_t error = std::clamp(ahead, -count, count);
        const int32_t rate_q22 = std::clamp(saturated(std::abs(int64_t(reference_q22))), p.least_q22, p.most_q22);
        const double off = std::fabs(result_q22 - double(rate_q22) * error / count);
        ASSERT_LE(off, 2.0) << bits << " bits, " << reference_q22 << " " << ahead;
        ASSERT_EQ(int32_t(uint32_t(course.angle_q64 >> 32) - reached), error - ahead);
        ASSERT_EQ(uint32_t(course.angle_q64), uint32_t(uint64_t(turned_q64))) << "what is below 2^-32 rev is kept";
        worst = std::max(worst, off);
        within += ahead == error && error != 0;
    }
    EXPECT_GT(worst, 1.9);
    EXPECT_GT(within, 50000);
}

} // namespace
