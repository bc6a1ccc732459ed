// Flux linkage by the applied voltage, against its sum in double precision.
#include <algorithm>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/applied_flux.h"
}

#include "support/fixed_point.h"
#include "support/wide_integer.h"

namespace {

using namespace fixed_point;
constexpr double PERIOD_S = 25e-6, RESISTANCE_OHM = 0.05;
constexpr uint32_t RANGE_Q9 = 80 * 512;

TEST(AppliedFlux, follows_the_sum_of_voltage_less_resistive_drop_within_2_LSB_a_period) {
    const int32_t resistance_q40 = to_fixed(RESISTANCE_OHM * PERIOD_S, Q40);
    std::mt19937 random(3);
    applied_flux_t flux{};
    double model[3] = {}, worst = 0.0, most = 0.0, least = 0.0;
    constexpr int PERIODS = 4000;
    for (int k = 0; k < PERIODS; k++) {
        const double voltage = 200.0 + double(random() % 80);
        const int32_t period_q29 = applied_flux_period_q29(to_fixed(voltage, 64.0), to_fixed(PERIOD_S, Q40));
        EXPECT_NEAR(period_q29 / Q29, voltage * PERIOD_S, 1e-8);
        int32_t duty_q15[4] = {}, current_q9[4] = {};
        for (int phase = 0; phase < 3; phase++) {
            duty_q15[phase] = int32_t(random() % 65537) - 32768;
            current_q9[phase] = k / 8 % 2 == 0 ? int32_t(random() % (60 * 512)) : int32_t(RANGE_Q9 / 64);
        }
        const applied_flux_period_t period =
            applied_flux_period(to_fixed(voltage, 64.0), to_fixed(PERIOD_S, Q40), resistance_q40, RANGE_Q9);
        for (int phase = 0; phase < 3; phase++) {
            applied_flux_step(&flux, &period, unsigned(phase), duty_q15[phase], current_q9[phase]);
            const double drop = current_q9[phase] / 512.0 * resistance_q40 / Q40;
            const bool none = current_q9[phase] <= int32_t(RANGE_Q9 / 64);
            const double now = none ? std::max(0.0, model[phase]) : model[phase];
            EXPECT_NEAR(flux.at_sample_q29[phase] / Q29, now, 1e-5);
            model[phase] = now + duty_q15[phase] / 32768.0 * period_q29 / Q29 - drop;
            least = std::min(least, model[phase]);
            worst = std::max(worst, std::abs(flux.next_q29[phase] / Q29 - model[phase]));
            most = std::max(most, model[phase]);
        }
        EXPECT_EQ(flux.next_q29[3], 0);
    }
    EXPECT_LT(worst, 2.0 * PERIODS / Q29);
    EXPECT_GT(most, 0.03);
    EXPECT_LT(least, -0.003);
}

TEST(AppliedFlux, saturates_and_ends_at_0_without_a_current) {
    applied_flux_t flux{};
    const applied_flux_period_t period = {.full_q32 = ((1 << 27) - 1) * 8, .against_q40 = 0, .none_q9 = 640};
    constexpr int32_t ON = 32768, OFF = -32768;
    for (int k = 0; k < 40; k++) {
        applied_flux_step(&flux, &period, 3, ON, 0);
    }
    EXPECT_EQ(flux.next_q29[3], INT32_MAX);
    for (int k = 0; k < 16; k++) {
        EXPECT_GT(flux.next_q29[3], 0);
        applied_flux_step(&flux, &period, 3, OFF, 0);
    }
    applied_flux_step(&flux, &period, 3, OFF, 0);
    applied_flux_step(&flux, &period, 3, OFF, 0);
    EXPECT_EQ(flux.at_sample_q29[3], 0);
    EXPECT_EQ(flux.next_q29[0], 0);
}

// As at the end of a start at 20 kHz, where the opposite voltage of a period is several times the flux linkage.
TEST(AppliedFlux, a_pulse_after_a_period_that_ended_the_current_begins_at_0) {
    const applied_flux_period_t period = {.full_q32 = 1 << 26, .against_q40 = 0, .none_q9 = 640};
    applied_flux_t flux{};
    applied_flux_step(&flux, &period, 0, 8192, 0);
    EXPECT_EQ(flux.next_q29[0], 1 << 21);
    applied_flux_step(&flux, &period, 0, -32768, 6400);
    EXPECT_EQ(flux.at_sample_q29[0], 1 << 21);
    applied_flux_step(&flux, &period, 0, 16384, 0);
    EXPECT_EQ(flux.at_sample_q29[0], 0);
    applied_flux_step(&flux, &period, 0, 0, 6400);
    EXPECT_EQ(flux.at_sample_q29[0], 1 << 22);
}

TEST(AppliedFlux, falls_below_0_while_there_is_a_current) {
    applied_flux_t flux{};
    const applied_flux_period_t period = {.full_q32 = 1 << 20, .against_q40 = 0, .none_q9 = 640};
    applied_flux_step(&flux, &period, 0, -32768, 641);
    EXPECT_EQ(flux.next_q29[0], -(1 << 17));
    applied_flux_step(&flux, &period, 0, -32768, 640);
    EXPECT_EQ(flux.at_sample_q29[0], 0);
    EXPECT_EQ(flux.next_q29[0], -(1 << 17));
}

TEST(AppliedFlux, a_period_errs_by_half_an_LSB_for_each_product_and_its_sum_saturates_for_any_arguments) {
    using namespace wide_integer;
    std::mt19937 random(4);
    int inside = 0;
    for (int i = 0; i < 200000; i++) {
        applied_flux_t flux{};
        const int32_t start_q29 = any(random), current_q9 = any_up_to(random, (1 << 16) - 1);
        const int32_t duty_q15 = any_up_to(random, 65536) - 32768;
        const applied_flux_period_t period = {any_up_to(random, 1 << 30), -any_up_to(random, INT32_MAX), 640};
        flux.next_q29[2] = start_q29;
        applied_flux_step(&flux, &period, 2, duty_q15, current_q9);
        const int32_t now_q29 = current_q9 > 640 ? start_q29 : std::max(start_q29, 0);
        EXPECT_EQ(flux.at_sample_q29[2], now_q29);
        // Twice the change, in units of 2^-32 LSB: duty Q15 by Wb Q32, current Q9 by ohm s Q40.
        const wide_t gained = wide_t(duty_q15) * period.full_q32 * power_of_2(15);
        const wide_t dropped = wide_t(current_q9) * period.against_q40 * power_of_2(13);
        const double then = now_q29 + double(gained + dropped) / 8589934592.0;
        const double least = -2147483648.0;
        ASSERT_LE(std::fabs(flux.next_q29[2] - std::clamp(then, least, 2147483647.0)), 1.0001)
            << start_q29 << " " << duty_q15 << " " << current_q9;
        inside += then > least && then < 2147483647.0;
    }
    EXPECT_GT(inside, 80000) << "of 200000";
}

TEST(AppliedFlux, independent_errors_together_are_within_12_percent_of_the_root_of_the_sum_of_their_squares) {
    std::mt19937 random(5);
    double least = 2.0, most = 0.0;
    for (int i = 0; i < 100000; i++) {
        const int64_t a = 1000 + wide_integer::any_up_to(random, INT32_MAX - 1000), b = int64_t(a * (random() / REV));
        const double ratio = double(applied_flux_independent(a, b)) / std::hypot(double(a), double(b));
        ASSERT_EQ(applied_flux_independent(b, a), applied_flux_independent(a, b));
        least = std::min(least, ratio);
        most = std::max(most, ratio);
    }
    EXPECT_GT(least, 0.88);
    EXPECT_LT(least, 0.89) << "of equal ones";
    EXPECT_LT(most, 1.12);
    EXPECT_GT(most, 1.03);
}

} // namespace
