// When the watchdog may be kicked. [SR-47]
#include <gtest/gtest.h>

extern "C" {
#include "monitors/watchdog_monitor.h"
}

namespace {

class Watchdog : public testing::Test {
  protected:
    // A call of the background at which both interrupts have advanced.
    bool call(uint32_t advance_periods = 1, uint32_t advance_deferred = 1, uint32_t us = WATCHDOG_KICK_US) {
        for (const watchdog_part_t part : parts) {
            watchdog_monitor_pass(&monitor, part);
        }
        periods += advance_periods;
        completed += advance_deferred;
        time_us += us;
        return watchdog_monitor_kick(&monitor, periods, completed + pending, completed, time_us);
    }

    watchdog_monitor_t monitor{};
    std::vector<watchdog_part_t> parts = {WATCHDOG_CHECKED, WATCHDOG_STORED, WATCHDOG_SERVED};
    uint32_t periods = UINT32_MAX - 2, completed = UINT32_MAX - 1, pending = 0, time_us = UINT32_MAX - 1500;
};

TEST_F(Watchdog, is_kicked_while_all_advance_also_across_the_wrap_of_the_counts) {
    for (int k = 0; k < 10; k++) {
        EXPECT_TRUE(call()) << k;
    }
}

TEST_F(Watchdog, is_kicked_at_most_every_millisecond) {
    ASSERT_TRUE(call());
    EXPECT_FALSE(call(1, 1, WATCHDOG_KICK_US - 1));
    EXPECT_TRUE(call(1, 1, 1));
}

TEST_F(Watchdog, is_not_kicked_without_a_control_interrupt_or_a_deferred_step) {
    ASSERT_TRUE(call());
    EXPECT_FALSE(call(0, 1));
    EXPECT_FALSE(call(0, 0));
    EXPECT_TRUE(call(1, 1));
    EXPECT_FALSE(call(1, 0));
    EXPECT_TRUE(call(1, 1)) << "a late one is no standstill";
}

TEST_F(Watchdog, is_not_kicked_while_a_step_beyond_the_pending_one_is_missing) {
    ASSERT_TRUE(call());
    pending = 1;
    EXPECT_TRUE(call());
    pending = 2;
    EXPECT_FALSE(call());
    pending = UINT32_MAX; // a completed step without a request
    EXPECT_FALSE(call());
}

TEST_F(Watchdog, is_never_kicked_again_after_parts_of_the_background_in_another_order) {
    const std::vector<std::vector<watchdog_part_t>> disordered = {
        {},
        {WATCHDOG_CHECKED, WATCHDOG_SERVED},
        {WATCHDOG_STORED, WATCHDOG_CHECKED, WATCHDOG_SERVED},
        {WATCHDOG_CHECKED, WATCHDOG_STORED, WATCHDOG_SERVED, WATCHDOG_SERVED},
    };
    const std::vector<watchdog_part_t> ordered = parts;
    for (const std::vector<watchdog_part_t> &order : disordered) {
        monitor = {};
        parts = ordered;
        ASSERT_TRUE(call());
        parts = order;
        EXPECT_FALSE(call());
        parts = ordered;
        EXPECT_FALSE(call());
        EXPECT_FALSE(call());
    }
}

} // namespace
