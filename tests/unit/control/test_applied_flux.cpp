// Flux linkage by the applied voltage, against its sum in double precision.
#include <algorithm>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/applied_flux.h"
}

#include "support/fixed_point.h"

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

} // namespace
