// The deferred step: hand-over of the input, late and skipped steps, resets while a step is pending, starvation.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>

#include <gtest/gtest.h>

extern "C" {
#include "interrupts/deferred.h"
#include "interrupts/observe.h"
#include "interrupts/torque_control.h"
#include "storage/fault.h"
}

#include "support/configured.h"
#include "support/deferred_step.h"
#include "support/fixed_point.h"
#include "support/whole_sample.h"

namespace {

constexpr double RATE_HZ = 40000.0;
constexpr unsigned ENCODER_BITS = 17;
constexpr int32_t COUNT = 1 << (32 - ENCODER_BITS);

// A drive on a rotor whose speed the test prescribes. The test decides when the deferred step is made.
class Deferred : public testing::Test {
  protected:
    Deferred() { configure(DRIVE_CONTROLLER_SALIENT); }

    void configure(drive_controller_t controller) {
        parameters = configured(controller, uint32_t(RATE_HZ), ENCODER_BITS);
        control_reset(&parameters, &state);
        sample.adc.bus_voltage_counts = 240 * 8;
    }

    // The control interrupt of one period.
    bool interrupt(command_request_t request, double reference_rpm = 600.0) {
        sample.time_us += 25;
        command.request = request;
        command.speed_reference_q22 = fixed_point::to_fixed(fixed_point::rad_s(reference_rpm), fixed_point::Q22);
        command.time_us = sample.time_us;
        turns += speed_rad_s / (2.0 * fixed_point::PI * RATE_HZ);
        sample.encoder.counts = uint32_t(int64_t(std::floor((turns - std::floor(turns)) * (1 << ENCODER_BITS))));
        return control_step(&parameters, &state, &sample, &command, &compare);
    }

    // A period in torque mode, with a deferred step in time.
    bool torque_period(double torque_Nm, command_request_t request = COMMAND_RUN) {
        command.mode = DRIVE_MODE_TORQUE;
        command.torque_reference_q24 = fixed_point::to_fixed(torque_Nm, fixed_point::Q24);
        const bool run = period(request);
        command.mode = DRIVE_MODE_SPEED;
        return run;
    }

    // A period with a deferred step in time.
    bool period(command_request_t request, double reference_rpm = 600.0) {
        const bool run = interrupt(request, reference_rpm);
        EXPECT_TRUE(deferred_step(&parameters, &state, &command));
        return run;
    }

    // 10 ms without a failed check, after which a fault can be cleared; results of the deferred step act a period
    // later.
    void see_the_cause_gone() {
        for (int k = 0; k < 401; k++) {
            period(COMMAND_OFF);
        }
    }

    void start() {
        for (int k = 0; k < 41; k++) {
            period(COMMAND_OFF);
        }
        ASSERT_TRUE(period(COMMAND_RUN));
    }

    void tune() {
        for (unsigned part = 0; part < DEFERRED_TUNE_PARTS; part++) {
            deferred_tune(&parameters, &state, part);
        }
    }

    const deferred_results_t &results() const { return *deferred_in_effect(&state); }
    bool pending() const { return deferred_pending(&state.deferred_request, &state.deferred.response); }
    const torque_sharing_window_t &window() const {
        return conduction_angles(&parameters.conduction, &state.deferred.conduction, results().predictive.conduction)
            ->half[CONDUCTION_MOTORING]
            .window;
    }
    const torque_sharing_window_t &base_window() const {
        return parameters.conduction.initial.half[CONDUCTION_MOTORING].window;
    }
    bool advanced() const { return window().turn_on != base_window().turn_on; }

    control_parameters_t parameters;
    control_state_t state;
    whole_sample_t sample{};
    command_t command{};
    hal_pwm_compare_t compare{};
    double turns = 0.1, speed_rad_s = 0.0;
};

TEST_F(Deferred, every_control_interrupt_requests_one_step) {
    for (int k = 0; k < 100; k++) {
        interrupt(COMMAND_OFF);
        ASSERT_TRUE(pending());
        EXPECT_TRUE(deferred_step(&parameters, &state, &command));
        EXPECT_FALSE(pending());
        EXPECT_FALSE(deferred_step(&parameters, &state, &command)) << "nothing is pending";
    }
    EXPECT_EQ(state.deferred_request.requests, 100u);
    EXPECT_EQ(state.deferred_request.skipped_total, 0u);
}

TEST_F(Deferred, a_pending_step_keeps_its_input_and_the_next_input_counts_the_skipped_periods) {
    start();
    interrupt(COMMAND_RUN);
    deferred_input_t before;
    std::memcpy(&before, &state.deferred_request.input, sizeof before);
    for (uint32_t skipped = 1; skipped <= 5; skipped++) {
        turns += 0.0001;
        ASSERT_TRUE(interrupt(COMMAND_RUN));
        EXPECT_EQ(std::memcmp(&before, &state.deferred_request.input, sizeof before), 0);
        EXPECT_EQ(state.deferred_request.skipped, skipped);
    }
    EXPECT_TRUE(deferred_step(&parameters, &state, &command));
    interrupt(COMMAND_RUN);
    EXPECT_EQ(state.deferred_request.input.periods, 6u);
    EXPECT_EQ(state.deferred_request.input.encoder_angle, sample.encoder.counts << 15);
    EXPECT_EQ(state.deferred_request.skipped, 0u);
    EXPECT_EQ(state.deferred_request.skipped_total, 5u);
    EXPECT_TRUE(deferred_step(&parameters, &state, &command));
    interrupt(COMMAND_RUN);
    EXPECT_EQ(state.deferred_request.input.periods, 1u);
}

TEST_F(Deferred, results_take_effect_together_at_the_end_of_the_step) {
    parameters.conduction.own_windows = false;
    parameters.conduction.sharing.turn_on_advance = 1u << 28;
    start();
    for (int k = 0; k < 400; k++) {
        period(COMMAND_RUN, 3000.0); // a torque shortfall: the windows move
    }
    while (state.deferred.turn % DEFERRED_SLOW_PERIODS != 1 ||
           state.deferred.conduction_update.step != CONDUCTION_STEPS - 1) { // in the next step
        period(COMMAND_RUN, 3000.0);
    }
    interrupt(COMMAND_RUN, 3000.0);
    deferred_results_t before;
    std::memcpy(&before, &results(), sizeof before);
    const torque_sharing_window_t window_before = window();
    deferred_compute(&parameters, &state, &command);
    EXPECT_EQ(std::memcmp(&before, &results(), sizeof before), 0) << "while the step computes";
    ASSERT_TRUE(interrupt(COMMAND_RUN, 3000.0)) << "pre-empts it";
    EXPECT_EQ(std::memcmp(&before, &results(), sizeof before), 0);
    EXPECT_EQ(std::memcmp(&window_before, &window(), sizeof window_before), 0);
    deferred_complete(&state.deferred_request, &state.deferred.response);
    EXPECT_NE(window_before.turn_on, window().turn_on);
}

TEST_F(Deferred, checks_act_one_period_later_or_when_the_late_step_ends) {
    for (const int late : {0, 1, 4}) {
        control_reset(&parameters, &state);
        sample.adc.bus_voltage_counts = 240 * 8;
        start();
        sample.adc.bus_voltage_counts = 149 * 8;
        EXPECT_TRUE(interrupt(COMMAND_RUN));
        for (int k = 0; k < late; k++) {
            EXPECT_TRUE(interrupt(COMMAND_RUN));
        }
        EXPECT_TRUE(deferred_step(&parameters, &state, &command));
        EXPECT_FALSE(interrupt(COMMAND_RUN));
        EXPECT_EQ(state.state_machine.record.fault, FAULT_UNDER_VOLTAGE);
        deferred_step(&parameters, &state, &command);
    }
}

TEST_F(Deferred, a_step_that_is_late_for_eight_periods_is_an_overrun) {
    start();
    interrupt(COMMAND_RUN);
    for (int k = 0; k < PROTECTION_SKIPPED_DEFERRED_MAX; k++) {
        ASSERT_TRUE(interrupt(COMMAND_RUN)) << k;
    }
    EXPECT_FALSE(interrupt(COMMAND_RUN));
    EXPECT_EQ(state.state_machine.record.fault, FAULT_INTERRUPT_OVERRUN);
    EXPECT_EQ(state.state_machine.record.fault_mask, FAULT_BIT(FAULT_INTERRUPT_OVERRUN));
    for (int k = 0; k < 20; k++) {
        interrupt(COMMAND_CLEAR_FAULT);
        interrupt(COMMAND_OFF);
        EXPECT_EQ(state.state_machine.state, DRIVE_STATE_FAULT) << "no clearing while its cause lasts";
    }
    deferred_step(&parameters, &state, &command);
    see_the_cause_gone();
    period(COMMAND_CLEAR_FAULT);
    EXPECT_EQ(state.state_machine.state, DRIVE_STATE_READY);
}

TEST_F(Deferred, steps_that_are_late_by_up_to_seven_periods_are_no_fault) {
    start();
    for (int k = 0; k < 1000; k++) {
        ASSERT_TRUE(interrupt(COMMAND_RUN)) << k;
        if (k % 8 == 7) {
            deferred_step(&parameters, &state, &command);
        }
    }
    EXPECT_GT(state.deferred_request.skipped_total, 800u);
}

TEST_F(Deferred, a_late_step_does_not_undo_the_reset_of_the_windows_at_the_end_of_a_run) {
    parameters.conduction.own_windows = false;
    parameters.conduction.sharing.turn_on_advance = 1u << 28;
    start();
    for (int k = 0; k < 400; k++) {
        period(COMMAND_RUN, 3000.0);
    }
    ASSERT_TRUE(advanced());
    interrupt(COMMAND_RUN, 3000.0); // this step will be late
    EXPECT_FALSE(interrupt(COMMAND_OFF));
    EXPECT_FALSE(advanced()) << "in effect without a step";
    EXPECT_TRUE(deferred_step(&parameters, &state, &command)) << "computed with the windows of the run";
    EXPECT_FALSE(advanced());
    EXPECT_GT(state.deferred.conduction.advance_q30, 0);
    EXPECT_TRUE(interrupt(COMMAND_RUN, 0.0)) << "the next run, without a period between";
    EXPECT_FALSE(advanced());
    EXPECT_TRUE(deferred_step(&parameters, &state, &command));
    EXPECT_EQ(state.deferred.conduction.advance_q30, 0) << "the windows start again";
    EXPECT_FALSE(advanced());
}

TEST_F(Deferred, the_torque_of_the_speed_law_acts_one_period_later_with_the_feed_forward_of_that_period) {
    start();
    for (int k = 0; k < 200; k++) {
        speed_rad_s = 0.02 * k;
        interrupt(COMMAND_RUN, 30.0);
        const deferred_input_t &input = state.deferred_request.input;
        EXPECT_EQ(input.speed_q22, state.observer.speed_q22) << "the speed after this sample";
        const int32_t torque_offset_before_q24 = torque_offset_q24(&state.deferred.torque_offset);
        deferred_step(&parameters, &state, &command);
        const int32_t error_q22 = results().speed.speed_reference_q22 - input.speed_q22;
        const deferred_speed_results_t law = results().speed;
        const int32_t law_q24 = law.speed_law_torque_q24;
        ASSERT_EQ(law_q24, speed_smc_reaching_torque_q24(&parameters.speed_smc, error_q22) + torque_offset_before_q24);
        interrupt(COMMAND_RUN, 30.0);
        ASSERT_EQ(state.torque_reference_q24,
                  speed_smc_torque_q24(&parameters.speed_smc, law_q24, state.observer.speed_q22,
                                       state.observer.load_torque_q24, law.torque_min_q24, law.torque_max_q24));
        ASSERT_TRUE(input.speed_q22 < 10000000 || law.torque_max_q24 == parameters.torque_mode.torque_max_q24)
            << "from 2.4 rad/s on counts are not slow";
        deferred_step(&parameters, &state, &command);
    }
}

TEST_F(Deferred, the_speed_law_keeps_its_torque_while_its_step_is_late) {
    for (const drive_controller_t controller : {DRIVE_CONTROLLER_TRADITIONAL, DRIVE_CONTROLLER_SALIENT}) {
        configure(controller);
        start();
        period(COMMAND_RUN, 10.0);
        const int32_t law_q24 = results().speed.speed_law_torque_q24;
        ASSERT_GT(law_q24, 0);
        interrupt(COMMAND_RUN, 10.0);
        for (int k = 0; k < 4; k++) {
            interrupt(COMMAND_RUN, 20.0);
            ASSERT_EQ(results().speed.speed_law_torque_q24, law_q24);
        }
        deferred_step(&parameters, &state, &command);
        period(COMMAND_RUN, 20.0);
        EXPECT_GT(results().speed.speed_law_torque_q24, law_q24);
    }
}

TEST_F(Deferred, a_run_begins_without_torque_and_integral_of_the_speed_law_also_after_a_late_step) {
    configure(DRIVE_CONTROLLER_TRADITIONAL);
    start();
    EXPECT_EQ(state.torque_reference_q24, 0) << "first period of a run";
    for (int k = 0; k < 400; k++) {
        period(COMMAND_RUN, 2.0);
    }
    const int64_t integral_q54 = state.deferred.speed_pi.integral_q54;
    ASSERT_GT(integral_q54, 0);
    EXPECT_GT(state.torque_reference_q24, 0);
    interrupt(COMMAND_RUN, 2.0); // this step will be late
    EXPECT_FALSE(interrupt(COMMAND_OFF));
    EXPECT_EQ(results().speed.speed_law_torque_q24, 0) << "in effect without a step";
    EXPECT_TRUE(deferred_step(&parameters, &state, &command)) << "with the integral of the run";
    EXPECT_EQ(results().speed.speed_law_torque_q24, 0);
    EXPECT_TRUE(interrupt(COMMAND_RUN, 2.0)) << "the next run, without a period between";
    EXPECT_EQ(state.torque_reference_q24, 0);
    EXPECT_TRUE(deferred_step(&parameters, &state, &command));
    EXPECT_GT(state.deferred.speed_pi.integral_q54, 0);
    EXPECT_LT(state.deferred.speed_pi.integral_q54, integral_q54 / 100) << "of one step";
    period(COMMAND_OFF);
    period(COMMAND_OFF);
    EXPECT_EQ(state.deferred.speed_pi.integral_q54, 0);
    EXPECT_EQ(results().speed.speed_law_torque_q24, 0);
}

TEST_F(Deferred, the_integral_of_the_pi_stays_at_a_torque_limit_below_its_own) {
    configure(DRIVE_CONTROLLER_TRADITIONAL);
    state.torque_limit_q24 = fixed_point::to_fixed(1.0, fixed_point::Q24); // as by heat
    ASSERT_LT(state.torque_limit_q24, parameters.speed_pi.torque_max_q24 / 2);
    start();
    for (int k = 0; k < 4000; k++) {
        period(COMMAND_RUN);
    }
    EXPECT_EQ(results().speed.speed_law_torque_q24, state.torque_limit_q24) << "of a rotor that does not turn";
    EXPECT_EQ(state.deferred.speed_pi.integral_q54, int64_t(state.torque_limit_q24) << 30);
    speed_rad_s = fixed_point::rad_s(700.0); // the load has gone, the speed is above the reference
    for (int k = 0; k < 100; k++) {
        period(COMMAND_RUN);
    }
    EXPECT_LT(results().speed.speed_law_torque_q24, state.torque_limit_q24 / 2);
}

TEST_F(Deferred, in_torque_mode_the_reference_is_the_command_without_load_and_friction) {
    for (const drive_controller_t controller :
         {DRIVE_CONTROLLER_TRADITIONAL, DRIVE_CONTROLLER_PAPER, DRIVE_CONTROLLER_SALIENT}) {
        configure(controller);
        speed_rad_s = 20.0;
        start();
        state.observer.load_torque_q24 = 5 << 24;
        for (int k = 0; k < 10; k++) {
            ASSERT_TRUE(torque_period(3.0));
        }
        ASSERT_NE(state.observer.load_torque_q24, 0);
        EXPECT_EQ(state.torque_reference_q24, (3 << 24) + torque_offset_q24(&state.deferred.torque_offset))
            << controller;
        EXPECT_EQ(state.deferred.mode, DRIVE_MODE_TORQUE);
        EXPECT_EQ(results().speed.speed_reference_q22, 0);
        for (int k = 0; k < 10; k++) {
            ASSERT_TRUE(torque_period(-3.0));
        }
        if (controller == DRIVE_CONTROLLER_SALIENT) {
            EXPECT_NEAR(state.torque_reference_q24 / fixed_point::Q24, -3.0, 0.01);
        } else {
            EXPECT_EQ(state.torque_reference_q24, 0) << "drives forwards only";
        }
        for (int k = 0; k < 10; k++) {
            ASSERT_TRUE(torque_period(100.0));
        }
        EXPECT_NEAR(state.torque_reference_q24 / fixed_point::Q24, 19.1, 0.01);
    }
}

TEST_F(Deferred, a_run_in_torque_mode_begins_without_torque_whatever_the_load) {
    parameters.torque_mode.slew_q24 = 1 << 20;
    for (int k = 0; k < 41; k++) {
        period(COMMAND_OFF);
    }
    state.observer.load_torque_q24 = 8 << 24;
    ASSERT_TRUE(torque_period(3.0));
    EXPECT_EQ(state.torque_reference_q24, 0) << "the results in effect are from the time before the run";
    ASSERT_GT(state.observer.load_torque_q24, 7 << 24);
    torque_period(3.0);
    EXPECT_EQ(state.torque_reference_q24, 1 << 20) << "slew rate from zero";
}

TEST_F(Deferred, torque_mode_begins_with_the_present_torque) {
    for (const drive_controller_t controller :
         {DRIVE_CONTROLLER_TRADITIONAL, DRIVE_CONTROLLER_PAPER, DRIVE_CONTROLLER_SALIENT}) {
        configure(controller);
        parameters.torque_mode.slew_q24 = 1 << 16;
        speed_rad_s = 20.0;
        start();
        for (int k = 0; k < 300; k++) {
            period(COMMAND_RUN, 200.0);
        }
        const int32_t before_q24 = state.torque_reference_q24;
        ASSERT_GT(before_q24, 1 << 24);
        torque_period(0.0); // the command is handed over: still the speed law's torque
        int32_t last_q24 = state.torque_reference_q24;
        for (int k = 0; k < 50; k++) {
            torque_period(0.0);
            const int32_t step_q24 = last_q24 - state.torque_reference_q24;
            ASSERT_NEAR(step_q24, 1 << 16, 1 << 13) << controller << " " << k << ": but for the torque offset";
            last_q24 = state.torque_reference_q24;
        }
    }
}

TEST_F(Deferred, speed_mode_begins_with_the_present_torque_and_speed) {
    configure(DRIVE_CONTROLLER_TRADITIONAL);
    speed_rad_s = 20.0;
    start();
    for (int k = 0; k < 100; k++) {
        torque_period(6.0);
    }
    const double speed_rpm = state.observer.speed_q22 / fixed_point::Q22 * 30.0 / fixed_point::PI;
    period(COMMAND_RUN, speed_rpm);
    const int32_t error_q22 = results().speed.speed_reference_q22 - state.deferred_request.input.speed_q22;
    const double proportional_Nm = parameters.speed_pi.kp_q16 / fixed_point::Q16 * error_q22 / fixed_point::Q22;
    EXPECT_LT(std::fabs(proportional_Nm), 0.5);
    EXPECT_NEAR(results().speed.speed_law_torque_q24 / fixed_point::Q24, 6.0 + proportional_Nm, 1e-3)
        << "integral of the PI";
    configure(DRIVE_CONTROLLER_SALIENT);
    parameters.speed_ramp_q22 = 1 << 10;
    start();
    for (int k = 0; k < 100; k++) {
        torque_period(6.0);
    }
    const int32_t speed_q22 = state.deferred_request.input.speed_q22;
    period(COMMAND_RUN, 1000.0);
    EXPECT_EQ(results().speed.speed_reference_q22, speed_q22 + (1 << 10)) << "ramp from the present speed";
}

TEST_F(Deferred, a_stop_in_torque_mode_ramps_the_speed_to_zero) {
    speed_rad_s = 20.0;
    start();
    for (int k = 0; k < 100; k++) {
        torque_period(3.0);
    }
    for (int k = 0; k < 3; k++) {
        ASSERT_TRUE(torque_period(3.0, COMMAND_STOP));
    }
    EXPECT_EQ(state.deferred.mode, DRIVE_MODE_SPEED);
    EXPECT_LT(state.torque_reference_q24, 0) << "salient brakes";
}

TEST_F(Deferred, a_late_step_does_not_undo_the_reset_of_the_observer) {
    speed_rad_s = 20.0; // without slow counts
    start();
    state.deferred.bandwidth.mean_innovation_q32 = int64_t(3 * COUNT) << 32;
    period(COMMAND_RUN);
    ASSERT_GT(results().bandwidth.threshold_mean, 11u * COUNT);
    sample.adc.phase_current_counts[0] = 4000;
    EXPECT_FALSE(period(COMMAND_OFF));
    sample.adc.phase_current_counts[0] = 0;
    see_the_cause_gone();
    ASSERT_GT(results().bandwidth.threshold_mean, 11u * COUNT) << "the end of a run does not reset it";
    interrupt(COMMAND_OFF); // this step will be late
    interrupt(COMMAND_CLEAR_FAULT);
    ASSERT_EQ(state.state_machine.state, DRIVE_STATE_READY);
    EXPECT_EQ(results().bandwidth.threshold_mean, 0u);
    deferred_step(&parameters, &state, &command);
    EXPECT_EQ(results().bandwidth.threshold_mean, 0u) << "the late step is without effect";
    period(COMMAND_OFF);
    EXPECT_LT(results().bandwidth.threshold_mean, 4u * COUNT);
    EXPECT_EQ(results().generation, state.deferred_request.generation);
}

TEST_F(Deferred, a_fault_resets_the_step_once_in_the_first_period_without_a_failed_check) {
    for (const auto controller : {DRIVE_CONTROLLER_TRADITIONAL, DRIVE_CONTROLLER_PAPER, DRIVE_CONTROLLER_SALIENT}) {
        configure(controller);
        sample.adc.phase_current_counts[0] = 0;
        start();
        period(COMMAND_RUN);
        const uint32_t before = state.deferred_request.generation;
        sample.adc.phase_current_counts[0] = 4000;
        for (int k = 0; k < 3; k++) {
            EXPECT_FALSE(period(COMMAND_RUN));
            ASSERT_EQ(state.state_machine.state, DRIVE_STATE_FAULT);
            EXPECT_EQ(state.torque_reference_q24, 0);
            EXPECT_EQ(state.duty_q15[0], -32768);
            EXPECT_EQ(state.deferred_request.generation, before);
        }
        sample.adc.phase_current_counts[0] = 0;
        period(COMMAND_RUN);
        EXPECT_EQ(state.deferred_request.generation, before + 1);
        see_the_cause_gone();
        period(COMMAND_CLEAR_FAULT);
        ASSERT_EQ(state.state_machine.state, DRIVE_STATE_READY);
        EXPECT_EQ(state.deferred_request.generation & 0xFFFF, (before + 1) & 0xFFFF);
    }
}

TEST_F(Deferred, a_run_that_is_switched_off_resets_the_step_at_once) {
    start();
    const uint32_t before = state.deferred_request.generation;
    period(COMMAND_OFF);
    EXPECT_EQ(state.deferred_request.generation, before + 1);
}

TEST_F(Deferred, a_late_check_of_the_voltage_of_the_time_before_a_reset_is_no_new_fault) {
    start();
    sample.adc.phase_current_counts[0] = 4000;
    EXPECT_FALSE(period(COMMAND_OFF));
    sample.adc.phase_current_counts[0] = 0;
    speed_rad_s = 5.0; // a count or two a period: the encoder is not frozen
    see_the_cause_gone();
    const uint16_t healthy = sample.adc.bus_voltage_counts;
    sample.adc.bus_voltage_counts = 0;
    interrupt(COMMAND_OFF); // this step will be late
    ASSERT_EQ(state.deferred_request.input.dc_link_voltage_q6, 0);
    sample.adc.bus_voltage_counts = healthy;
    interrupt(COMMAND_CLEAR_FAULT);
    ASSERT_EQ(state.state_machine.state, DRIVE_STATE_READY);
    deferred_step(&parameters, &state, &command);
    for (int k = 0; k < 10; k++) {
        period(COMMAND_OFF);
        EXPECT_EQ(state.state_machine.state, DRIVE_STATE_READY) << k;
    }
}

TEST_F(Deferred, the_misalignment_survives_every_reset_and_a_late_step) {
    start();
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        misalignment_phase_t &learned = state.deferred.misalignment.phase[phase];
        learned.offset = int32_t(1000 * (phase + 1));
        learned.offset_q40 = std::llround(std::ldexp(learned.offset, 39) / parameters.misalignment.probe_angle);
    }
    const auto kept = [this] {
        for (unsigned phase = 0; phase < machine_tables.phases; phase++) {
            EXPECT_EQ(results().predictive.misalignment[phase], int32_t(1000 * (phase + 1)));
        }
    };
    period(COMMAND_RUN);
    kept();
    interrupt(COMMAND_RUN);
    interrupt(COMMAND_OFF);
    kept();
    deferred_step(&parameters, &state, &command);
    kept();
    period(COMMAND_OFF);
    kept();
    sample.adc.phase_current_counts[0] = 4000;
    period(COMMAND_OFF);
    sample.adc.phase_current_counts[0] = 0;
    see_the_cause_gone();
    interrupt(COMMAND_CLEAR_FAULT);
    ASSERT_EQ(state.state_machine.state, DRIVE_STATE_READY);
    kept();
    deferred_step(&parameters, &state, &command);
    kept();
    control_prepare(&parameters, &state); // new parameters
    kept();
}

// Each update of the inertia would see the same value of a torque that swings in step with it.
TEST_F(Deferred, the_inertia_is_identified_from_the_mean_torque_since_its_last_update) {
    start();
    while (state.deferred.inertia.updates == 0) {
        period(COMMAND_RUN);
    }
    for (const bool swings : {false, true}) {
        const uint32_t before_q23 = state.deferred.inertia.sum_q23;
        for (int k = 0; k < 10 * DEFERRED_COMMON_PERIODS; k++) {
            interrupt(COMMAND_RUN);
            state.deferred_request.input.torque_sum_q24 = (swings && k % 4 < 2 ? -4 : 4) * (1 << 24);
            EXPECT_TRUE(deferred_step(&parameters, &state, &command));
        }
        const int32_t part_q23 = (4 << 24) >> (2 * parameters.inertia.window_shift + 1);
        EXPECT_EQ(int32_t(state.deferred.inertia.sum_q23 - before_q23), swings ? 0 : 10 * part_q23);
    }
}

TEST_F(Deferred, a_torque_at_its_limit_in_either_direction_while_the_speed_changes_is_a_transient) {
    start();
    const int32_t max_q24 = state.deferred.conduction.torque_max_q24,
                  min_q24 = state.deferred.conduction.torque_min_q24;
    ASSERT_LT(min_q24, 0);
    for (const int32_t torque_q24 : {max_q24, max_q24 - (1 << 16), 0, min_q24 + (1 << 16), min_q24}) {
        state.deferred.inertia.transient_windows = 0;
        for (int k = 0; k < 2 * DEFERRED_COMMON_PERIODS; k++) {
            interrupt(COMMAND_RUN);
            state.deferred_request.input.torque_reference_q24 = torque_q24;
            deferred_step(&parameters, &state, &command);
        }
        ASSERT_TRUE(state.deferred.approaches_reference);
        const bool limited = torque_q24 == max_q24 || torque_q24 == min_q24;
        EXPECT_EQ(state.deferred.inertia.transient_windows > 0, limited) << torque_q24;
    }
}

TEST_F(Deferred, a_reference_is_approached_until_the_speed_has_been_within_a_16th_with_a_torque_below_its_limit) {
    parameters.speed_ramp_q22 = INT32_MAX;
    start();
    double reference_rpm = 600.0;
    const int32_t limit_q24 = state.deferred.conduction.torque_max_q24;
    for (const double off : {1.0 / 20.0, 1.0 / 12.0}) {
        for (const bool limited : {false, true}) {
            reference_rpm += 100.0;
            const double speed_rpm = reference_rpm * (1.0 - off);
            for (int k = 0; k < 2000; k++) {
                interrupt(COMMAND_RUN, reference_rpm);
                deferred_input_t &input = state.deferred_request.input;
                input.speed_q22 = fixed_point::to_fixed(fixed_point::rad_s(speed_rpm), fixed_point::Q22);
                input.torque_reference_q24 = limited ? limit_q24 : limit_q24 / 2;
                deferred_step(&parameters, &state, &command);
            }
            EXPECT_EQ(state.deferred.approaches_reference, limited || off > 1.0 / 16.0) << off << " " << limited;
        }
    }
}

TEST_F(Deferred, a_periodic_load_is_learned_in_turns_in_which_the_load_moves_and_is_not_constant_over_the_strokes) {
    speed_rad_s = 20.0;
    start();
    for (const bool moving : {false, true}) {
        for (const bool constant : {false, true}) {
            state.deferred.periodic_load.moved = false;
            for (int k = 0; k < DEFERRED_COMMON_PERIODS; k++) {
                state.deferred.moving_load.withheld = moving ? 3 : 0;
                state.deferred.moving_load.ticks = 1000;
                state.deferred.stroke_mean.remaining = constant ? 0 : 1000;
                period(COMMAND_RUN);
            }
            EXPECT_EQ(state.deferred.load_constant, constant);
            EXPECT_EQ(state.deferred.periodic_load.moved, moving && !constant) << moving << constant;
        }
    }
}

TEST_F(Deferred, a_run_on_a_rotor_that_turns_backwards_begins_with_the_limit_of_generating_phases) {
    configure(DRIVE_CONTROLLER_TRADITIONAL);
    speed_rad_s = -40.0;
    for (int k = 0; k < 4000; k++) {
        period(COMMAND_OFF);
    }
    ASSERT_EQ(state.state_machine.state, DRIVE_STATE_READY);
    const ditc_hysteresis_limit_t generating = torque_control_limit(&parameters, state.observer.speed_q22);
    ASSERT_LT(generating.current_q9, parameters.hysteresis.current_limit_q9);
    ASSERT_TRUE(interrupt(COMMAND_RUN));
    EXPECT_NEAR(results().limit.current_q9, generating.current_q9, 5);
    EXPECT_EQ(results().limit.state, generating.state);
}

TEST_F(Deferred, the_network_of_the_pid_begins_anew_with_each_run) {
    configure(DRIVE_CONTROLLER_PAPER);
    bp_tuner_t initial{};
    bp_tuner_reset(&parameters.duty.pid, &initial);
    bp_neuron_t *neurons = state.deferred.tuner.network.hidden;
    for (int run = 0; run < 2; run++) {
        for (int k = 0; k < 41; k++) {
            period(COMMAND_OFF);
        }
        ASSERT_TRUE(interrupt(COMMAND_RUN));
        for (int i = 0; i < BP_HIDDEN; i++) {
            for (int j = 0; j < 3; j++) {
                ASSERT_EQ(neurons[i].input.value[j], initial.network.hidden[i].input.value[j]) << run;
                ASSERT_EQ(neurons[i].output.value[j], initial.network.hidden[i].output.value[j]) << run;
                ASSERT_EQ(neurons[i].output.increment[j], 0) << run;
            }
        }
        deferred_step(&parameters, &state, &command);
        for (int i = 0; i < BP_HIDDEN; i++) { // learned
            neurons[i].input.value[0] += 1 << 20;
            neurons[i].output.value[0] -= 1 << 20;
            neurons[i].output.increment[0] = 1 << 10;
        }
        period(COMMAND_RUN);
    }
}

TEST_F(Deferred, tuned_parameters_are_in_effect_at_once_with_the_identified_inertia) {
    start();
    state.deferred.inertia.shift = -1;
    tune();
    const int32_t gain_q24 = state.deferred.speed_smc.gain_q24, rate_q8 = state.deferred.inertia.laws.rate_q8;
    EXPECT_NEAR(double(gain_q24) / parameters.inertia.reaching_gain_q24, 2.0, 1e-6);
    parameters.inertia.reaching_gain_q24 /= 2;
    parameters.inertia.rate_q8 /= 4;
    tune();
    EXPECT_NEAR(double(gain_q24) / state.deferred.speed_smc.gain_q24, 2.0, 1e-6);
    EXPECT_NEAR(double(rate_q8) / state.deferred.inertia.laws.rate_q8, 4.0, 1e-2);
}

TEST_F(Deferred, counts_of_an_encoder_of_13_bits_are_never_slow) {
    for (const auto &[bits, slow] : {std::pair{12u, true}, std::pair{13u, false}}) {
        configure(DRIVE_CONTROLLER_SALIENT);
        parameters.slow_counts = configured(DRIVE_CONTROLLER_SALIENT, uint32_t(RATE_HZ), bits).slow_counts;
        start();
        for (unsigned k = 0; k < RATE_HZ / 10; k++) {
            period(COMMAND_RUN);
        }
        EXPECT_EQ(results().slow_counts.slow, slow) << bits;
    }
}

TEST_F(Deferred, while_counts_are_slow_a_load_limits_the_braking_torque_of_speed_mode_and_nothing_in_torque_mode) {
    parameters.slow_counts = configured(DRIVE_CONTROLLER_SALIENT, uint32_t(RATE_HZ), 12).slow_counts;
    start();
    for (const bool torque_mode : {false, true}) {
        command.mode = torque_mode ? DRIVE_MODE_TORQUE : DRIVE_MODE_SPEED;
        command.torque_reference_q24 = -(2 << 24);
        for (unsigned k = 0; k < RATE_HZ / 10; k++) {
            interrupt(COMMAND_RUN);
            state.deferred_request.input.load_torque_q24 = 3 << 24; // more than a sixteenth of the largest torque
            deferred_step(&parameters, &state, &command);
        }
        ASSERT_TRUE(results().slow_counts.slow);
        EXPECT_EQ(results().speed.torque_min_q24, torque_mode ? -(2 << 24) : 0);
        EXPECT_EQ(results().speed.torque_max_q24, torque_mode ? -(2 << 24) : state.deferred.conduction.torque_max_q24);
    }
}

TEST_F(Deferred, while_counts_are_slow_a_misalignment_by_the_flux_linkage_is_learned_beyond_what_excuses_it) {
    constexpr double DEGREE = 0x1p32 / 360.0;
    for (const double told_deg : {0.0, 0.02, -0.02, 10.0, -10.0}) {
        state = {};
        configure(DRIVE_CONTROLLER_SALIENT);
        parameters.slow_counts = configured(DRIVE_CONTROLLER_SALIENT, uint32_t(RATE_HZ), 12).slow_counts;
        start();
        for (unsigned k = 0; k < RATE_HZ / 4; k++) {
            std::fill(std::begin(state.flux_misalignment), std::end(state.flux_misalignment),
                      int32_t(told_deg * DEGREE));
            period(COMMAND_RUN);
        }
        ASSERT_TRUE(results().slow_counts.slow);
        for (unsigned phase = 0; phase < machine_tables.phases; phase++) {
            const double offset_deg = state.deferred.misalignment.phase[phase].offset / DEGREE;
            if (std::fabs(told_deg) < 1.0) {
                EXPECT_EQ(offset_deg, 0.0) << told_deg;
            } else {
                EXPECT_GT(offset_deg / told_deg, 0.0) << told_deg;
                EXPECT_LT(offset_deg / told_deg, 1.0) << told_deg;
            }
        }
    }
}

TEST_F(Deferred, slow_counts_end_with_the_first_fast_one_and_with_a_reset_of_the_observer) {
    parameters.slow_counts = configured(DRIVE_CONTROLLER_SALIENT, uint32_t(RATE_HZ), 12).slow_counts;
    start();
    for (unsigned k = 0; k < RATE_HZ / 500; k++) {
        period(COMMAND_RUN);
    }
    ASSERT_TRUE(results().slow_counts.slow);
    EXPECT_EQ(state.innovation, 0) << "at rest within a count";
    observe_forget_load(&state);
    EXPECT_FALSE(deferred_in_effect(&state)->slow_counts.slow);
    speed_rad_s = 5.0;
    for (int k = 0; k < 3; k++) {
        period(COMMAND_RUN);
    }
    EXPECT_FALSE(results().slow_counts.slow);
}

TEST_F(Deferred, a_trigger_in_a_skipped_period_lengthens_the_holdoff) {
    speed_rad_s = 5.0; // without slow counts
    for (int k = 0; k < 60000; k++) {
        period(COMMAND_OFF);
    }
    ASSERT_EQ(state.bandwidth.stage, OBSERVER_BANDWIDTH_STEADY_STAGE);
    interrupt(COMMAND_OFF);
    turns += 4.0 / (1 << ENCODER_BITS);
    interrupt(COMMAND_OFF); // skipped
    ASSERT_LT(state.bandwidth.stage, OBSERVER_BANDWIDTH_STEADY_STAGE);
    EXPECT_EQ(results().bandwidth.holdoff_ticks, RATE_HZ / 1000);
    deferred_step(&parameters, &state, &command);
    EXPECT_EQ(results().bandwidth.holdoff_ticks, RATE_HZ / 1000) << "the input is from the period before";
    period(COMMAND_OFF);
    EXPECT_NEAR(results().bandwidth.holdoff_ticks, RATE_HZ / 1000.0 * 1.25, 1.0);
}

// The run that a step was requested in has ended, and the next one has begun, before the step has ended.
TEST_F(Deferred, a_run_without_a_step_between_it_and_the_one_before_begins_at_the_present_speed) {
    speed_rad_s = 20.0;
    parameters.speed_ramp_q22 = 1 << 10;
    start();
    for (int k = 0; k < 4000; k++) {
        period(COMMAND_RUN, 600.0);
    }
    ASSERT_GT(state.deferred.speed_reference_q22, state.observer.speed_q22 + 3000 * (1 << 10));
    interrupt(COMMAND_RUN, 600.0); // this step will be late
    EXPECT_FALSE(interrupt(COMMAND_OFF));
    deferred_step(&parameters, &state, &command);
    ASSERT_TRUE(interrupt(COMMAND_RUN, 600.0));
    ASSERT_TRUE(state.deferred_request.input.run);
    const int32_t speed_q22 = state.deferred_request.input.speed_q22;
    deferred_step(&parameters, &state, &command);
    EXPECT_EQ(results().speed.speed_reference_q22, speed_q22 + (1 << 10));
}

TEST_F(Deferred, a_run_in_torque_mode_without_a_step_between_it_and_the_one_before_begins_without_torque) {
    parameters.torque_mode.slew_q24 = 1 << 20;
    speed_rad_s = 20.0;
    start();
    for (int k = 0; k < 100; k++) {
        torque_period(5.0);
    }
    ASSERT_GT(state.torque_reference_q24, 4 << 24);
    command.mode = DRIVE_MODE_TORQUE;
    interrupt(COMMAND_RUN);
    deferred_compute(&parameters, &state, &command);
    EXPECT_FALSE(interrupt(COMMAND_OFF)) << "pre-empts the step";
    deferred_complete(&state.deferred_request, &state.deferred.response);
    ASSERT_TRUE(interrupt(COMMAND_RUN));
    deferred_step(&parameters, &state, &command);
    EXPECT_EQ(results().speed.torque_max_q24, 1 << 20) << "slew rate from zero";
}

TEST_F(Deferred, a_run_begins_without_torque_offset_and_periodic_load_of_the_one_before) {
    speed_rad_s = 20.0;
    start();
    for (int k = 0; k < 10; k++) {
        period(COMMAND_RUN);
    }
    const auto nothing_left = [this] {
        return torque_offset_q24(&state.deferred.torque_offset) == 0 && state.deferred.periodic_load.torque_q24 == 0 &&
               !state.deferred.periodic_load.engaged;
    };
    state.deferred.torque_offset.offset_q56 = int64_t(1) << 56;
    state.deferred.periodic_load.torque_q24 = 1 << 24;
    state.deferred.periodic_load.engaged = true;
    period(COMMAND_RUN);
    ASSERT_FALSE(nothing_left());
    EXPECT_EQ(results().speed.periodic_load_q24, 1 << 24);
    period(COMMAND_OFF);
    period(COMMAND_OFF);
    EXPECT_TRUE(nothing_left());
    ASSERT_TRUE(period(COMMAND_RUN));
    const int32_t error_q22 = results().speed.speed_reference_q22 - state.deferred_request.input.speed_q22;
    EXPECT_EQ(results().speed.speed_law_torque_q24, speed_smc_reaching_torque_q24(&parameters.speed_smc, error_q22));
    EXPECT_EQ(results().speed.periodic_load_q24, 0);
}

TEST_F(Deferred, a_periodic_load_of_speed_mode_is_forgotten_in_torque_mode) {
    speed_rad_s = 20.0;
    start();
    period(COMMAND_RUN);
    state.deferred.periodic_load.torque_q24 = 1 << 24;
    state.deferred.periodic_load.engaged = true;
    for (int k = 0; k < 2 * DEFERRED_COMMON_PERIODS; k++) {
        torque_period(1.0);
    }
    EXPECT_FALSE(state.deferred.periodic_load.engaged);
    period(COMMAND_RUN);
    period(COMMAND_RUN);
    EXPECT_EQ(results().speed.periodic_load_q24, 0);
}

TEST_F(Deferred, a_frozen_encoder_is_found_as_soon_with_late_steps_as_without) {
    for (const int late : {0, 7}) {
        configure(DRIVE_CONTROLLER_SALIENT);
        speed_rad_s = 20.0;
        for (int k = 0; k < 4000; k++) {
            period(COMMAND_OFF);
        }
        ASSERT_EQ(state.state_machine.state, DRIVE_STATE_READY);
        speed_rad_s = 0.0;
        int periods = 0;
        while (state.state_machine.state == DRIVE_STATE_READY && periods < 400) {
            interrupt(COMMAND_OFF);
            if (periods++ % (late + 1) == late) {
                deferred_step(&parameters, &state, &command);
            }
        }
        EXPECT_EQ(state.state_machine.record.fault, FAULT_ENCODER);
        EXPECT_LT(periods, 40 + late) << late;
    }
}

TEST_F(Deferred, a_trigger_is_handed_over_once) {
    speed_rad_s = 5.0; // without slow counts
    for (int k = 0; k < 60000; k++) {
        period(COMMAND_OFF);
    }
    ASSERT_EQ(state.bandwidth.stage, OBSERVER_BANDWIDTH_STEADY_STAGE);
    turns += 4.0 / (1 << ENCODER_BITS);
    period(COMMAND_OFF);
    EXPECT_NE(state.deferred_request.input.bandwidth.trigger, OBSERVER_TRIGGER_NONE);
    for (int k = 0; k < 20; k++) {
        period(COMMAND_OFF);
        EXPECT_EQ(state.deferred_request.input.bandwidth.trigger, OBSERVER_TRIGGER_NONE) << k;
    }
}

} // namespace
