// Conversions and clocks of a board (rig/board.h): temperatures in turn, the second clock.
#include "support/emulated_board.h"

extern "C" {
#include "plant/pwm_timer.h"
}

namespace {

constexpr uint16_t TICKS = 2500;
constexpr uint64_t PERIOD_NS = 2 * TICKS * PWM_TIMER_TICK_NS;
constexpr unsigned SENSORS = 8; // of a board for four phases

class Board : public EmulatedBoard {
  protected:
    Board() {
        board_pwm_start(&board, TICKS);
        board_convert_temperatures(&board);
    }

    void period(bool busy = false) {
        board.time_ns += PERIOD_NS;
        plant_advance(&plant, board.time_ns);
        board_start_period(&board, busy);
    }

    void set_inputs(uint16_t code) {
        for (uint16_t &input : board.temperature_input) {
            input = code;
        }
    }

    // Sensors that have a code; windings, then switches, of four phases.
    unsigned with(uint16_t code) const {
        unsigned mask = 0;
        for (unsigned i = 0; i < SENSORS; ++i) {
            const unsigned sensor = i < 4 ? HAL_ADC_WINDING + i : HAL_ADC_INVERTER + i - 4;
            mask |= unsigned(board.temperature_code[sensor] == code) << i;
        }
        return mask;
    }
};

TEST_F(Board, each_control_interrupt_has_the_temperature_that_was_sampled_in_the_one_before) {
    set_inputs(20000);
    for (unsigned i = 0; i < SENSORS; ++i) {
        period();
        EXPECT_EQ(with(20000), ((1u << i) - 1) << 1 & 0xFF) << "the first was sampled before";
    }
    period();
    EXPECT_EQ(with(20000), 0xFFu);
}

TEST_F(Board, a_lost_control_interrupt_converts_nothing) {
    period();
    set_inputs(20000);
    period();
    for (unsigned i = 0; i < 2 * SENSORS; ++i) {
        period(true);
    }
    EXPECT_EQ(with(20000), 0u);
    period();
    EXPECT_EQ(with(20000), 4u);
}

TEST_F(Board, a_reset_converts_all_temperatures_and_begins_with_the_first) {
    period();
    set_inputs(20000);
    board_reset(&board, HAL_RESET_POWER);
    EXPECT_EQ(with(20000), 0xFFu);
    board_pwm_start(&board, TICKS);
    set_inputs(30000);
    period();
    EXPECT_EQ(with(30000), 0u) << "sampled by the reset";
    period();
    EXPECT_EQ(with(30000), 2u);
}

TEST_F(Board, second_clock_has_steps_of_a_crystal_of_32768_Hz) {
    uint32_t before_us = board_reference_us(&board);
    EXPECT_EQ(before_us, 0u);
    for (board.time_ns = 0; board.time_ns <= 1000000000; board.time_ns += 1000) {
        const uint32_t now_us = board_reference_us(&board);
        ASSERT_LE(now_us - before_us, 31u);
        ASSERT_LE(now_us, board.time_ns / 1000);
        ASSERT_GT(now_us + 32, board.time_ns / 1000);
        before_us = now_us;
    }
    board.time_ns = 1000000000;
    EXPECT_EQ(board_reference_cycles(&board), BOARD_REFERENCE_HZ);
    EXPECT_EQ(board_reference_us(&board), 1000000u);
}

TEST_F(Board, rate_of_the_second_clock_changes_without_a_step_and_outlives_a_reset) {
    board.time_ns = 1000000000;
    board_set_reference_rate(&board, 1.5);
    EXPECT_EQ(board_reference_us(&board), 1000000u);
    board.time_ns = 3000000000;
    EXPECT_EQ(board_reference_us(&board), 4000000u);
    board_reset(&board, HAL_RESET_POWER);
    EXPECT_EQ(board_reference_us(&board), 0u);
    board.time_ns = 4000000000;
    EXPECT_EQ(board_reference_us(&board), 1500000u);
}

} // namespace
