// Compare values for every duty.
#include <cmath>
#include <cstdint>

#include <gtest/gtest.h>

extern "C" {
#include "control/modulator.h"
}

namespace {

// Mean phase voltage over a period as a share of Vdc, by the timer's definition in hal_pwm.h: both on +1, one on 0,
// both off -1. The carriers are half a period apart, so what is partial is only ever one of the two.
double mean_voltage(const hal_pwm_compare_t &compare, unsigned phase, uint16_t period_ticks) {
    const auto share = [&](uint16_t ticks) { return ticks >= period_ticks ? 1.0 : double(ticks) / period_ticks; };
    return share(compare.upper[phase]) + share(compare.lower[phase]) - 1.0;
}

TEST(Pwm, mean_voltage_is_the_duty_to_half_a_tick_for_every_duty) {
    for (const uint16_t period_ticks : {1000, 2000, 2500, 5000, 32767}) {
        for (int32_t duty_q15 = -32768; duty_q15 <= 32768; duty_q15++) {
            hal_pwm_compare_t compare{};
            pwm_set_phase(&compare, 0, duty_q15, period_ticks);
            ASSERT_LE(std::fabs(mean_voltage(compare, 0, period_ticks) - duty_q15 / 32768.0), 0.5001 / period_ticks)
                << duty_q15;
            ASSERT_LE(compare.upper[0], period_ticks);
            ASSERT_LE(compare.lower[0], period_ticks);
        }
    }
}

TEST(Pwm, states_are_plus_one_and_zero_or_minus_one_and_zero_and_one_switch_switches) {
    for (int32_t duty_q15 = -32768; duty_q15 <= 32768; duty_q15++) {
        hal_pwm_compare_t compare{};
        pwm_set_phase(&compare, 0, duty_q15, 2500);
        if (duty_q15 >= 0) {
            ASSERT_EQ(compare.lower[0], 2500) << "the lower switch is on throughout";
        } else {
            ASSERT_EQ(compare.upper[0], 0) << "the upper switch is off throughout";
        }
    }
}

TEST(Pwm, the_ends_and_zero_are_exact) {
    const auto expect = [](int32_t duty_q15, uint16_t upper, uint16_t lower) {
        hal_pwm_compare_t compare{};
        pwm_set_phase(&compare, 2, duty_q15, 2500);
        EXPECT_EQ(compare.upper[2], upper) << duty_q15;
        EXPECT_EQ(compare.lower[2], lower) << duty_q15;
    };
    expect(32768, 2500, 2500);
    expect(0, 0, 2500);
    expect(-32768, 0, 0);
    expect(16384, 1250, 2500);
    expect(-16384, 0, 1250);
}

TEST(Pwm, a_state_is_the_whole_period_s_duty_of_the_same_voltage) {
    for (const int state : {-1, 0, 1}) {
        for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
            hal_pwm_compare_t by_state = {{11, 12, 13, 14}, {21, 22, 23, 24}}, by_duty = by_state;
            pwm_set_state(&by_state, phase, state, 2500);
            pwm_set_phase(&by_duty, phase, state * 32768, 2500);
            for (unsigned other = 0; other < HAL_PHASES_MAX; other++) {
                EXPECT_EQ(by_state.upper[other], by_duty.upper[other]);
                EXPECT_EQ(by_state.lower[other], by_duty.lower[other]);
            }
        }
    }
}

TEST(Pwm, voltage_never_falls_when_the_duty_rises) {
    double last = -1.0;
    for (int32_t duty_q15 = -32768; duty_q15 <= 32768; duty_q15++) {
        hal_pwm_compare_t compare{};
        pwm_set_phase(&compare, 0, duty_q15, 1000);
        const double voltage = mean_voltage(compare, 0, 1000);
        ASSERT_GE(voltage, last);
        last = voltage;
    }
    EXPECT_EQ(last, 1.0);
}

TEST(Pwm, two_pulses_have_the_duty_for_their_mean_voltage_to_half_a_tick_for_every_duty) {
    for (const uint16_t period_ticks : {100, 1000, 2000, 2500, 5000, 32767}) {
        double last = -1.0;
        for (int32_t duty_q15 = -32768; duty_q15 <= 32768; duty_q15++) {
            hal_pwm_compare_t compare{};
            pwm_set_phase_twice(&compare, 0, duty_q15, period_ticks);
            const double voltage = mean_voltage(compare, 0, period_ticks);
            ASSERT_LE(std::fabs(voltage - duty_q15 / 32768.0), 0.5001 / period_ticks) << duty_q15;
            ASSERT_GE(voltage, last) << "never falls when the duty rises";
            ASSERT_LE(compare.upper[0], period_ticks);
            ASSERT_LE(compare.lower[0], period_ticks);
            last = voltage;
        }
    }
}

TEST(Pwm, two_pulses_are_half_as_long_each_and_a_state_of_the_other_sign_never_appears) {
    const uint16_t period_ticks = 2500;
    for (int32_t duty_q15 = -32768; duty_q15 <= 32768; duty_q15++) {
        hal_pwm_compare_t compare{};
        pwm_set_phase_twice(&compare, 0, duty_q15, period_ticks);
        // Both on, a quarter from either end, as long as the sum is beyond the period; both off as long as it is not.
        const int together = int(compare.upper[0]) + compare.lower[0] - period_ticks;
        ASSERT_EQ(together > 0, duty_q15 * double(period_ticks) >= 16384.0) << duty_q15;
        ASSERT_LE(std::abs(int(compare.upper[0]) - compare.lower[0]), 1) << "in equal parts";
    }
}

TEST(Pwm, two_pulses_are_exact_at_the_ends) {
    const auto expect = [](int32_t duty_q15, uint16_t upper, uint16_t lower) {
        hal_pwm_compare_t compare{};
        pwm_set_phase_twice(&compare, 1, duty_q15, 2500);
        EXPECT_EQ(compare.upper[1], upper) << duty_q15;
        EXPECT_EQ(compare.lower[1], lower) << duty_q15;
    };
    expect(32768, 2500, 2500);
    expect(0, 1250, 1250);
    expect(-32768, 0, 0);
    expect(16384, 1875, 1875);
    expect(-16384, 625, 625);
}

TEST(Pwm, other_phases_are_left_alone) {
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        hal_pwm_compare_t compare = {{11, 12, 13, 14}, {21, 22, 23, 24}};
        pwm_set_phase(&compare, phase, 100, 2500);
        pwm_set_phase_twice(&compare, phase, 100, 2500);
        for (unsigned other = 0; other < HAL_PHASES_MAX; other++) {
            if (other != phase) {
                EXPECT_EQ(compare.upper[other], 11 + other);
                EXPECT_EQ(compare.lower[other], 21 + other);
            }
        }
    }
}

} // namespace
