// Supervision step: the record of a fault, and what a change of the state leaves of a run and of its load. [SR-44]
#include <algorithm>
#include <cstdint>

#include <gtest/gtest.h>

extern "C" {
#include "interrupts/deferred_exchange.h"
#include "interrupts/supervise.h"
}

#include "support/configured.h"
#include "support/whole_sample.h"

namespace {

constexpr uint64_t OVER_VOLTAGE = FAULT_BIT(FAULT_OVER_VOLTAGE);
constexpr int32_t STANDSTILL_Q22 = 1 << 21; // 0.5 rad/s
constexpr unsigned TRIGGER_STAGE = 3;

class Supervise : public testing::Test {
  protected:
    Supervise() { reset(DRIVE_STATE_RUN); }

    void reset(drive_state_t begin, drive_controller_t controller = DRIVE_CONTROLLER_PAPER) {
        parameters = configured(controller, 40000, 17);
        parameters.bandwidth.schedule.adaptive = true;
        parameters.bandwidth.schedule.trigger_stage_count = TRIGGER_STAGE;
        control_reset(&parameters, &state);
        state.state_machine.state = begin;
        state.state_machine.rearmed = true;
        state.observer.speed_q22 = 1 << 24;
        state.observer.load_torque_q24 = 5 << 24;
        state.bandwidth.stage = OBSERVER_BANDWIDTH_STEADY_STAGE;
    }

    bool tick(command_request_t request, uint64_t fault_mask = 0) {
        command.request = request;
        return supervise(&parameters, &state, &sample, &command, fault_mask);
    }

    uint32_t generation() const { return state.deferred_request.generation; }

    control_parameters_t parameters;
    control_state_t state;
    whole_sample_t sample;
    command_t command{};
};

// [SR-40]
TEST_F(Supervise, every_value_of_the_record_is_that_of_the_sample_which_failed) {
    sample.time_us = 0xFEDCBA98u;
    state.torque_reference_q24 = -123456789;
    state.observer.speed_q22 = 1; // with this sample, which may be the cause
    control_measurement_t &measured = state.measurement;
    measured.predicted_speed_q22 = -98765432;
    measured.encoder_angle = 0x11112222u;
    measured.angle = 0x89ABCDEFu;
    measured.current_max_q9 = 65535;
    measured.dc_link_voltage_q6 = 54321;
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        measured.current_q9[phase] = int32_t(65535 - 7 * phase);
    }
    EXPECT_FALSE(tick(COMMAND_RUN, OVER_VOLTAGE | FAULT_BIT(FAULT_ENCODER)));
    const fault_record_t &record = state.state_machine.record;
    EXPECT_EQ(record.fault, state_machine_first_fault(OVER_VOLTAGE | FAULT_BIT(FAULT_ENCODER)));
    EXPECT_EQ(record.fault_mask, OVER_VOLTAGE | FAULT_BIT(FAULT_ENCODER));
    EXPECT_EQ(record.state, DRIVE_STATE_RUN);
    EXPECT_EQ(record.time_us, 0xFEDCBA98u);
    EXPECT_EQ(record.speed_q22, -98765432) << "the estimate without the sample";
    EXPECT_EQ(record.torque_reference_q24, -123456789) << "of the previous period";
    EXPECT_EQ(record.current_max_q9, 65535u);
    EXPECT_EQ(record.dc_link_voltage_q6, 54321u);
    EXPECT_EQ(record.angle, 0x89ABu);
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        EXPECT_EQ(record.current_q9[phase], 65535 - 7 * phase) << phase;
    }
}

// [SR-40]
TEST_F(Supervise, the_record_of_a_fault_is_not_overwritten_by_later_samples) {
    sample.time_us = 10;
    tick(COMMAND_RUN, OVER_VOLTAGE);
    sample.time_us = 20;
    state.measurement.angle = UINT32_MAX;
    tick(COMMAND_RUN, FAULT_BIT(FAULT_ENCODER));
    EXPECT_EQ(state.state_machine.record.time_us, 10u);
    EXPECT_EQ(state.state_machine.record.angle, 0u);
}

TEST_F(Supervise, a_run_that_ends_leaves_no_torque_no_duty_no_slip_and_no_regulated_phase) {
    for (const uint64_t fault_mask : {uint64_t(0), OVER_VOLTAGE}) {
        reset(DRIVE_STATE_RUN);
        state.torque_reference_q24 = 7 << 24;
        state.slip.periods = 9;
        state.duty.regulated = 1;
        std::fill_n(state.duty_q15, HAL_PHASES_MAX, 32768);
        EXPECT_FALSE(tick(COMMAND_OFF, fault_mask));
        EXPECT_EQ(state.torque_reference_q24, 0);
        EXPECT_EQ(state.slip.periods, 0u);
        EXPECT_EQ(state.duty.regulated, COMMUTATION_NONE);
        for (const int32_t duty_q15 : state.duty_q15) {
            EXPECT_EQ(duty_q15, -32768);
        }
        EXPECT_EQ(state.observer.load_torque_q24, 5 << 24) << "the load is still there";
    }
}

TEST_F(Supervise, results_of_a_run_end_with_it_and_after_a_fault_once_in_the_first_period_without_a_failed_check) {
    const uint32_t before = generation();
    tick(COMMAND_OFF);
    EXPECT_EQ(generation(), before + 1);
    tick(COMMAND_OFF);
    EXPECT_EQ(generation(), before + 1);

    for (const unsigned failing : {1u, 2u, 5u}) {
        reset(DRIVE_STATE_RUN);
        const uint32_t in_run = generation();
        for (unsigned k = 0; k < failing; k++) {
            tick(COMMAND_OFF, OVER_VOLTAGE);
            EXPECT_EQ(generation(), in_run);
        }
        for (unsigned k = 0; k < 100; k++) {
            tick(COMMAND_OFF);
            EXPECT_EQ(generation(), in_run + 1) << k;
        }
    }
}

TEST_F(Supervise, a_fault_that_is_cleared_forgets_the_load_and_keeps_angle_and_speed) {
    tick(COMMAND_RUN, OVER_VOLTAGE);
    for (uint32_t k = 0; k <= STATE_MACHINE_CAUSE_GONE_MS * parameters.initialise_ticks; k++) {
        tick(COMMAND_OFF);
    }
    state.observer.angle_q64 = 0x123456789ABCDEF0u;
    state.bandwidth.ticks = 1000;
    ASSERT_EQ(state.observer.load_torque_q24, 5 << 24);
    const uint32_t before = generation();
    EXPECT_FALSE(tick(COMMAND_CLEAR_FAULT));
    ASSERT_EQ(state.state_machine.state, DRIVE_STATE_READY);
    EXPECT_EQ(state.observer.load_torque_q24, 0);
    EXPECT_EQ(state.bandwidth.stage, 0u) << "maximum bandwidth";
    EXPECT_EQ(state.bandwidth.ticks, 0u);
    EXPECT_EQ(generation(), before + DEFERRED_OBSERVER_STEP);
    EXPECT_EQ(state.observer.angle_q64, 0x123456789ABCDEF0u);
    EXPECT_EQ(state.observer.speed_q22, 1 << 24);
}

TEST_F(Supervise, no_other_change_of_the_state_forgets_the_load) {
    reset(DRIVE_STATE_INITIALISE);
    state.state_machine.fault_free_ticks = parameters.initialise_ticks - 1;
    const uint32_t before = generation();
    tick(COMMAND_OFF);
    ASSERT_EQ(state.state_machine.state, DRIVE_STATE_READY);
    EXPECT_EQ(state.observer.load_torque_q24, 5 << 24);
    tick(COMMAND_OFF, OVER_VOLTAGE);
    ASSERT_EQ(state.state_machine.state, DRIVE_STATE_FAULT);
    EXPECT_EQ(state.observer.load_torque_q24, 5 << 24);
    EXPECT_EQ(state.bandwidth.stage, OBSERVER_BANDWIDTH_STEADY_STAGE);
    EXPECT_EQ(generation(), before);
}

TEST_F(Supervise, an_observer_as_wide_as_after_its_reset_takes_nothing_for_a_load_until_a_run) {
    const struct {
        drive_state_t state;
        unsigned stage;
        bool adaptive, forgets;
    } cases[] = {
        {DRIVE_STATE_INITIALISE, 0, true, true},
        {DRIVE_STATE_READY, 0, true, true},
        {DRIVE_STATE_READY, TRIGGER_STAGE - 1, true, true},
        {DRIVE_STATE_READY, TRIGGER_STAGE, true, false},
        {DRIVE_STATE_READY, OBSERVER_BANDWIDTH_STEADY_STAGE, true, false},
        {DRIVE_STATE_READY, 0, false, false},
        {DRIVE_STATE_FAULT, 0, true, false},
        {DRIVE_STATE_RUN, 0, true, false},
    };
    for (const auto &each : cases) {
        reset(each.state);
        parameters.bandwidth.schedule.adaptive = each.adaptive;
        state.bandwidth.stage = each.stage;
        tick(each.state == DRIVE_STATE_RUN ? COMMAND_RUN : COMMAND_OFF);
        EXPECT_EQ(state.observer.load_torque_q24, each.forgets ? 0 : 5 << 24) << each.state << " stage " << each.stage;
    }
}

// [SR-06]
TEST_F(Supervise, a_stop_ends_below_half_a_radian_per_second_in_either_direction) {
    for (const int32_t direction : {-1, 1}) {
        reset(DRIVE_STATE_RUN);
        state.observer.speed_q22 = direction * STANDSTILL_Q22;
        EXPECT_TRUE(tick(COMMAND_STOP)) << direction;
        state.observer.speed_q22 = direction * (STANDSTILL_Q22 - 1);
        EXPECT_TRUE(tick(COMMAND_RUN)) << "a run at standstill goes on";
        EXPECT_FALSE(tick(COMMAND_STOP)) << direction;
        EXPECT_EQ(state.state_machine.state, DRIVE_STATE_READY);
    }
}

} // namespace
