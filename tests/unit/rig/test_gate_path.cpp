// Causes that open the switches without the firmware (rig/board.h). [SR-45]
#include <gtest/gtest.h>

#include "support/emulator_machines.h"

extern "C" {
#include "plant/pwm_timer.h"
#include "rig/board.h"
}

namespace {

constexpr uint16_t TICKS = 2500;
constexpr uint64_t PERIOD_NS = 2 * TICKS * PWM_TIMER_TICK_NS;

class GatePath : public testing::Test {
  protected:
    GatePath() : machine(machine_of(MAGNETICS_LINEAR_COSINE)) {
        machine.trip_current_A = 1000.0;
        plant_init(&plant, &machine, 0.3);
        sensors_init(&sensors, &machine.sensors, 17, 12, 1);
        board_init(&board, &plant, &sensors, &bus, 0, 1);
        board_pwm_start(&board, TICKS);
        full.upper[0] = full.lower[0] = TICKS;
    }

    // Start of the next period; then the interrupt writes, or does not.
    void period(bool busy, bool write) {
        board.time_ns += PERIOD_NS;
        plant_advance(&plant, board.time_ns);
        board_start_period(&board, busy);
        if (write) {
            board_pwm_write(&board, &full);
        }
    }

    bool any_on() const { return (plant.switches[0] | plant.switches[1] | plant.switches[2]) != 0; }

    machine_t machine;
    plant_t plant;
    sensors_t sensors;
    can_bus_t bus;
    board_t board;
    hal_pwm_compare_t full{};
};

TEST_F(GatePath, compare_values_act_once_more_and_then_the_switches_open) {
    period(false, true);
    period(false, false);
    EXPECT_TRUE(any_on()) << "written a period before";
    period(false, false);
    EXPECT_TRUE(any_on()) << "not renewed once";
    EXPECT_EQ(board_pwm_break(&board), 0u);
    period(false, false);
    EXPECT_FALSE(any_on());
    EXPECT_EQ(board_pwm_break(&board), HAL_PWM_BREAK_NOT_RENEWED);
}

TEST_F(GatePath, a_reset_of_the_processor_opens_every_switch_before_its_first_instruction) {
    period(false, true);
    period(false, true);
    ASSERT_TRUE(any_on());
    board_reset(&board, HAL_RESET_WATCHDOG);
    EXPECT_FALSE(any_on());
}

TEST_F(GatePath, an_interrupt_that_does_not_end_renews_nothing) {
    period(false, true);
    period(false, true); // begins, writes at once, and does not end
    EXPECT_TRUE(any_on());
    period(true, false);
    EXPECT_TRUE(any_on());
    period(true, false);
    EXPECT_FALSE(any_on()) << "two periods after it began";
    EXPECT_EQ(board_pwm_break(&board), HAL_PWM_BREAK_NOT_RENEWED);
    for (int k = 0; k < 5; k++) {
        period(false, true);
        EXPECT_FALSE(any_on()) << "latched";
    }
    board_pwm_open_all(&board);
    board_pwm_clear_break(&board);
    EXPECT_EQ(board_pwm_break(&board), 0u);
    board_pwm_write(&board, &full);
    period(false, true);
    EXPECT_TRUE(any_on());
}

TEST_F(GatePath, an_interrupt_that_misses_every_second_trigger_renews_them) {
    period(false, true);
    for (int k = 0; k < 20; k++) {
        period(k % 2 == 1, k % 2 == 0);
        EXPECT_EQ(board_pwm_break(&board), 0u);
    }
}

TEST_F(GatePath, values_that_are_cleared_count_as_renewed) {
    for (int k = 0; k < 10; k++) {
        period(false, false);
        board_pwm_open_all(&board);
        EXPECT_EQ(board_pwm_break(&board), 0u);
    }
}

// [SR-01]
TEST_F(GatePath, either_line_of_safe_torque_off_opens_at_once_until_it_is_energised_and_cleared) {
    for (unsigned line = 0; line < BOARD_STO_LINES; line++) {
        const uint32_t cause = line == 0 ? HAL_PWM_BREAK_STO_1 : HAL_PWM_BREAK_STO_2;
        period(false, true);
        period(false, true);
        ASSERT_TRUE(any_on());
        board.time_ns += 10;
        plant_advance(&plant, board.time_ns);
        board_set_sto(&board, line, false);
        EXPECT_FALSE(any_on());
        EXPECT_EQ(board_pwm_break(&board), cause);
        period(false, true);
        EXPECT_FALSE(any_on()) << "whatever is written";
        board_pwm_open_all(&board);
        board_pwm_clear_break(&board);
        EXPECT_EQ(board_pwm_break(&board), cause) << "its cause lasts";
        board_set_sto(&board, line, true);
        board_pwm_write(&board, &full);
        period(false, true);
        EXPECT_FALSE(any_on()) << "latched";
        board_pwm_open_all(&board);
        board_pwm_clear_break(&board);
        EXPECT_EQ(board_pwm_break(&board), 0u);
    }
}

} // namespace
