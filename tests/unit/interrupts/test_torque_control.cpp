// Torque control step: which law acts, and when: at the first torque, on a rotor that turns backwards, ahead of it.
#include <algorithm>
#include <cstdint>

#include <gtest/gtest.h>

extern "C" {
#include "interrupts/torque_control.h"
}

#include "support/configured.h"

namespace {

constexpr int32_t BACKWARDS_Q22 = 8 << 22; // 8 rad/s
constexpr drive_controller_t HYSTERESIS = DRIVE_CONTROLLER_TRADITIONAL, DUTY = DRIVE_CONTROLLER_PAPER,
                             PREDICTIVE = DRIVE_CONTROLLER_SALIENT;

class TorqueControl : public testing::Test {
  protected:
    TorqueControl() { reset(DUTY); }

    void reset(drive_controller_t controller) {
        parameters = configured(controller, 40000, 17);
        control_reset(&parameters, &state);
        results = deferred_results_t{};
        results.limit = torque_control_limit(&parameters, 0);
        state.torque_reference_q24 = 5 << 24;
        state.measurement.dc_link_voltage_q6 = 240 << 6;
    }

    void step() { torque_control(&parameters, &state, &results); }

    control_parameters_t parameters;
    control_state_t state;
    deferred_results_t results;
};

TEST_F(TorqueControl, a_reset_leaves_no_duty_and_nothing_of_the_law_in_effect) {
    for (const drive_controller_t controller : {HYSTERESIS, DUTY, PREDICTIVE}) {
        reset(controller);
        std::fill_n(state.duty_q15, HAL_PHASES_MAX, 123);
        state.duty.regulated = 2;
        state.duty.error_q24 = state.duty.released_q15 = state.duty.incoming_torque = 9;
        state.duty.pid.duty_q23 = 99;
        state.predictive.torque_shortfall_q24 = 77;
        torque_control_reset(&parameters, &state);
        for (const int32_t duty_q15 : state.duty_q15) {
            EXPECT_EQ(duty_q15, -32768);
        }
        if (controller == DUTY) {
            EXPECT_EQ(state.duty.regulated, COMMUTATION_NONE);
            EXPECT_EQ(state.duty.error_q24, 0);
            EXPECT_EQ(state.duty.released_q15, 0);
            EXPECT_EQ(state.duty.incoming_torque, 0);
            EXPECT_EQ(state.duty.pid.duty_q23, 0);
        }
        if (controller == PREDICTIVE) {
            EXPECT_EQ(state.predictive.torque_shortfall_q24, 0);
        }
    }
}

TEST_F(TorqueControl, currents_are_limited_as_generating_ones_beyond_8_rad_s_backwards) {
    const ditc_hysteresis_limit_t forward = ditc_hysteresis_limit(&parameters.hysteresis, 0);
    for (const int32_t speed_q22 : {INT32_MAX, 0, -1, -BACKWARDS_Q22 / 2, -BACKWARDS_Q22}) {
        const ditc_hysteresis_limit_t limit = torque_control_limit(&parameters, speed_q22);
        EXPECT_EQ(limit.current_q9, forward.current_q9) << speed_q22;
        EXPECT_EQ(limit.state, forward.state) << speed_q22;
    }
    for (const int32_t speed_q22 : {-BACKWARDS_Q22 - 1, -20 * BACKWARDS_Q22}) {
        const ditc_hysteresis_limit_t limit = torque_control_limit(&parameters, speed_q22);
        const ditc_hysteresis_limit_t generating = ditc_hysteresis_limit(&parameters.hysteresis, -speed_q22);
        EXPECT_EQ(limit.current_q9, generating.current_q9) << speed_q22;
        EXPECT_EQ(limit.state, generating.state) << speed_q22;
        EXPECT_LT(limit.current_q9, forward.current_q9) << speed_q22;
    }
}

TEST_F(TorqueControl, no_phase_is_regulated_before_the_first_torque_and_one_is_from_its_least_on) {
    for (const int32_t reference_q24 : {INT32_MIN, -1, 0}) {
        reset(DUTY);
        state.torque_reference_q24 = reference_q24;
        std::fill_n(state.duty_q15, HAL_PHASES_MAX, 123);
        step();
        EXPECT_EQ(state.duty.regulated, COMMUTATION_NONE) << reference_q24;
        for (const int32_t duty_q15 : state.duty_q15) {
            EXPECT_EQ(duty_q15, -32768) << reference_q24;
        }
    }
    for (const int32_t reference_q24 : {1, INT32_MAX}) {
        reset(DUTY);
        state.torque_reference_q24 = reference_q24;
        step();
        EXPECT_NE(state.duty.regulated, COMMUTATION_NONE) << reference_q24;
        state.torque_reference_q24 = 0;
        step();
        EXPECT_NE(state.duty.regulated, COMMUTATION_NONE) << "a torque of 0 later on is regulated";
    }
}

TEST_F(TorqueControl, the_duty_of_the_bp_pid_is_that_of_a_rotor_up_to_8_rad_s_backwards) {
    step();
    ASSERT_NE(state.duty.regulated, COMMUTATION_NONE);
    state.observer.speed_q22 = -BACKWARDS_Q22;
    step();
    EXPECT_NE(state.duty.regulated, COMMUTATION_NONE);
    state.observer.speed_q22 = -BACKWARDS_Q22 - 1;
    step();
    EXPECT_EQ(state.duty.regulated, COMMUTATION_NONE) << "hysteresis control, whose duties are states";
    for (const int32_t duty_q15 : state.duty_q15) {
        EXPECT_TRUE(duty_q15 == -32768 || duty_q15 == 0 || duty_q15 == 32768) << duty_q15;
    }
}

TEST_F(TorqueControl, phases_change_roles_where_the_rotor_will_be) {
    const uint32_t stroke = parameters.commutation.stroke;
    unsigned earlier = 0;
    for (unsigned k = 0; k < 96; k++) {
        reset(DUTY);
        results.duty.lead = stroke / 3;
        commutation_t now = {.electrical = k * (stroke / 32), .active = 0, .outgoing = 0};
        state.measurement.commutation.electrical = now.electrical;
        commutation_t ahead = {.electrical = now.electrical + stroke / 3, .active = 0, .outgoing = 0};
        commutation_find(&parameters.commutation, &now);
        commutation_find(&parameters.commutation, &ahead);
        step();
        if (ahead.active == COMMUTATION_NONE) {
            EXPECT_EQ(state.duty.regulated, COMMUTATION_NONE) << k;
        } else { /* a phase that just entered has no torque yet */
            const unsigned expected = ahead.outgoing != COMMUTATION_NONE ? ahead.outgoing : ahead.active;
            EXPECT_TRUE(state.duty.regulated == expected || state.duty.regulated == ahead.active) << k;
            const auto in_use = [&](unsigned phase) { return phase == ahead.active || phase == ahead.outgoing; };
            for (unsigned phase = 0; phase < machine_tables.phases; phase++) {
                EXPECT_TRUE(in_use(phase) || state.duty_q15[phase] == -32768) << k << " phase " << phase;
            }
            EXPECT_GT(state.duty_q15[ahead.active], -32768) << k;
        }
        earlier += now.active != ahead.active;
    }
    EXPECT_GT(earlier, 16u) << "the lead matters";
}

TEST_F(TorqueControl, the_voltage_is_saturated_by_a_full_duty_or_with_predictive_control_by_missing_torque) {
    for (const drive_controller_t controller : {HYSTERESIS, DUTY, PREDICTIVE}) {
        reset(controller);
        EXPECT_FALSE(torque_control_voltage_saturated(&parameters, &state));
        std::fill(state.duty_q15 + machine_tables.phases, state.duty_q15 + HAL_PHASES_MAX, 32768);
        EXPECT_FALSE(torque_control_voltage_saturated(&parameters, &state)) << "duties of no phase";
        for (unsigned phase = 0; phase < machine_tables.phases; phase++) {
            std::fill_n(state.duty_q15, HAL_PHASES_MAX, 32767);
            EXPECT_FALSE(torque_control_voltage_saturated(&parameters, &state));
            state.duty_q15[phase] = 32768;
            EXPECT_EQ(torque_control_voltage_saturated(&parameters, &state), controller != PREDICTIVE) << phase;
        }
        std::fill_n(state.duty_q15, HAL_PHASES_MAX, 0);
        for (const int32_t shortfall_q24 : {-1, 1}) {
            state.predictive.torque_shortfall_q24 = shortfall_q24;
            EXPECT_EQ(torque_control_voltage_saturated(&parameters, &state), controller == PREDICTIVE);
        }
    }
}

TEST_F(TorqueControl, the_switches_of_a_lost_phase_stay_open_with_every_law) {
    for (const drive_controller_t controller : {HYSTERESIS, DUTY}) {
        for (unsigned lost = 0; lost < machine_tables.phases; lost++) {
            for (unsigned k = 0; k < 48; k++) {
                reset(controller);
                state.lost_phase = lost + 1;
                state.measurement.commutation.electrical = k << 27;
                step();
                EXPECT_EQ(state.duty_q15[lost], -32768) << lost;
            }
        }
    }
}

} // namespace
