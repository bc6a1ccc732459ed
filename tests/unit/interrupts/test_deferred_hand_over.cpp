// The control interrupt's part of the deferred step: what a reset keeps, and every value that is handed over.
#include <algorithm>
#include <cstdint>

#include <gtest/gtest.h>

extern "C" {
#include "interrupts/deferred.h"
}

#include "support/configured.h"
#include "support/whole_sample.h"

namespace {

class HandOver : public testing::Test {
  protected:
    HandOver() { reset(DRIVE_CONTROLLER_SALIENT); }

    void reset(drive_controller_t controller) {
        parameters = configured(controller, 40000, 17);
        control_reset(&parameters, &state);
    }

    // Results in effect with a value of its own in each member.
    void put_into_effect(uint32_t generation) {
        state.deferred_request.generation = generation;
        deferred_results_t &results = state.deferred.response.results[state.deferred.response.latest];
        results = deferred_results_t{};
        results.generation = generation;
        results.fault_mask = 101;
        results.speed = {102, 103, 104, -105, 106};
        results.bandwidth = {107, 108, 9, 10};
        results.predictive.conduction = CONDUCTION_INITIAL + 1;
        for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
            results.predictive.misalignment[phase] = int32_t(200 + phase);
        }
        results.observer = {109, 3};
        results.slow_counts.slow = true;
        results.limit = {110, -111};
        results.duty = {112, 113, 114, 115};
    }

    void expect_kept() const {
        const deferred_results_t &results = *deferred_in_effect(&state);
        EXPECT_EQ(results.fault_mask, 101u);
        for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
            EXPECT_EQ(results.predictive.misalignment[phase], int32_t(200 + phase));
        }
        EXPECT_EQ(results.observer.acceleration_q32, 109);
        EXPECT_EQ(results.observer.load_shift, 3);
        EXPECT_FALSE(results.slow_counts.slow) << "until the next step";
        EXPECT_EQ(results.limit.current_q9, 110);
        EXPECT_EQ(results.limit.state, -111);
        EXPECT_EQ(results.duty.factor_q16, 112);
        EXPECT_EQ(results.duty.duty_per_torque_q47, 113);
        EXPECT_EQ(results.duty.setpoint_q9, 114);
        EXPECT_EQ(results.duty.lead, 115u);
    }

    void hand_over(bool run = true) { deferred_hand_over(&parameters, &state, &sample, &command, run); }

    control_parameters_t parameters;
    control_state_t state;
    whole_sample_t sample;
    command_t command{};
};

TEST_F(HandOver, a_reset_of_the_run_keeps_all_results_but_those_of_the_speed_law_and_the_conduction_angles) {
    put_into_effect(0xABCDFFFFu);
    deferred_reset_run(&state);
    EXPECT_EQ(state.deferred_request.generation, 0xABCD0000u) << "the observer's half is unchanged";
    const deferred_results_t &results = *deferred_in_effect(&state);
    ASSERT_EQ(&results, &state.deferred_request.initial);
    expect_kept();
    EXPECT_EQ(results.bandwidth.threshold_mean, 107u);
    EXPECT_EQ(results.bandwidth.holdoff_ticks, 108u);
    EXPECT_EQ(results.bandwidth.withheld_stages, 9);
    EXPECT_EQ(results.bandwidth.trigger_stage_edge, 10);
    EXPECT_EQ(results.predictive.conduction, unsigned(CONDUCTION_INITIAL));
    EXPECT_EQ(results.speed.speed_reference_q22, 0);
    EXPECT_EQ(results.speed.speed_law_torque_q24, 0);
    EXPECT_EQ(results.speed.periodic_load_q24, 0);
    EXPECT_EQ(results.speed.torque_min_q24, 0);
    EXPECT_EQ(results.speed.torque_max_q24, 0);
}

TEST_F(HandOver, a_reset_of_the_observer_keeps_all_results_but_the_limits_of_its_bandwidth) {
    put_into_effect(0xFFFF1234u);
    deferred_reset_observer(&state);
    EXPECT_EQ(state.deferred_request.generation, 0x00001234u) << "the run's half is unchanged";
    const deferred_results_t &results = *deferred_in_effect(&state);
    ASSERT_EQ(&results, &state.deferred_request.initial);
    expect_kept();
    EXPECT_EQ(results.bandwidth.threshold_mean, 0u);
    EXPECT_EQ(results.bandwidth.holdoff_ticks, 0u);
    EXPECT_EQ(results.bandwidth.withheld_stages, 0);
    EXPECT_EQ(results.bandwidth.trigger_stage_edge, 0);
    EXPECT_EQ(results.predictive.conduction, CONDUCTION_INITIAL + 1u);
    EXPECT_EQ(results.speed.speed_reference_q22, 102);
    EXPECT_EQ(results.speed.speed_law_torque_q24, 103);
    EXPECT_EQ(results.speed.periodic_load_q24, 104);
    EXPECT_EQ(results.speed.torque_min_q24, -105);
    EXPECT_EQ(results.speed.torque_max_q24, 106);
}

TEST_F(HandOver, every_value_of_the_period_is_handed_over_with_every_law) {
    for (const drive_controller_t controller :
         {DRIVE_CONTROLLER_TRADITIONAL, DRIVE_CONTROLLER_PAPER, DRIVE_CONTROLLER_SALIENT}) {
        for (const bool run : {false, true}) {
            reset(controller);
            state.deferred_request.generation = 0x00070009u;
            state.deferred_request.skipped = 4;
            state.observer.angle_q64 = 0x123456789ABCDEF0u;
            state.observer.speed_q22 = -11;
            state.torque_reference_q24 = -12;
            state.measurement.encoder_angle = 13;
            state.measurement.dc_link_voltage_q6 = 14;
            state.measurement.commutation.electrical = 15;
            state.measurement.current_q9[1] = 16;
            state.deferred.misalignment.phase_index = 1;
            sample.time_us = 5;
            command.time_us = UINT32_MAX - 4;
            hand_over(run);
            const deferred_input_t &input = state.deferred_request.input;
            EXPECT_EQ(input.generation, 0x00070009u);
            EXPECT_EQ(input.periods, 5u) << "with the skipped ones";
            EXPECT_EQ(input.angle, 0x12345678u);
            EXPECT_EQ(input.speed_q22, -11);
            EXPECT_EQ(input.torque_reference_q24, -12);
            EXPECT_EQ(input.encoder_angle, 13u);
            EXPECT_EQ(input.dc_link_voltage_q6, 14);
            EXPECT_EQ(input.electrical, 15u);
            EXPECT_EQ(input.current_q9, 16);
            EXPECT_EQ(input.command_age_us, 10u) << "across the end of the clock";
            EXPECT_EQ(input.run, run);
            EXPECT_EQ(state.deferred_request.requests, 1u);
            EXPECT_EQ(state.deferred_request.skipped, 0u);
        }
    }
}

TEST_F(HandOver, the_sample_of_an_adaptive_bandwidth_is_handed_over_once_and_none_of_another) {
    for (const bool adaptive : {false, true}) {
        for (const bool from_edge : {false, true}) {
            reset(DRIVE_CONTROLLER_SALIENT);
            parameters.bandwidth.schedule.adaptive = adaptive;
            state.innovation = -21;
            state.measurement.angle_from_edge = from_edge;
            state.bandwidth.stage = 5;
            state.bandwidth.trigger = OBSERVER_TRIGGER_IN_STEADY_STATE;
            hand_over();
            const observer_bandwidth_sample_t &handed = state.deferred_request.input.bandwidth;
            EXPECT_EQ(handed.innovation, adaptive ? -21 : 0);
            EXPECT_EQ(handed.from_edge, adaptive && from_edge);
            EXPECT_EQ(handed.stage, adaptive ? 5u : 0u);
            EXPECT_EQ(handed.trigger, adaptive ? OBSERVER_TRIGGER_IN_STEADY_STATE : OBSERVER_TRIGGER_NONE);
            EXPECT_EQ(state.bandwidth.trigger, adaptive ? OBSERVER_TRIGGER_NONE : OBSERVER_TRIGGER_IN_STEADY_STATE);
        }
    }
}

TEST_F(HandOver, a_sample_of_the_bp_pid_is_learned_from_once_and_only_while_a_phase_is_regulated) {
    reset(DRIVE_CONTROLLER_PAPER);
    state.duty.pid.sample = {{31, -32, 33}, true};
    hand_over();
    EXPECT_FALSE(state.deferred_request.input.pid.learns) << "no phase is regulated";
    EXPECT_TRUE(state.duty.pid.sample.learns);

    state.duty.regulated = 2;
    state.measurement.current_q9[2] = 34;
    state.measurement.commutation.electrical = 5;
    state.deferred.response.completed = state.deferred_request.requests;
    hand_over();
    const deferred_input_t &input = state.deferred_request.input;
    EXPECT_TRUE(input.pid.learns);
    EXPECT_EQ(input.pid.term_q31[0], 31);
    EXPECT_EQ(input.pid.term_q31[1], -32);
    EXPECT_EQ(input.pid.term_q31[2], 33);
    EXPECT_EQ(input.regulated_current_q9, 34);
    EXPECT_EQ(input.regulated_angle, 5u - 2u * parameters.commutation.stroke);
    EXPECT_FALSE(state.duty.pid.sample.learns);

    state.deferred.response.completed = state.deferred_request.requests;
    hand_over();
    EXPECT_FALSE(input.pid.learns) << "the same sample again";
}

TEST_F(HandOver, values_of_predictive_control_are_handed_over_with_it_alone) {
    for (const drive_controller_t controller :
         {DRIVE_CONTROLLER_TRADITIONAL, DRIVE_CONTROLLER_PAPER, DRIVE_CONTROLLER_SALIENT}) {
        reset(controller);
        const bool predictive = parameters.torque_law == TORQUE_LAW_PREDICTIVE;
        state.observer.load_torque_q24 = 41;
        state.observer.speed_correction_q22 = 42;
        state.measurement.torque_sum_q24 = 43;
        state.predictive.torque_shortfall_q24 = 44;
        hand_over();
        const deferred_input_t &input = state.deferred_request.input;
        EXPECT_EQ(input.load_torque_q24, predictive ? 41 : 0);
        EXPECT_EQ(input.speed_correction_q22, predictive ? 42 : 0);
        EXPECT_EQ(input.torque_sum_q24, predictive ? 43 : 0);
        EXPECT_EQ(input.torque_shortfall_q24, predictive ? 44 : 0);
    }
}

TEST_F(HandOver, a_pending_step_keeps_its_input_and_the_period_counts_as_skipped) {
    hand_over();
    state.torque_reference_q24 = 51;
    hand_over();
    EXPECT_EQ(state.deferred_request.input.torque_reference_q24, 0);
    EXPECT_EQ(state.deferred_request.skipped, 1u);
    EXPECT_EQ(state.deferred_request.skipped_total, 1u);
    EXPECT_EQ(state.deferred_request.requests, 1u);
}

TEST_F(HandOver, the_first_step_has_the_inertia_of_the_parameters) {
    const load_observer_inertia_t expected = load_observer_inertia(&parameters.observer, 0);
    EXPECT_NE(expected.acceleration_q32, 0);
    EXPECT_EQ(deferred_in_effect(&state)->observer.acceleration_q32, expected.acceleration_q32);
    EXPECT_EQ(deferred_in_effect(&state)->observer.load_shift, expected.load_shift);
}

} // namespace
