// Supervision of the CAN bus: waits and times at their limits, across the wrap of the clock. [SR-38]
#include <cstdint>

#include <gtest/gtest.h>

extern "C" {
#include "comms/bus_monitor.h"
#include "drive_codec.h"
#include "drive_telemetry.h"
}

struct hal {
    hal_can_error_state_t state = HAL_CAN_ERROR_ACTIVE;
    unsigned rejoins = 0;
};

extern "C" void hal_can_status(const hal_t *hal, hal_can_status_t *status) {
    *status = {};
    status->state = hal->state;
}

extern "C" void hal_can_rejoin(hal_t *hal) {
    hal->rejoins++;
}

namespace {

constexpr uint32_t STEP_US = 1000, START_US = UINT32_MAX - 1500000; // the clock comes round in the tests

class BusMonitor : public testing::Test {
  protected:
    BusMonitor() { bus_monitor_init(&monitor, time_us); }

    void steps(hal_can_error_state_t state, uint32_t duration_us) {
        hal.state = state;
        for (uint32_t us = 0; us < duration_us; us += STEP_US) {
            time_us += STEP_US;
            bus_monitor_step(&monitor, &hal, time_us);
        }
    }

    // Time from the step that sees bus-off until the first attempt to rejoin.
    uint32_t wait_us() {
        steps(HAL_CAN_BUS_OFF, STEP_US);
        const uint32_t seen_us = time_us;
        for (const unsigned before = hal.rejoins; hal.rejoins == before && time_us - seen_us < 1000000;) {
            steps(HAL_CAN_BUS_OFF, STEP_US);
        }
        return time_us - seen_us;
    }

    hal_t hal;
    bus_monitor_t monitor{};
    uint32_t time_us = START_US;
};

TEST_F(BusMonitor, waits_10_ms_before_the_first_attempt_and_twice_as_long_before_each_further_one_up_to_320_ms) {
    for (const uint32_t expected_us : {10000u, 20000u, 40000u, 80000u, 160000u, 320000u, 320000u}) {
        EXPECT_EQ(wait_us(), expected_us);
        EXPECT_TRUE(monitor.run_inhibited);
        steps(HAL_CAN_ERROR_ACTIVE, 2 * STEP_US);
    }
    EXPECT_EQ(monitor.bus_off_count, 7);
}

TEST_F(BusMonitor, an_attempt_that_fails_is_followed_by_one_after_twice_the_wait) {
    EXPECT_EQ(wait_us(), 10000u);
    for (const uint32_t expected_us : {20000u, 40000u, 80000u}) {
        const unsigned before = hal.rejoins;
        steps(HAL_CAN_BUS_OFF, expected_us - STEP_US);
        EXPECT_EQ(hal.rejoins, before) << expected_us;
        steps(HAL_CAN_BUS_OFF, STEP_US);
        EXPECT_EQ(hal.rejoins, before + 1) << expected_us;
    }
    EXPECT_EQ(monitor.bus_off_count, 1);
}

TEST_F(BusMonitor, a_second_without_errors_restores_the_first_wait_and_a_millisecond_less_does_not) {
    for (const uint32_t short_us : {STEP_US, 0u}) {
        EXPECT_EQ(wait_us(), 10000u);
        steps(HAL_CAN_ERROR_ACTIVE, STEP_US); // sees that it has ended
        steps(HAL_CAN_ERROR_ACTIVE, BUS_MONITOR_ERROR_FREE_US - short_us);
        EXPECT_EQ(wait_us(), short_us != 0 ? 20000u : 10000u);
        steps(HAL_CAN_ERROR_ACTIVE, BUS_MONITOR_ERROR_FREE_US + STEP_US);
    }
}

TEST_F(BusMonitor, the_second_without_errors_begins_anew_with_each_step_that_is_error_passive) {
    EXPECT_EQ(wait_us(), 10000u);
    steps(HAL_CAN_ERROR_ACTIVE, BUS_MONITOR_ERROR_FREE_US / 2);
    steps(HAL_CAN_ERROR_PASSIVE, STEP_US);
    steps(HAL_CAN_ERROR_ACTIVE, BUS_MONITOR_ERROR_FREE_US - STEP_US);
    EXPECT_EQ(wait_us(), 20000u);
    steps(HAL_CAN_ERROR_ACTIVE, STEP_US);
    steps(HAL_CAN_ERROR_PASSIVE, BUS_MONITOR_ERROR_FREE_US * 2);
    EXPECT_EQ(wait_us(), 40000u);
    steps(HAL_CAN_ERROR_ACTIVE, STEP_US);
    steps(HAL_CAN_ERROR_PASSIVE, STEP_US);
    steps(HAL_CAN_ERROR_ACTIVE, BUS_MONITOR_ERROR_FREE_US);
    EXPECT_EQ(wait_us(), 10000u);
}

TEST_F(BusMonitor, the_first_wait_is_that_of_the_start_whatever_was_in_memory) {
    monitor.wait_us = 320000;
    monitor.bus_off_count = monitor.foreign_count = 7;
    monitor.conflict = monitor.run_inhibited = true;
    bus_monitor_init(&monitor, time_us);
    EXPECT_EQ(monitor.bus_off_count + monitor.foreign_count + monitor.conflict + monitor.run_inhibited, 0);
    EXPECT_EQ(wait_us(), 10000u);
}

// [SR-37]
TEST_F(BusMonitor, a_foreign_frame_is_a_conflict_for_a_second_after_the_last_one) {
    hal_can_frame_t frame{};
    frame.identifier = DRIVE_HEARTBEAT_FRAME_ID;
    frame.length = 8;
    bus_monitor_check(&monitor, &frame, time_us);
    steps(HAL_CAN_ERROR_ACTIVE, BUS_MONITOR_CONFLICT_US / 2);
    bus_monitor_check(&monitor, &frame, time_us);
    steps(HAL_CAN_ERROR_ACTIVE, BUS_MONITOR_CONFLICT_US - STEP_US);
    EXPECT_TRUE(monitor.conflict);
    steps(HAL_CAN_ERROR_ACTIVE, STEP_US);
    EXPECT_FALSE(monitor.conflict);
    EXPECT_EQ(monitor.foreign_count, 2);
}

// [SR-37]
TEST_F(BusMonitor, neither_a_remote_nor_an_extended_frame_nor_another_identifier_is_a_conflict) {
    for (int kind = 0; kind < 4; kind++) {
        hal_can_frame_t frame{};
        frame.identifier = kind == 2 ? DRIVE_COMMAND_FRAME_ID : DRIVE_PARAMETER_RESPONSE_FRAME_ID;
        frame.remote = kind == 0;
        frame.extended = kind == 1;
        bus_monitor_check(&monitor, &frame, time_us);
        EXPECT_EQ(monitor.conflict, kind == 3) << kind;
        EXPECT_EQ(monitor.foreign_count, kind == 3) << kind;
    }
}

// A machine of up to four phases has neither the message nor its identifier. [SR-37]
TEST_F(BusMonitor, identifier_of_a_message_of_more_phases_than_the_machine_has_is_no_conflict) {
    for (unsigned i = 0; i < DRIVE_TELEMETRY_MESSAGES; i++) {
        const drive_telemetry_message_t &message = drive_telemetry_messages[i];
        hal_can_frame_t frame{};
        frame.identifier = message.identifier;
        bus_monitor_init(&monitor, time_us);
        bus_monitor_check(&monitor, &frame, time_us);
        EXPECT_EQ(monitor.conflict, message.identifier != DRIVE_PHASES_E_F_FRAME_ID) << message.identifier;
    }
}

} // namespace
