// PWM-DITC: regulated phase, commutation, and start from every rotor position.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/pwm_ditc.h"
#include "fixed/formats.h"
}

#include "support/commutation_roles.h"
#include "support/fixed_point.h"
#include "support/phase_map_results.h"

namespace {

using namespace fixed_point;
constexpr int32_t LIMIT_Q9 = 52 << 9;

const uint32_t CROSSOVER = electrical_angle(210.0);
const commutation_angles_t ANGLES = {
    .turn_on = electrical_angle(180.0), .turn_off = electrical_angle(300.0), .outgoing_off = electrical_angle(348.0)};

// Roles in the 6/4 machine with phase 0 at an electrical angle.
roles_t commutation_of(double phase_0_deg) {
    return roles_at(ANGLES, 3, 4, electrical_angle(phase_0_deg) / 4u);
}

int32_t map_torque_q24(uint32_t phase_angle, int32_t current_q9) {
    return phase_map_results::torque_q24(machine_tables, phase_angle, current_q9);
}

int32_t map_current_q9(uint32_t phase_angle, int32_t torque_q24) {
    int32_t below = 0, above = PHASE_MAP_CURRENT_MAX_Q9;
    while (above - below > 1) {
        const int32_t middle = (below + above) / 2;
        (map_torque_q24(phase_angle, middle) <= torque_q24 ? below : above) = middle;
    }
    return below;
}

pwm_ditc_parameters_t parameters_of(bp_pid_mode_t mode) {
    pwm_ditc_parameters_t parameters{};
    parameters.pid.mode = mode;
    parameters.pid.seed = 1;
    parameters.pid.error_scale_inverse_q24 = 1 << 23;
    parameters.pid.scale_q28[0] = 32768 << 13;
    parameters.pid.scale_q28[1] = 7864 << 13;
    parameters.pid.scale_q28[2] = 13107 << 13;
    parameters.pid.network = {.learning_rate_q15 = 1638, .momentum_q32 = 1638 << 17};
    parameters.current_setpoints = pwm_ditc_setpoints(&machine_tables, CROSSOVER);
    parameters.incoming_gain_q24 = 58544 << 4; // 40 kHz, 358 A/ms
    parameters.overshoot_margin_q32 = 1 << 28;
    parameters.depleted_torque_q24 = 1 << 20;
    parameters.band_outer_q24 = 2 << 24;
    parameters.current_limit_q9 = LIMIT_Q9;
    parameters.current_ceiling_q9 = 74 << 9;
    parameters.ceiling_gain_q24 = (1 << 24) / 9; // 9 A in a period
    parameters.torque_shift = machine_tables.torque_format.result_shift;
    return parameters;
}

class PwmDitc : public testing::Test {
  protected:
    PwmDitc() { pwm_ditc_reset(&parameters, &ditc); }

    // One sample with the torques of the phase map for the currents.
    void step(const roles_t &commutation, double reference_Nm) {
        pwm_ditc_sample_t sample{
            .current_q9 = current_q9, .torque = torque, .reference_q24 = to_fixed(reference_Nm, Q24), .error_q24 = 0};
        sample.error_q24 = sample.reference_q24;
        for (unsigned phase = 0; phase < 3; phase++) {
            torque[phase] = phase_map_torque(&machine_tables, commutation.angle[phase], current_q9[phase]);
            sample.error_q24 -= phase_map_scale(&machine_tables.torque_format, torque[phase]);
        }
        error_q24 = sample.error_q24;
        pwm_ditc_step(&parameters, &ditc, &commutation, &sample, duty_q15);
    }

    pwm_ditc_parameters_t parameters = parameters_of(BP_PID_FIXED);
    pwm_ditc_t ditc{};
    int32_t current_q9[HAL_PHASES_MAX] = {0, 0, 0, 0};
    double torque_Nm(unsigned phase) const {
        return std::ldexp(torque[phase], machine_tables.torque_format.result_shift) / Q24;
    }

    int32_t torque[HAL_PHASES_MAX] = {0, 0, 0, 0}; // unit of the tables
    int32_t error_q24 = 0;
    int32_t duty_q15[HAL_PHASES_MAX] = {0, 0, 0, 0};
};

TEST_F(PwmDitc, from_standstill_every_rotor_position_drives_phases_that_can_carry_the_torque) {
    double weakest = 1e9;
    for (int tenth_deg = 0; tenth_deg < 3600; tenth_deg++) {
        const roles_t commutation = roles_at(ANGLES, 3, 4, electrical_angle(tenth_deg / 10.0));
        pwm_ditc_reset(&parameters, &ditc);
        for (int k = 0; k < 20; k++) {
            step(commutation, 8.0);
        }
        double torque_Nm = 0.0;
        for (unsigned phase = 0; phase < 3; phase++) {
            if (duty_q15[phase] > 0) {
                torque_Nm += map_torque_q24(commutation.angle[phase], LIMIT_Q9) / Q24;
            }
        }
        weakest = std::min(weakest, torque_Nm);
    }
    EXPECT_GT(weakest, 19.1) << "the rated torque, at the current limit";
    EXPECT_LT(weakest, 25.0);
}

TEST_F(PwmDitc, a_single_phase_gets_the_duty_of_the_pid_and_the_others_are_off) {
    const roles_t commutation = commutation_of(230.0);
    ASSERT_EQ(commutation.active, 0u);
    ASSERT_EQ(commutation.outgoing, unsigned(COMMUTATION_NONE));
    bp_pid_t pid;
    bp_pid_reset(&parameters.pid, &pid);
    for (int k = 0; k < 50; k++) {
        current_q9[0] = (k % 30) << 9;
        step(commutation, 5.0);
        EXPECT_EQ(duty_q15[0], bp_pid_step(&parameters.pid, &pid, error_q24));
        EXPECT_EQ(duty_q15[1], -ONE_Q15);
        EXPECT_EQ(duty_q15[2], -ONE_Q15);
    }
}

TEST_F(PwmDitc, in_a_commutation_gap_every_phase_is_off) {
    roles_t commutation = commutation_of(230.0);
    commutation.active = commutation.outgoing = COMMUTATION_NONE;
    step(commutation, 5.0);
    for (unsigned phase = 0; phase < 3; phase++) {
        EXPECT_EQ(duty_q15[phase], -ONE_Q15);
    }
    EXPECT_EQ(ditc.regulated, unsigned(COMMUTATION_NONE));
}

TEST_F(PwmDitc, from_standstill_a_phase_past_its_window_is_regulated_and_the_next_one_supports_it) {
    const roles_t commutation = commutation_of(320.0);
    ASSERT_EQ(commutation.outgoing, 0u);
    ASSERT_EQ(commutation.active, 1u);
    step(commutation, 8.0);
    EXPECT_EQ(ditc.regulated, 0u);
    EXPECT_GT(duty_q15[0], 0);
    EXPECT_EQ(duty_q15[1], ONE_Q15) << "a shortfall beyond the outer band: full voltage up to the current limit";
    EXPECT_EQ(duty_q15[2], -ONE_Q15);
}

TEST_F(PwmDitc, the_incoming_phase_is_driven_to_the_current_that_will_carry_the_reference) {
    // Phase 0 is outgoing with about the reference torque: no shortfall beyond the band.
    const roles_t commutation = commutation_of(305.0);
    ASSERT_EQ(commutation.active, 1u);
    for (double reference = 0.5; reference < 14.0; reference += 0.25) {
        pwm_ditc_reset(&parameters, &ditc);
        current_q9[0] = map_current_q9(commutation.angle[0], to_fixed(reference, Q24));
        const double carrying_A =
            pwm_ditc_setpoint_q9(&parameters.current_setpoints, to_fixed(reference * 17 / 16, Q24)) / Q9;
        const double target_A = std::min(carrying_A, LIMIT_Q9 / Q9);
        for (int current_A = 0; current_A < 60; current_A += 3) {
            current_q9[1] = current_A << 9;
            step(commutation, reference);
            ASSERT_EQ(ditc.regulated, 0u);
            const double exact = std::clamp((target_A - current_A) * parameters.incoming_gain_q24 / Q24, -1.0, 1.0);
            ASSERT_NEAR(duty_q15[1] / Q15, exact, 1.0 / Q15) << reference << " " << current_A;
        }
    }
}

TEST_F(PwmDitc, the_pid_switches_over_when_the_outgoing_phase_is_depleted_and_starts_from_the_incoming_duty) {
    const roles_t commutation = commutation_of(320.0);
    current_q9[0] = 20 << 9;
    current_q9[1] = 10 << 9;
    step(commutation, 4.0);
    ASSERT_EQ(ditc.regulated, 0u);
    // Outgoing torque left: no switch-over, although the error is negative.
    step(commutation, 1.0);
    ASSERT_LT(error_q24, 0);
    EXPECT_EQ(ditc.regulated, 0u);
    // No torque left, but a shortfall: no switch-over, both phases build up torque.
    current_q9[0] = 0;
    step(commutation, 8.0);
    ASSERT_GT(error_q24, 0);
    EXPECT_EQ(ditc.regulated, 0u);
    // No torque left and no shortfall.
    current_q9[1] = 12 << 9;
    const double reference = torque_Nm(1);
    step(commutation, 0.5 * reference);
    ASSERT_LE(error_q24, 0);
    EXPECT_EQ(ditc.regulated, 1u);
    EXPECT_EQ(duty_q15[0], -ONE_Q15);
    // It does not switch back.
    current_q9[0] = 20 << 9;
    step(commutation, 8.0);
    EXPECT_EQ(ditc.regulated, 1u);
}

TEST(PwmDitcSetpoints, of_a_negative_torque_is_that_of_none) {
    const pwm_ditc_setpoints_t setpoints = pwm_ditc_setpoints(&machine_tables, electrical_angle(210.0));
    for (const int32_t torque_q24 : {-1, -(1 << 24), INT32_MIN}) {
        EXPECT_EQ(pwm_ditc_setpoint_q9(&setpoints, torque_q24), 0) << torque_q24;
    }
    EXPECT_GT(pwm_ditc_setpoint_q9(&setpoints, 1 << 24), 0);
}

TEST(PwmDitcSetpoints, are_the_currents_of_the_phase_map_within_2_percent_and_small_ones_within_a_third_of_an_ampere) {
    for (const double angle_deg : {180.0, 210.0, 255.0, 300.0}) {
        const pwm_ditc_setpoints_t setpoints = pwm_ditc_setpoints(&machine_tables, electrical_angle(angle_deg));
        double worst_part = 0.0, worst_A = 0.0;
        int32_t last_q9 = 0;
        for (int64_t wide_q24 = 0; wide_q24 <= INT32_MAX; wide_q24 += 1 + wide_q24 / 64) {
            const auto torque_q24 = int32_t(wide_q24);
            const double exact_A = map_current_q9(electrical_angle(angle_deg), torque_q24) / Q9;
            const int32_t setpoint_q9 = pwm_ditc_setpoint_q9(&setpoints, torque_q24);
            const double off_A = std::fabs(setpoint_q9 / Q9 - exact_A);
            ASSERT_GE(setpoint_q9, last_q9) << torque_q24;
            last_q9 = setpoint_q9;
            if (exact_A > 5.0 && exact_A < 75.0) {
                worst_part = std::max(worst_part, off_A / exact_A);
            } else if (exact_A <= 5.0) {
                worst_A = std::max(worst_A, off_A);
            }
        }
        EXPECT_LT(worst_part, 0.02) << angle_deg;
        EXPECT_LT(worst_A, 0.33) << angle_deg;
        if (angle_deg > 180.0) {
            EXPECT_GT(worst_part, 0.001) << angle_deg;
            EXPECT_GT(worst_A, 0.1) << angle_deg;
        }
        EXPECT_EQ(pwm_ditc_setpoint_q9(&setpoints, 0), 0);
        EXPECT_GT(pwm_ditc_setpoint_q9(&setpoints, INT32_MAX), LIMIT_Q9) << "more than the machine has";
    }
}

TEST_F(PwmDitc, the_current_setpoint_of_the_incoming_phase_includes_the_overshoot_margin) {
    const roles_t commutation = commutation_of(305.0);
    const double reference = 8.0;
    parameters.incoming_gain_q24 = 1 << 20; // no saturation
    current_q9[0] = map_current_q9(commutation.angle[0], to_fixed(reference, Q24));
    for (const double margin : {0.0, 1.0 / 400.0, 1.0 / 16.0, 1.0 / 8.0}) {
        parameters.overshoot_margin_q32 = int32_t(margin * Q32);
        pwm_ditc_reset(&parameters, &ditc);
        const double setpoint_A =
            pwm_ditc_setpoint_q9(&parameters.current_setpoints, to_fixed(reference * (1.0 + margin), Q24)) / Q9;
        current_q9[1] = int32_t(setpoint_A) << 9;
        step(commutation, reference);
        ASSERT_NEAR(duty_q15[1] / Q15, (setpoint_A - std::floor(setpoint_A)) / 16.0, 2.0 / Q15) << margin;
    }
}

TEST_F(PwmDitc, an_outgoing_phase_is_depleted_below_the_depleted_torque_an_eighth_of_the_reference_or_a_sixteenth_Nm) {
    const roles_t commutation = commutation_of(320.0);
    unsigned switched = 0, kept = 0;
    for (const double depleted_Nm : {0.0, 0.03, 0.0625, 0.5, 1.5}) {
        parameters.depleted_torque_q24 = to_fixed(depleted_Nm, Q24);
        for (double reference = 0.0; reference < 16.0; reference += 0.5) {
            for (int current_eighth_A = 0; current_eighth_A < 80; current_eighth_A++) {
                pwm_ditc_reset(&parameters, &ditc);
                current_q9[0] = current_eighth_A << 6;
                current_q9[1] = 52 << 9;
                step(commutation, reference);
                const double limit = std::max(0.0625, std::min(reference / 8.0, depleted_Nm));
                const bool depleted = torque_Nm(0) < limit && error_q24 <= 0;
                ASSERT_EQ(ditc.regulated, depleted ? 1u : 0u)
                    << depleted_Nm << " " << reference << " " << current_eighth_A;
                switched += depleted;
                kept += !depleted && error_q24 <= 0;
            }
        }
    }
    EXPECT_GT(switched, 500u);
    EXPECT_GT(kept, 500u);
}

TEST_F(PwmDitc,
       the_pid_switches_over_when_the_outgoing_phase_is_no_longer_available_and_starts_from_the_incoming_duty) {
    current_q9[0] = 20 << 9;
    current_q9[1] = 8 << 9;
    for (int k = 0; k < 30; k++) {
        step(commutation_of(340.0), 3.0);
    }
    ASSERT_EQ(ditc.regulated, 0u);
    // The same sample before and past 348 degrees. Gains of 0, so that the increment of the PID is known.
    std::fill_n(parameters.pid.scale_q28, BP_OUTPUTS, 0);
    step(commutation_of(347.99), 3.0);
    const int32_t incoming_q15 = duty_q15[1];
    ASSERT_NE(incoming_q15, duty_q15[0]);
    step(commutation_of(348.01), 3.0);
    EXPECT_EQ(ditc.regulated, 1u);
    EXPECT_NEAR(duty_q15[1], incoming_q15, 100);
    EXPECT_EQ(duty_q15[0], -ONE_Q15);
}

TEST_F(PwmDitc, a_phase_above_the_current_limit_is_never_driven) {
    std::mt19937 random(1);
    for (int i = 0; i < 200000; i++) {
        const roles_t commutation = roles_at(ANGLES, 3, 4, uint32_t(random()));
        for (int32_t &current : current_q9) {
            current = int32_t(random() % 40951);
        }
        step(commutation, double(random() % 4000) / 100.0);
        for (unsigned phase = 0; phase < 3; phase++) {
            ASSERT_LE(std::abs(duty_q15[phase]), ONE_Q15);
            ASSERT_TRUE(duty_q15[phase] <= 0 || current_q9[phase] <= LIMIT_Q9);
            if (phase != ditc.regulated && phase != commutation.active) {
                ASSERT_EQ(duty_q15[phase], -ONE_Q15);
            }
        }
        ASSERT_TRUE(ditc.regulated == commutation.active || ditc.regulated == commutation.outgoing);
    }
}

TEST_F(PwmDitc, a_phase_that_lacks_torque_stays_below_the_ceiling_and_close_to_it_however_fast_its_current_rises) {
    const roles_t commutation = commutation_of(230.0);
    ASSERT_EQ(commutation.active, 0u);
    const double ceiling_A = 70.0;
    for (const double rise_A : {3.0, 9.0, 18.0, 30.0}) {
        parameters.current_limit_q9 = to_fixed(ceiling_A, Q9);
        parameters.current_ceiling_q9 = to_fixed(ceiling_A, Q9);
        parameters.ceiling_gain_q24 = to_fixed(1.0 / (1.1 * rise_A), Q24);
        pwm_ditc_reset(&parameters, &ditc);
        std::fill(std::begin(duty_q15), std::end(duty_q15), -ONE_Q15);
        // The duty of a sample acts from the next one on; a hundredth of the voltage is lost.
        double current_A = 0.0, most_A = 0.0;
        for (int k = 0; k < 200; k++) {
            const double acting = duty_q15[0] / double(ONE_Q15);
            current_q9[0] = to_fixed(current_A, Q9);
            step(commutation, 100.0);
            current_A = std::max(current_A + rise_A * (acting - 0.01), 0.0);
            most_A = std::max(most_A, current_A);
        }
        EXPECT_LT(most_A, ceiling_A) << rise_A;
        EXPECT_GT(most_A, ceiling_A - 0.2 * rise_A - 0.1) << rise_A;
        EXPECT_GT(current_A, ceiling_A - 0.2 * rise_A - 0.1) << rise_A << ", and stays there";
    }
}

TEST_F(PwmDitc, nothing_overflows_at_the_ends_of_all_ranges) {
    std::mt19937 random(2);
    const int32_t ends[] = {INT32_MIN, INT32_MAX, 0, 1, -1};
    for (const int32_t gain : {0, 1, INT32_MAX}) {
        for (const bp_pid_mode_t mode : {BP_PID_FIXED, BP_PID_FROZEN, BP_PID_LEARNING}) {
            parameters = parameters_of(mode);
            parameters.incoming_gain_q24 = gain;
            parameters.overshoot_margin_q32 = gain;
            parameters.depleted_torque_q24 = gain;
            parameters.ceiling_gain_q24 = gain;
            pwm_ditc_reset(&parameters, &ditc);
            for (int k = 0; k < 3000; k++) {
                const roles_t commutation = roles_at(ANGLES, 3, 4, uint32_t(random()));
                for (unsigned phase = 0; phase < 3; phase++) {
                    current_q9[phase] = int32_t(random() % 40951);
                    torque[phase] = ends[random() % 5];
                }
                const pwm_ditc_sample_t sample = {.current_q9 = current_q9,
                                                  .torque = torque,
                                                  .reference_q24 = int32_t(random() >> 1),
                                                  .error_q24 = ends[random() % 5]};
                pwm_ditc_step(&parameters, &ditc, &commutation, &sample, duty_q15);
                for (unsigned phase = 0; phase < 3; phase++) {
                    ASSERT_LE(std::abs(duty_q15[phase]), ONE_Q15);
                }
            }
        }
    }
}

} // namespace
