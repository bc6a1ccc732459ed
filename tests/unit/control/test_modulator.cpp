// Compare values for every duty.
#include <cmath>
#include <cstdint>

#include <gtest/gtest.h>

extern "C" {
#include "control/modulator.h"
}

namespace {

// Mean phase voltage over a period as a fraction of Vdc, by the timer's definition in hal_pwm.h: both switches on +1,
// one on 0, both off -1. The carriers are half a period apart, so only one of two partial pulses counts at a time.
double mean_voltage(const hal_pwm_compare_t &compare, unsigned phase, uint16_t period_ticks) {
    const auto share = [&](uint16_t ticks) { return ticks >= period_ticks ? 1.0 : double(ticks) / period_ticks; };
    return share(compare.upper[phase]) + share(compare.lower[phase]) - 1.0;
}

// Compare values of one duty, in phase 0.
hal_pwm_compare_t compare_of(int32_t duty_q15, uint16_t period_ticks, bool interleaved = false) {
    hal_pwm_compare_t compare{};
    modulate(&duty_q15, 1, period_ticks, interleaved, &compare);
    return compare;
}

void expect_compare(int32_t duty_q15, bool interleaved, uint16_t upper, uint16_t lower) {
    const hal_pwm_compare_t compare = compare_of(duty_q15, 2500, interleaved);
    EXPECT_EQ(compare.upper[0], upper) << duty_q15;
    EXPECT_EQ(compare.lower[0], lower) << duty_q15;
}

TEST(Modulator, mean_voltage_is_the_duty_within_half_a_tick_for_every_duty) {
    for (const uint16_t period_ticks : {1000, 2000, 2500, 5000, 32767}) {
        for (int32_t duty_q15 = -32768; duty_q15 <= 32768; duty_q15++) {
            const hal_pwm_compare_t compare = compare_of(duty_q15, period_ticks);
            ASSERT_LE(std::fabs(mean_voltage(compare, 0, period_ticks) - duty_q15 / 32768.0), 0.5001 / period_ticks)
                << duty_q15;
            ASSERT_LE(compare.upper[0], period_ticks);
            ASSERT_LE(compare.lower[0], period_ticks);
        }
    }
}

TEST(Modulator, only_one_of_the_two_switches_switches) {
    for (int32_t duty_q15 = -32768; duty_q15 <= 32768; duty_q15++) {
        const hal_pwm_compare_t compare = compare_of(duty_q15, 2500);
        if (duty_q15 >= 0) {
            ASSERT_EQ(compare.lower[0], 2500) << "the lower switch is on throughout";
        } else {
            ASSERT_EQ(compare.upper[0], 0) << "the upper switch is off throughout";
        }
    }
}

TEST(Modulator, the_ends_and_zero_are_exact) {
    expect_compare(32768, false, 2500, 2500);
    expect_compare(0, false, 0, 2500);
    expect_compare(-32768, false, 0, 0);
    expect_compare(16384, false, 1250, 2500);
    expect_compare(-16384, false, 0, 1250);
}

TEST(Modulator, the_switch_states_of_hysteresis_are_whole_periods_at_every_period) {
    for (uint32_t period_ticks = 1; period_ticks <= 32767; period_ticks++) {
        for (const int state : {-1, 0, 1}) {
            const hal_pwm_compare_t compare = compare_of(state * MODULATOR_DUTY_ONE_Q15, uint16_t(period_ticks));
            ASSERT_EQ(compare.upper[0], state > 0 ? period_ticks : 0);
            ASSERT_EQ(compare.lower[0], state >= 0 ? period_ticks : 0);
        }
    }
}

TEST(Modulator, voltage_never_falls_when_the_duty_rises) {
    double last = -1.0;
    for (int32_t duty_q15 = -32768; duty_q15 <= 32768; duty_q15++) {
        const double voltage = mean_voltage(compare_of(duty_q15, 1000), 0, 1000);
        ASSERT_GE(voltage, last);
        last = voltage;
    }
    EXPECT_EQ(last, 1.0);
}

TEST(Modulator, interleaved_pulses_have_the_duty_as_mean_voltage_within_half_a_tick_for_every_duty) {
    for (const uint16_t period_ticks : {100, 1000, 2000, 2500, 5000, 32767}) {
        double last = -1.0;
        for (int32_t duty_q15 = -32768; duty_q15 <= 32768; duty_q15++) {
            const hal_pwm_compare_t compare = compare_of(duty_q15, period_ticks, true);
            const double voltage = mean_voltage(compare, 0, period_ticks);
            ASSERT_LE(std::fabs(voltage - duty_q15 / 32768.0), 0.5001 / period_ticks) << duty_q15;
            ASSERT_GE(voltage, last) << "never falls when the duty rises";
            ASSERT_LE(compare.upper[0], period_ticks);
            ASSERT_LE(compare.lower[0], period_ticks);
            last = voltage;
        }
    }
}

TEST(Modulator, interleaved_pulses_are_of_equal_length_and_of_the_sign_of_the_duty) {
    const uint16_t period_ticks = 2500;
    for (int32_t duty_q15 = -32768; duty_q15 <= 32768; duty_q15++) {
        const hal_pwm_compare_t compare = compare_of(duty_q15, period_ticks, true);
        // Both on, a quarter from either end, while the sum exceeds the period; both off while it does not.
        const int overlap = int(compare.upper[0]) + compare.lower[0] - period_ticks;
        ASSERT_EQ(overlap > 0, duty_q15 * double(period_ticks) >= 16384.0) << duty_q15;
        ASSERT_LE(std::abs(int(compare.upper[0]) - compare.lower[0]), 1) << "in equal parts";
    }
}

TEST(Modulator, interleaved_pulses_are_exact_at_the_ends) {
    expect_compare(32768, true, 2500, 2500);
    expect_compare(0, true, 1250, 1250);
    expect_compare(-32768, true, 0, 0);
    expect_compare(16384, true, 1875, 1875);
    expect_compare(-16384, true, 625, 625);
}

TEST(Modulator, each_phase_has_its_duty_and_the_phases_beyond_the_number_are_unchanged) {
    const int32_t duty_q15[HAL_PHASES_MAX] = {-32768, -16384, 16384, 32768, 8192, -8192};
    for (const bool interleaved : {false, true}) {
        for (unsigned phases = 0; phases <= HAL_PHASES_MAX; phases++) {
            hal_pwm_compare_t compare = {.upper = {11, 12, 13, 14, 15, 16}, .lower = {21, 22, 23, 24, 25, 26}};
            modulate(duty_q15, phases, 2500, interleaved, &compare);
            for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
                const hal_pwm_compare_t alone = compare_of(duty_q15[phase], 2500, interleaved);
                EXPECT_EQ(compare.upper[phase], phase < phases ? alone.upper[0] : 11 + phase);
                EXPECT_EQ(compare.lower[phase], phase < phases ? alone.lower[0] : 21 + phase);
            }
        }
    }
}

} // namespace
