// Speed control step: limits of the torque by a load that is uncertain, and the results outside of a run.
#include <algorithm>
#include <cstdint>
#include <utility>

#include <gtest/gtest.h>

extern "C" {
#include "interrupts/speed_control.h"
}

#include "support/configured.h"

namespace {

constexpr int32_t NM_Q24 = 1 << 24;

class SpeedControl : public testing::Test {
  protected:
    SpeedControl() {
        parameters = configured(DRIVE_CONTROLLER_SALIENT, 40000, 17);
        control_reset(&parameters, &state);
        parameters.conduction.torque_max_q24 = 32 * NM_Q24;
    }

    deferred_speed_results_t limited(int32_t load_q24, int32_t reference_q22) {
        deferred_speed_results_t results = {reference_q22, 0, 0, -30 * NM_Q24, 30 * NM_Q24};
        speed_control_limit_uncertain(&parameters, load_q24, &results);
        return results;
    }

    control_parameters_t parameters;
    control_state_t state;
};

TEST_F(SpeedControl, an_uncertain_load_is_not_braked_against_from_a_sixteenth_of_the_largest_torque_on) {
    for (const int32_t sign : {1, -1}) {
        for (const int32_t reference_q22 : {0, 1, 1 << 24}) { // in the direction in which the load brakes
            for (const int32_t load_q24 : {NM_Q24, 2 * NM_Q24, 3 * NM_Q24}) {
                const deferred_speed_results_t results = limited(sign * load_q24, sign * reference_q22);
                const int32_t against_q24 = std::max(32 * NM_Q24 - 16 * load_q24, 0);
                EXPECT_EQ(sign > 0 ? results.torque_min_q24 : -results.torque_max_q24, -against_q24);
                EXPECT_EQ(sign > 0 ? results.torque_max_q24 : -results.torque_min_q24, 30 * NM_Q24);
            }
        }
    }
}

TEST_F(SpeedControl, a_limit_of_the_torque_below_that_of_an_uncertain_load_stays) {
    EXPECT_EQ(limited(1, 0).torque_min_q24, -30 * NM_Q24);
    EXPECT_EQ(limited(-1, 0).torque_max_q24, 30 * NM_Q24);
}

TEST_F(SpeedControl, neither_no_load_nor_one_that_drives_limits_the_torque) {
    for (const auto &[load_q24, reference_q22] :
         {std::pair(0, 1), {0, 0}, {0, -1}, {3 * NM_Q24, -1}, {-3 * NM_Q24, 1}}) {
        const deferred_speed_results_t results = limited(load_q24, reference_q22);
        EXPECT_EQ(results.torque_min_q24, -30 * NM_Q24) << load_q24 << " " << reference_q22;
        EXPECT_EQ(results.torque_max_q24, 30 * NM_Q24) << load_q24 << " " << reference_q22;
    }
}

TEST_F(SpeedControl, a_commanded_speed_is_limited_to_that_of_the_drive_and_with_one_quadrant_to_0_backwards) {
    for (const drive_controller_t controller :
         {DRIVE_CONTROLLER_TRADITIONAL, DRIVE_CONTROLLER_PAPER, DRIVE_CONTROLLER_SALIENT}) {
        parameters = configured(controller, 40000, 17);
        const int32_t max_q22 = parameters.speed_reference_max_q22;
        const bool backwards = controller == DRIVE_CONTROLLER_SALIENT;
        for (const int32_t commanded_q22 : {0, 1, 10 << 22, max_q22}) {
            EXPECT_EQ(speed_control_limited_q22(&parameters, commanded_q22), commanded_q22);
            EXPECT_EQ(speed_control_limited_q22(&parameters, -commanded_q22), backwards ? -commanded_q22 : 0);
        }
        EXPECT_EQ(speed_control_limited_q22(&parameters, max_q22 + 1), max_q22);
        EXPECT_EQ(speed_control_limited_q22(&parameters, INT32_MIN), backwards ? -max_q22 : 0);
    }
}

// In a run in speed mode, at its reference.
TEST_F(SpeedControl, the_course_of_slow_counts_begins_at_the_angle_and_fast_counts_have_the_error_of_the_speed_alone) {
    constexpr uint32_t ANGLE = 0x12345678u;
    deferred_input_t input{};
    input.run = true;
    input.periods = 1;
    input.angle = ANGLE;
    input.dc_link_voltage_q6 = 240 << 6;
    command_t command{};
    command.request = COMMAND_RUN;
    command.speed_reference_q22 = 20 << 22;
    deferred_t &deferred = state.deferred;
    deferred.speed_smc = parameters.speed_smc;
    const auto torque_q24 = [&](bool run, bool slow, int32_t error_q22) {
        deferred.run = run;
        deferred.speed_reference_q22 = command.speed_reference_q22;
        deferred.slow_counts.slow = slow;
        deferred.count_course.angle_q64 = uint64_t(ANGLE + (1u << 26)) << 32; // of an earlier time
        input.speed_q22 = command.speed_reference_q22 - error_q22;
        deferred_results_t results{};
        speed_control_deferred(&parameters, &deferred, &input, &command, INT32_MAX, &results);
        return results.speed.speed_law_torque_q24;
    };
    for (const int32_t error_q22 : {0, 1 << 18, -(1 << 18), 1 << 22}) {
        EXPECT_EQ(torque_q24(true, false, error_q22), speed_smc_reaching_torque_q24(&deferred.speed_smc, error_q22));
        EXPECT_EQ(deferred.count_course.angle_q64, uint64_t(ANGLE) << 32);
    }
    EXPECT_EQ(torque_q24(false, true, 0), 0) << "the start of a run";
    EXPECT_EQ(deferred.count_course.angle_q64, uint64_t(ANGLE) << 32);
    EXPECT_GT(torque_q24(true, true, 0), 0) << "a course that is ahead";
}

TEST_F(SpeedControl, a_run_begins_at_the_speed_of_the_rotor_and_with_one_quadrant_not_below_0) {
    for (const drive_controller_t controller : {DRIVE_CONTROLLER_TRADITIONAL, DRIVE_CONTROLLER_SALIENT}) {
        parameters = configured(controller, 40000, 17);
        parameters.speed_ramp_q22 = 1 << 10;
        const bool backwards = controller == DRIVE_CONTROLLER_SALIENT;
        for (const int32_t speed_q22 : {-(20 << 22), -1, 0, 20 << 22}) {
            for (const drive_mode_t mode : {DRIVE_MODE_SPEED, DRIVE_MODE_TORQUE}) {
                for (const bool run : {false, true}) { // before
                    control_reset(&parameters, &state);
                    state.deferred.run = run;
                    state.deferred.speed_reference_q22 = 7 << 22;
                    deferred_input_t input{};
                    input.run = true;
                    input.speed_q22 = speed_q22;
                    input.dc_link_voltage_q6 = 240 << 6;
                    command_t command{};
                    command.request = COMMAND_RUN;
                    command.mode = mode;
                    command.speed_reference_q22 = 60 << 22;
                    deferred_results_t results{};
                    speed_control_deferred(&parameters, &state.deferred, &input, &command, INT32_MAX, &results);
                    const int32_t present_q22 = backwards ? speed_q22 : std::max(speed_q22, 0);
                    const int32_t expected_q22 = mode == DRIVE_MODE_TORQUE ? present_q22
                                                 : run                     ? (7 << 22) + (1 << 10)
                                                                           : present_q22 + (1 << 10);
                    EXPECT_EQ(state.deferred.speed_reference_q22, expected_q22) << controller << " " << speed_q22;
                }
            }
        }
    }
}

TEST_F(SpeedControl, a_full_dc_link_takes_the_torque_against_the_speed_of_a_rotor_that_turns_and_none_else) {
    deferred_input_t input{};
    input.run = true;
    command_t command{};
    command.request = COMMAND_RUN;
    const auto limits = [&](double speed_rad_s, int32_t voltage_q6) {
        input.speed_q22 = fixed_point::to_fixed(speed_rad_s, fixed_point::Q22);
        input.dc_link_voltage_q6 = voltage_q6;
        deferred_results_t results{};
        speed_control_deferred(&parameters, &state.deferred, &input, &command, INT32_MAX, &results);
        return std::pair(results.speed.torque_min_q24, results.speed.torque_max_q24);
    };
    using range_t = std::pair<int32_t, int32_t>;
    constexpr int32_t NORMAL_Q6 = 240 << 6;
    const int32_t full_q6 = parameters.conduction.full_link_q6;
    state.deferred.conduction.torque_min_q24 = -5 * NM_Q24;
    state.deferred.conduction.torque_max_q24 = 6 * NM_Q24;
    for (const double speed_rad_s : {0.0, 1.9, -1.9, 2.1, -2.1, 30.0, -30.0}) {
        EXPECT_EQ(limits(speed_rad_s, NORMAL_Q6), range_t(-5 * NM_Q24, 6 * NM_Q24)) << speed_rad_s;
        const range_t full(speed_rad_s > 2.0 ? 0 : -5 * NM_Q24, speed_rad_s < -2.0 ? 0 : 6 * NM_Q24);
        EXPECT_EQ(limits(speed_rad_s, full_q6), full) << speed_rad_s;
    }
    parameters.torque_law = TORQUE_LAW_DUTY; // of one quadrant: a rotor that is driven backwards
    EXPECT_EQ(limits(-30.0, full_q6), range_t(-5 * NM_Q24, 6 * NM_Q24));
}

TEST_F(SpeedControl, every_result_is_0_outside_of_a_run_and_the_reference_also_in_torque_mode) {
    deferred_input_t input{};
    input.speed_q22 = 5 << 22;
    input.dc_link_voltage_q6 = 240 << 6;
    command_t command{};
    command.request = COMMAND_RUN;
    command.speed_reference_q22 = 50 << 22;
    command.torque_reference_q24 = NM_Q24;
    for (const drive_mode_t mode : {DRIVE_MODE_SPEED, DRIVE_MODE_TORQUE}) {
        command.mode = mode;
        for (const bool run : {false, true}) {
            state.deferred.run = true;
            state.deferred.speed_reference_q22 = 20 << 22;
            state.deferred.periodic_load.torque_q24 = 777;
            input.run = run;
            deferred_results_t results{};
            results.speed = {1, 2, 3, 4, 5};
            speed_control_deferred(&parameters, &state.deferred, &input, &command, 20 * NM_Q24, &results);
            EXPECT_EQ(state.deferred.mode, run ? mode : DRIVE_MODE_SPEED);
            const bool speed_law = run && mode == DRIVE_MODE_SPEED;
            EXPECT_EQ(results.speed.speed_reference_q22, speed_law ? state.deferred.speed_reference_q22 : 0);
            EXPECT_EQ(results.speed.speed_reference_q22 != 0, speed_law);
            EXPECT_EQ(results.speed.periodic_load_q24, speed_law ? 777 : 0);
            if (!run) {
                EXPECT_EQ(results.speed.speed_law_torque_q24, 0);
                EXPECT_EQ(results.speed.torque_min_q24, 0);
                EXPECT_EQ(results.speed.torque_max_q24, 0);
            }
        }
    }
}

} // namespace
