/* Ticks of 170 MHz, whose length is not a whole number of nanoseconds. */
#undef SALIENT_PWM_CLOCK_MHZ
#define SALIENT_PWM_CLOCK_MHZ 170
#include "plant/pwm_timer.h"

#include <gtest/gtest.h>

#include <cmath>

namespace {

constexpr uint64_t PERIOD_TICKS = 4250; /* 40 kHz */

TEST(PwmTimer, PeriodsOfTheControlRatesAreWhole) {
    for (const uint64_t rate_hz : {20000u, 40000u, 50000u, 100000u}) {
        EXPECT_EQ(pwm_timer_ns(PWM_TIMER_CLOCK_HZ / rate_hz) * rate_hz, 1000000000u);
    }
}

TEST(PwmTimer, TimesAreTheNearestNanosecond) {
    uint64_t before = 0;
    for (uint64_t ticks = 1; ticks <= 8 * PERIOD_TICKS; ticks++) {
        const uint64_t time_ns = pwm_timer_ns(ticks);
        ASSERT_LE(std::fabs(static_cast<double>(time_ns) - static_cast<double>(ticks) * 1000.0 / 170.0), 0.5);
        ASSERT_GT(time_ns, before + 4);
        ASSERT_LT(time_ns, before + 7);
        before = time_ns;
    }
}

TEST(PwmTimer, TicksOfARoundedTimeAreTheTicks) {
    for (uint64_t ticks = 0; ticks <= 8 * PERIOD_TICKS; ticks++) {
        ASSERT_EQ(pwm_timer_ticks(pwm_timer_ns(ticks)), ticks);
    }
}

TEST(PwmTimer, NothingAccumulatesOverPeriods) {
    for (uint64_t period = 0; period < 1000; period++) {
        ASSERT_EQ(pwm_timer_ns(period * PERIOD_TICKS + 17), period * 25000u + 100u);
    }
}

TEST(PwmTimer, LongTimesDoNotOverflow) {
    constexpr uint64_t ticks = (UINT64_C(1) << 54) - 1;
    EXPECT_NEAR(static_cast<double>(pwm_timer_ns(ticks)), static_cast<double>(ticks) * 1000.0 / 170.0, 64.0);
}

} // namespace
