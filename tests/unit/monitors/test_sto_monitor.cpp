// [SR-03]
#include <gtest/gtest.h>

extern "C" {
#include "hal_pwm.h"
#include "monitors/sto_monitor.h"
}

namespace {

constexpr uint32_t START_US = UINT32_MAX - 100000; // the clock wraps during the tests

TEST(StoMonitor, lines_that_differ_for_200_ms_are_a_discrepancy) {
    for (const uint32_t cause : {HAL_PWM_BREAK_STO_1, HAL_PWM_BREAK_STO_2}) {
        sto_monitor_t monitor = {};
        EXPECT_FALSE(sto_monitor_failed(&monitor, 0, START_US));
        EXPECT_FALSE(sto_monitor_failed(&monitor, cause, START_US + 1));
        EXPECT_FALSE(sto_monitor_failed(&monitor, cause, START_US + 200000));
        EXPECT_TRUE(sto_monitor_failed(&monitor, cause, START_US + 200001));
    }
}

TEST(StoMonitor, lines_that_agree_in_between_are_no_discrepancy) {
    sto_monitor_t monitor = {};
    uint32_t time_us = START_US;
    for (int k = 0; k < 10; k++) {
        EXPECT_FALSE(sto_monitor_failed(&monitor, HAL_PWM_BREAK_STO_1 | HAL_PWM_BREAK_STO_2, time_us));
        EXPECT_FALSE(sto_monitor_failed(&monitor, HAL_PWM_BREAK_STO_2, time_us += 150000));
        EXPECT_FALSE(sto_monitor_failed(&monitor, 0, time_us += 25));
        EXPECT_FALSE(sto_monitor_failed(&monitor, HAL_PWM_BREAK_STO_1, time_us += 150000));
        time_us += 25;
    }
}

TEST(StoMonitor, discrepancy_lasts_until_both_lines_have_been_off_together) {
    sto_monitor_t monitor = {};
    EXPECT_FALSE(sto_monitor_failed(&monitor, 0, START_US));
    EXPECT_TRUE(sto_monitor_failed(&monitor, HAL_PWM_BREAK_STO_1, START_US + 200001));
    EXPECT_TRUE(sto_monitor_failed(&monitor, 0, START_US + 300000));
    EXPECT_TRUE(sto_monitor_failed(&monitor, HAL_PWM_BREAK_STO_2, START_US + 300100));
    EXPECT_FALSE(sto_monitor_failed(&monitor, HAL_PWM_BREAK_STO_1 | HAL_PWM_BREAK_STO_2, START_US + 300200));
    EXPECT_FALSE(sto_monitor_failed(&monitor, 0, START_US + 300300));
}

TEST(StoMonitor, other_breaks_are_no_discrepancy) {
    sto_monitor_t monitor = {};
    for (uint32_t k = 0; k < 5; k++) {
        EXPECT_FALSE(sto_monitor_failed(&monitor, HAL_PWM_BREAK_OVER_CURRENT | HAL_PWM_BREAK_NOT_RENEWED,
                                        START_US + 200000 * k));
    }
}

} // namespace
