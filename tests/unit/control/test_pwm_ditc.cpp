// PWM-DITC: regulated phase, commutation, and start from every rotor position.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/bp_tuner.h"
#include "control/pwm_ditc.h"
#include "fixed/formats.h"
}

#include "support/commutation_roles.h"
#include "support/fixed_point.h"
#include "support/phase_map_results.h"
#include "support/wide_integer.h"

namespace {

using namespace fixed_point;
constexpr int32_t LIMIT_Q9 = 52 << 9;

const uint32_t CROSSOVER = electrical_angle(210.0), MIDDLE = electrical_angle(240.0);
const int32_t VOLTAGE_STEP_Q29 = to_fixed(240.0 / 40e3, Q29);
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
    parameters.band_outer_q24 = 2 << 24;
    parameters.current_limit_q9 = LIMIT_Q9;
    parameters.current_ceiling_q9 = 74 << 9;
    parameters.ceiling_gain_q24 = (1 << 24) / 9; // 9 A in a period
    pwm_ditc_set_reference_point(&parameters, &machine_tables, MIDDLE, VOLTAGE_STEP_Q29);
    return parameters;
}

class PwmDitc : public testing::Test {
  protected:
    PwmDitc() { reset(); }

    void reset() {
        pwm_ditc_reset(&ditc);
        bp_tuner_reset(&parameters.pid, &tuner);
    }

    // One sample with the torques of the phase map for the currents.
    void step(const roles_t &commutation, double reference_Nm) {
        const int32_t reference_q24 = to_fixed(reference_Nm, Q24);
        plan.setpoint_q9 =
            std::min(pwm_ditc_setpoint_q9(&parameters.current_setpoints, reference_q24), parameters.current_limit_q9);
        pwm_ditc_sample_t sample{.current_q9 = current_q9,
                                 .torque = torque,
                                 .error_q24 = reference_q24,
                                 .gain_q24 = tuner.gain_q24,
                                 .plan = &plan};
        for (unsigned phase = 0; phase < 3; phase++) {
            torque[phase] = phase_map_torque(&machine_tables, commutation.angle[phase], current_q9[phase]);
            sample.error_q24 -= phase_map_scale(&machine_tables.torque_format, torque[phase]);
        }
        error_q24 = sample.error_q24;
        pwm_ditc_step(&parameters, &ditc, &commutation, &sample, duty_q15);
        bp_tuner_step(&parameters.pid, &tuner, &ditc.pid.sample);
    }

    pwm_ditc_parameters_t parameters = parameters_of(BP_PID_FIXED);
    pwm_ditc_t ditc{};
    bp_tuner_t tuner{};
    pwm_ditc_plan_t plan{.factor_q16 = 1 << 16, .duty_per_torque_q47 = 0, .setpoint_q9 = 0, .lead = 0};
    int32_t current_q9[HAL_PHASES_MAX] = {0, 0, 0, 0};
    pwm_ditc_plan_t plan_of(uint32_t angle, int32_t phase_q9, int32_t reference_q24 = 8 << 24, int32_t step = 0) const {
        const pwm_ditc_plan_sample_t sample{
            .angle = angle, .current_q9 = phase_q9, .reference_q24 = reference_q24, .angle_step = step};
        return pwm_ditc_plan(&parameters, &machine_tables, &sample);
    }

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
        reset();
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
    bp_pid_t pid{};
    int32_t last_q24 = 0;
    for (int k = 0; k < 50; k++) {
        current_q9[0] = (k % 30) << 9;
        plan.factor_q16 = (1 + k % 4) << 15;
        step(commutation, 5.0);
        // Both errors times the present factor: a factor that changes is no change of the error.
        const auto normalised = [&](int32_t raw_q24) { return int32_t(int64_t(raw_q24) * plan.factor_q16 >> 16); };
        bp_pid_set_error(&parameters.pid, &pid, normalised(last_q24));
        EXPECT_EQ(duty_q15[0], bp_pid_step(&parameters.pid, &pid, tuner.gain_q24, normalised(error_q24)));
        last_q24 = error_q24;
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

TEST_F(PwmDitc, the_incoming_phase_is_driven_by_half_of_a_deadbeat_law_to_the_current_that_will_carry_the_reference) {
    // Phase 0 is outgoing with about the reference torque: no shortfall beyond the band.
    const roles_t commutation = commutation_of(300.5);
    ASSERT_EQ(commutation.active, 1u);
    for (double reference = 0.5; reference < 14.0; reference += 0.25) {
        reset();
        current_q9[0] = map_current_q9(commutation.angle[0], to_fixed(reference, Q24));
        const double carrying_A = pwm_ditc_setpoint_q9(&parameters.current_setpoints, to_fixed(reference, Q24)) / Q9;
        const double target_A = std::min(carrying_A, LIMIT_Q9 / Q9);
        duty_q15[1] = -ONE_Q15;
        for (int current_A = 0; current_A < 60; current_A += 3) {
            current_q9[1] = current_A << 9;
            const double acting = duty_q15[1] == -ONE_Q15 ? 0.0 : duty_q15[1] / Q15;
            step(commutation, reference);
            ASSERT_EQ(ditc.regulated, 0u);
            const double wanted = (target_A - current_A) * parameters.incoming_gain_q24 / Q24;
            ASSERT_NEAR(duty_q15[1] / Q15, std::clamp(wanted - acting / 2.0, -1.0, 1.0), 2.0 / Q15)
                << reference << " " << current_A;
        }
    }
}

TEST_F(PwmDitc, the_current_of_the_incoming_phase_does_not_overshoot_and_settles_at_any_larger_inductance) {
    const roles_t commutation = commutation_of(301.0);
    const double reference = 8.0;
    const double target_A = pwm_ditc_setpoint_q9(&parameters.current_setpoints, to_fixed(reference, Q24)) / Q9;
    const double rise_A = 0.5 / (parameters.incoming_gain_q24 / Q24);
    for (const double inductance : {1.0, 1.5, 3.0, 10.0}) {
        reset();
        std::fill(std::begin(duty_q15), std::end(duty_q15), -ONE_Q15);
        current_q9[0] = map_current_q9(commutation.angle[0], to_fixed(reference, Q24));
        double current_A = 0.0, most_A = 0.0;
        for (int k = 0; k < 300; k++) {
            const double acting = duty_q15[1] == -ONE_Q15 ? 0.0 : duty_q15[1] / Q15;
            current_q9[1] = to_fixed(current_A, Q9);
            step(commutation, reference);
            ASSERT_EQ(ditc.regulated, 0u) << k;
            current_A += acting * rise_A / inductance;
            most_A = std::max(most_A, current_A);
        }
        EXPECT_NEAR(current_A, target_A, 0.02) << inductance;
        EXPECT_LT(most_A, 1.01 * target_A) << inductance;
    }
}

TEST_F(PwmDitc, the_pid_changes_phases_when_the_incoming_one_has_the_larger_torque_and_none_is_missing) {
    const roles_t commutation = commutation_of(320.0);
    unsigned changed = 0, missing = 0, smaller = 0;
    for (double reference = 0.0; reference < 16.0; reference += 0.5) {
        for (int outgoing_A = 0; outgoing_A < 52; outgoing_A += 2) {
            for (int incoming_A = 0; incoming_A < 52; incoming_A += 2) {
                reset();
                current_q9[0] = outgoing_A << 9;
                current_q9[1] = incoming_A << 9;
                step(commutation, reference);
                const bool larger = torque[1] >= torque[0];
                ASSERT_EQ(ditc.regulated, larger && error_q24 <= 0 ? 1u : 0u);
                changed += ditc.regulated == 1u;
                missing += larger && error_q24 > 0;
                smaller += !larger && error_q24 <= 0;
            }
        }
    }
    EXPECT_GT(std::min({changed, missing, smaller}), 1000u);
}

TEST_F(PwmDitc, a_change_of_phases_is_bumpless_and_the_outgoing_phase_keeps_its_mean_duty) {
    const roles_t commutation = commutation_of(320.0);
    current_q9[0] = 20 << 9;
    current_q9[1] = 10 << 9;
    std::fill_n(parameters.pid.scale_q28, BP_OUTPUTS, 0); // the PID keeps its duty
    bp_tuner_reset(&parameters.pid, &tuner);
    step(commutation, 4.0);
    const double reference = torque_Nm(1); // of the incoming phase alone
    bp_pid_preset(&ditc.pid, -9000);
    for (int k = 0; k < 40; k++) {
        step(commutation, reference);
    }
    ASSERT_EQ(ditc.regulated, 0u);
    ASSERT_EQ(duty_q15[0], -9000);
    const int32_t held_q15 = duty_q15[1];
    current_q9[0] = 4 << 9;
    for (int k = 0; k < 20; k++) { // and it does not change back
        step(commutation, reference);
        ASSERT_EQ(ditc.regulated, 1u);
        EXPECT_NEAR(duty_q15[0], -9000, 4);
        EXPECT_NEAR(duty_q15[1], held_q15, 2) << "the duty that the law of the current has settled to";
        current_q9[0] = 8 << 9;
    }
}

TEST_F(PwmDitc, an_outgoing_phase_that_was_left_gets_no_voltage_that_raises_it_unless_torque_is_missing) {
    const roles_t commutation = commutation_of(320.0);
    current_q9[0] = 4 << 9;
    current_q9[1] = 12 << 9;
    step(commutation, 0.5);
    ASSERT_EQ(ditc.regulated, 1u);
    ditc.released_q15 = 5000;
    step(commutation, 1.0);
    EXPECT_EQ(duty_q15[0], 0);
    step(commutation, 16.0);
    ASSERT_GT(error_q24, parameters.band_outer_q24);
    EXPECT_GT(duty_q15[0], ONE_Q15 / 2);
    current_q9[0] = LIMIT_Q9 + 1;
    step(commutation, 40.0);
    ASSERT_GT(error_q24, parameters.band_outer_q24);
    EXPECT_EQ(duty_q15[0], 0) << "above the current limit";
    step(commutation, 0.0);
    ASSERT_LT(error_q24, -parameters.band_outer_q24);
    EXPECT_EQ(duty_q15[0], -ONE_Q15);
    step(commutation_of(349.0), 1.0);
    EXPECT_EQ(duty_q15[0], -ONE_Q15) << "no longer available";
}

TEST_F(PwmDitc, what_the_incoming_phase_gains_in_torque_is_taken_from_the_duty_of_the_outgoing_one) {
    const roles_t commutation = commutation_of(310.0);
    std::fill_n(parameters.pid.scale_q28, BP_OUTPUTS, 0);
    bp_tuner_reset(&parameters.pid, &tuner);
    plan.duty_per_torque_q47 = parameters.duty_per_torque_q44 << 3;
    current_q9[0] = 25 << 9;
    double last_Nm = 0.0, largest = 0.0;
    for (int k = 0; k < 30; k++) {
        current_q9[1] = (k + k % 3) << 9;
        step(commutation, 12.0);
        ASSERT_EQ(ditc.regulated, 0u);
        const double per_Nm = parameters.duty_per_torque_q44 / std::ldexp(1.0, 44) * Q24 /
                              std::ldexp(1.0, machine_tables.torque_format.result_shift);
        const double forward = -(torque_Nm(1) - last_Nm) * per_Nm;
        EXPECT_NEAR(duty_q15[0] / Q15, std::max(forward, -1.0), 2.0 / Q15) << k;
        largest = std::max(largest, std::fabs(forward));
        last_Nm = torque_Nm(1);
    }
    EXPECT_GT(largest, 0.05);
}

// dT/dpsi in N m/Wb by differences of 1 %.
double torque_per_flux(uint32_t angle, double current_A) {
    const int32_t low_q9 = to_fixed(0.995 * current_A, Q9), high_q9 = to_fixed(1.14 * current_A, Q9);
    const uint32_t distance = phase_map_distance(angle);
    return (map_torque_q24(angle, high_q9) - map_torque_q24(angle, low_q9)) / Q24 /
           ((phase_map_flux_q29(&machine_tables, distance, high_q9) -
             phase_map_flux_q29(&machine_tables, distance, low_q9)) /
            Q29);
}

TEST_F(PwmDitc, the_plan_makes_the_gain_of_the_loop_the_same_at_every_angle_and_current) {
    const double reference = torque_per_flux(MIDDLE, LIMIT_Q9 / Q9 / 2.0);
    const double unit = std::ldexp(1.0, machine_tables.torque_format.result_shift) / Q24; // N m
    unsigned inside = 0, limited = 0;
    for (double deg = 182.0; deg < 355.0; deg += 3.0) {
        for (double current_A = 4.0; current_A < 60.0; current_A += 3.0) {
            const uint32_t angle = electrical_angle(deg);
            const pwm_ditc_plan_t at = plan_of(angle, to_fixed(current_A, Q9));
            const double exact = reference / torque_per_flux(angle, current_A);
            const double expected = std::clamp(exact, 1.0 / 32.0, 4.0);
            ASSERT_NEAR(at.factor_q16 / Q16, expected, 0.06 * expected) << deg << " " << current_A;
            const double duty_per_Nm = at.factor_q16 / Q16 / (reference * 240.0 / 40e3);
            ASSERT_NEAR(at.duty_per_torque_q47 / std::ldexp(1.0, 47) / unit, duty_per_Nm, 0.05 * duty_per_Nm);
            (exact > 1.0 / 32.0 && exact < 4.0 ? inside : limited)++;
        }
    }
    EXPECT_GT(inside, 600u);
    EXPECT_GT(limited, 20u);
    EXPECT_EQ(plan_of(electrical_angle(90.0), 10 << 9).factor_q16, 4 << 16) << "negative torque";
    EXPECT_EQ(plan_of(MIDDLE, 10 << 9, 100 << 24).setpoint_q9, LIMIT_Q9) << "within the limit";
}

TEST_F(PwmDitc, the_lead_is_the_rotation_in_two_periods_and_half_of_the_rise_of_the_current) {
    for (const double reference : {0.0, 2.0, 8.0, 16.0}) {
        const int32_t reference_q24 = to_fixed(reference, Q24);
        const double setpoint_A =
            std::min(pwm_ditc_setpoint_q9(&parameters.current_setpoints, reference_q24), LIMIT_Q9) / Q9;
        const double periods = 2.0 + setpoint_A * parameters.incoming_gain_q24 / Q24;
        for (const int32_t step : {0, 1, 268000, -268000, 40000000}) {
            EXPECT_NEAR(int32_t(plan_of(MIDDLE, 10 << 9, reference_q24, step).lead), periods * step,
                        2.0 + std::fabs(step) / Q15)
                << reference << " " << step;
        }
    }
}

TEST(PwmDitcSetpoints, of_a_negative_torque_is_that_of_none) {
    const pwm_ditc_setpoints_t setpoints = pwm_ditc_setpoints(&machine_tables, electrical_angle(210.0));
    for (const int32_t torque_q24 : {-1, -(1 << 24), INT32_MIN}) {
        EXPECT_EQ(pwm_ditc_setpoint_q9(&setpoints, torque_q24), 0) << torque_q24;
    }
    EXPECT_GT(pwm_ditc_setpoint_q9(&setpoints, 1 << 24), 0);
}

TEST(PwmDitcSetpoints, are_interpolated_and_rounded_down_for_any_torque_and_currents) {
    std::mt19937 random(9);
    for (int table = 0; table < 50; table++) {
        pwm_ditc_setpoints_t setpoints{};
        for (unsigned k = 1; k < PWM_DITC_SETPOINTS; k++) {
            setpoints.current_q9[k] = uint16_t(setpoints.current_q9[k - 1] + random() % 1400);
        }
        for (int i = 0; i < 4000; i++) {
            const int32_t torque_q24 = wide_integer::any_up_to(random, INT32_MAX);
            // Four entries for each doubling of the torque and 1/16 N m.
            const double shifted = torque_q24 / Q24 * 16.0 + 1.0;
            const auto at = [](unsigned k) { return (1.0 + k % 4 / 4.0) * std::exp2(k / 4); };
            unsigned k = 0;
            while (at(k + 1) <= shifted) {
                k++;
            }
            const double low_q9 = setpoints.current_q9[k], rise_q9 = setpoints.current_q9[k + 1] - low_q9;
            const double exact_q9 = low_q9 + rise_q9 * (shifted - at(k)) / (at(k + 1) - at(k));
            const int32_t setpoint_q9 = pwm_ditc_setpoint_q9(&setpoints, torque_q24);
            ASSERT_LE(setpoint_q9, exact_q9) << torque_q24;
            ASSERT_GT(setpoint_q9, exact_q9 - 1.0 - rise_q9 / std::exp2(14)) << torque_q24;
        }
    }
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
    bp_tuner_reset(&parameters.pid, &tuner);
    step(commutation_of(347.99), 3.0);
    const int32_t incoming_q15 = duty_q15[1];
    ASSERT_NE(incoming_q15, duty_q15[0]);
    step(commutation_of(348.01), 3.0);
    EXPECT_EQ(ditc.regulated, 1u);
    EXPECT_NEAR(duty_q15[1], incoming_q15, 100);
    EXPECT_EQ(duty_q15[0], -ONE_Q15);
}

TEST_F(PwmDitc, the_ceiling_of_the_duty_is_rounded_to_nearest) {
    const roles_t commutation = commutation_of(320.0);
    std::fill_n(parameters.pid.scale_q28, BP_OUTPUTS, 0);
    bp_tuner_reset(&parameters.pid, &tuner);
    parameters.ceiling_gain_q24 = (1 << 24) / 60; // so that the ceiling is within the duties
    std::mt19937 random(10);
    int within = 0;
    for (int i = 0; i < 20000; i++) {
        pwm_ditc_reset(&ditc);
        ditc.regulated = commutation.outgoing;
        bp_pid_preset(&ditc.pid, ONE_Q15);
        current_q9[0] = int32_t(random() % (LIMIT_Q9 + 1));
        current_q9[1] = current_q9[2] = 0;
        const int32_t acting_q15 = duty_q15[0] = int32_t(random() % 65537) - ONE_Q15;
        step(commutation, 100.0);
        const wide_integer::wide_t room_q9 = parameters.current_ceiling_q9 - current_q9[0];
        const auto ceiling_q15 = wide_integer::nearest(room_q9 * parameters.ceiling_gain_q24, 1 << 18) - acting_q15;
        const int32_t expected_q15 = std::clamp(int32_t(ceiling_q15), -ONE_Q15, ONE_Q15);
        ASSERT_EQ(duty_q15[0], expected_q15) << current_q9[0] << " " << acting_q15;
        within += std::abs(expected_q15) < ONE_Q15;
    }
    EXPECT_GT(within, 5000);
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
            if (phase != ditc.regulated && phase != commutation.active && phase != commutation.outgoing) {
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
        reset();
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
            parameters.ceiling_gain_q24 = gain;
            reset();
            for (int k = 0; k < 3000; k++) {
                const roles_t commutation = roles_at(ANGLES, 3, 4, uint32_t(random()));
                for (unsigned phase = 0; phase < 3; phase++) {
                    current_q9[phase] = int32_t(random() % 40951);
                    torque[phase] = ends[random() % 5];
                }
                plan = {.factor_q16 = int32_t(random() % ((4 << 16) + 1)),
                        .duty_per_torque_q47 = gain,
                        .setpoint_q9 = int32_t(random() % LIMIT_Q9),
                        .lead = 0};
                const pwm_ditc_sample_t sample = {.current_q9 = current_q9,
                                                  .torque = torque,
                                                  .error_q24 = ends[random() % 5],
                                                  .gain_q24 = tuner.gain_q24,
                                                  .plan = &plan};
                pwm_ditc_step(&parameters, &ditc, &commutation, &sample, duty_q15);
                bp_tuner_step(&parameters.pid, &tuner, &ditc.pid.sample);
                for (unsigned phase = 0; phase < 3; phase++) {
                    ASSERT_LE(std::abs(duty_q15[phase]), ONE_Q15);
                }
            }
        }
    }
}

} // namespace
