// DITC by duty: who is regulated, how the phases hand over, and that every rotor position starts.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/ditc_duty.h"
#include "control/phase_map.h"
}

#include "support/reference_models.h"

namespace {

constexpr int32_t ONE_Q15 = 32768;
constexpr int32_t LIMIT_Q9 = 52 << 9;

uint32_t electrical(double degrees) {
    return uint32_t(std::floor(degrees / 360.0 * twins::TURN));
}

const uint32_t HAND_OVER = electrical(210.0);
const commutation_angles_t ANGLES = {electrical(180.0), electrical(300.0), electrical(348.0)};

// With the angle of each phase.
struct roles_t : commutation_t {
    uint32_t angle[HAL_PHASES_MAX];
};

roles_t commutation_at(const commutation_angles_t *angles, unsigned phases, unsigned rotor_poles, uint32_t angle) {
    const commutation_parameters_t parameters = commutation_configure(angles, phases, rotor_poles);
    roles_t commutation{};
    commutation_find(&parameters, angle, &commutation);
    for (unsigned phase = 0; phase < phases; phase++) {
        commutation.angle[phase] = commutation_angle(&parameters, &commutation, phase);
    }
    return commutation;
}

// Rotor angle at which phase 0 of the 6/4 machine is at an electrical angle.
roles_t commutation_of(double phase_0_deg) {
    return commutation_at(&ANGLES, 3, 4, electrical(phase_0_deg) / 4u);
}

int32_t map_torque_q24(uint32_t phase_angle, int32_t current_q9) {
    const phase_map_place_t place = phase_map_at(&machine_tables, phase_angle);
    return phase_map_torque_q24(&place, current_q9);
}

int32_t map_current_q9(uint32_t phase_angle, int32_t torque_q24) {
    int32_t below = 0, above = PHASE_MAP_CURRENT_MAX_Q9;
    while (above - below > 1) {
        const int32_t middle = (below + above) / 2;
        (map_torque_q24(phase_angle, middle) <= torque_q24 ? below : above) = middle;
    }
    return below;
}

ditc_duty_parameters_t parameters_of(bp_pid_mode_t mode) {
    ditc_duty_parameters_t parameters{};
    parameters.pid.mode = mode;
    parameters.pid.seed = 1;
    parameters.pid.error_scale_inverse_q24 = 1 << 23;
    parameters.pid.scale_q28[0] = 32768 << 13;
    parameters.pid.scale_q28[1] = 7864 << 13;
    parameters.pid.scale_q28[2] = 13107 << 13;
    parameters.pid.network = {1638, 1638 << 17};
    parameters.aims = ditc_duty_aims(&machine_tables, HAND_OVER);
    parameters.incoming_gain_q24 = 58544 << 4; // 40 kHz, 358 A/ms
    parameters.surplus_q32 = 1 << 28;
    parameters.spent_torque_q24 = 1 << 20;
    parameters.band_outer_q24 = 2 << 24;
    parameters.current_limit_q9 = LIMIT_Q9;
    return parameters;
}

class DitcDuty : public testing::Test {
  protected:
    DitcDuty() { ditc_duty_reset(&parameters, &ditc); }

    // One sample with the map's torques for the currents.
    void step(const roles_t &commutation, double reference_Nm) {
        ditc_duty_sample_t sample{current_q9, torque_q24, twins::to_fixed(reference_Nm, twins::Q24), 0};
        sample.error_q24 = sample.reference_q24;
        for (unsigned phase = 0; phase < 3; phase++) {
            torque_q24[phase] = map_torque_q24(commutation.angle[phase], current_q9[phase]);
            sample.error_q24 -= torque_q24[phase];
        }
        error_q24 = sample.error_q24;
        ditc_duty_step(&parameters, &ditc, &commutation, &sample, duty_q15);
    }

    ditc_duty_parameters_t parameters = parameters_of(BP_PID_FIXED);
    ditc_duty_t ditc{};
    int32_t current_q9[HAL_PHASES_MAX] = {0, 0, 0, 0};
    int32_t torque_q24[HAL_PHASES_MAX] = {0, 0, 0, 0};
    int32_t error_q24 = 0;
    int32_t duty_q15[HAL_PHASES_MAX] = {0, 0, 0, 0};
};

TEST_F(DitcDuty, from_standstill_every_rotor_position_drives_phases_that_can_carry_the_torque) {
    double weakest = 1e9;
    for (int tenth_deg = 0; tenth_deg < 3600; tenth_deg++) {
        const roles_t commutation = commutation_at(&ANGLES, 3, 4, electrical(tenth_deg / 10.0));
        ditc_duty_reset(&parameters, &ditc);
        for (int k = 0; k < 20; k++) {
            step(commutation, 8.0);
        }
        double torque_Nm = 0.0;
        for (unsigned phase = 0; phase < 3; phase++) {
            if (duty_q15[phase] > 0) {
                torque_Nm += map_torque_q24(commutation.angle[phase], LIMIT_Q9) / twins::Q24;
            }
        }
        weakest = std::min(weakest, torque_Nm);
    }
    EXPECT_GT(weakest, 19.1) << "the rated torque, at the current limit";
    EXPECT_LT(weakest, 25.0);
}

TEST_F(DitcDuty, the_only_phase_at_work_gets_the_pid_s_duty_and_the_others_are_off) {
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

TEST_F(DitcDuty, in_a_gap_of_the_commutation_every_phase_is_off) {
    roles_t commutation = commutation_of(230.0);
    commutation.active = commutation.outgoing = COMMUTATION_NONE;
    step(commutation, 5.0);
    for (unsigned phase = 0; phase < 3; phase++) {
        EXPECT_EQ(duty_q15[phase], -ONE_Q15);
    }
    EXPECT_EQ(ditc.regulated, unsigned(COMMUTATION_NONE));
}

TEST_F(DitcDuty, from_standstill_past_its_window_a_phase_is_regulated_and_the_next_one_assists) {
    const roles_t commutation = commutation_of(320.0);
    ASSERT_EQ(commutation.outgoing, 0u);
    ASSERT_EQ(commutation.active, 1u);
    step(commutation, 8.0);
    EXPECT_EQ(ditc.regulated, 0u);
    EXPECT_GT(duty_q15[0], 0);
    EXPECT_EQ(duty_q15[1], ONE_Q15) << "torque is missing beyond the outer band: full voltage to the current limit";
    EXPECT_EQ(duty_q15[2], -ONE_Q15);
}

TEST_F(DitcDuty, the_incoming_phase_is_brought_to_the_current_that_will_carry_the_reference) {
    // Phase 0 outgoing with about the torque wanted: no missing torque beyond the band.
    const roles_t commutation = commutation_of(305.0);
    ASSERT_EQ(commutation.active, 1u);
    for (double reference = 0.5; reference < 14.0; reference += 0.25) {
        ditc_duty_reset(&parameters, &ditc);
        current_q9[0] = map_current_q9(commutation.angle[0], twins::to_fixed(reference, twins::Q24));
        const double carrying_A =
            ditc_duty_aim_q9(&parameters.aims, twins::to_fixed(reference * 17 / 16, twins::Q24)) / twins::Q9;
        const double target_A = std::min(carrying_A, LIMIT_Q9 / twins::Q9);
        for (int current_A = 0; current_A < 60; current_A += 3) {
            current_q9[1] = current_A << 9;
            step(commutation, reference);
            ASSERT_EQ(ditc.regulated, 0u);
            const double exact =
                std::clamp((target_A - current_A) * parameters.incoming_gain_q24 / twins::Q24, -1.0, 1.0);
            ASSERT_NEAR(duty_q15[1] / twins::Q15, exact, 1.0 / twins::Q15) << reference << " " << current_A;
        }
    }
}

TEST_F(DitcDuty, the_pid_moves_on_when_the_outgoing_phase_is_spent_and_starts_from_the_incoming_duty) {
    const roles_t commutation = commutation_of(320.0);
    current_q9[0] = 20 << 9;
    current_q9[1] = 10 << 9;
    step(commutation, 4.0);
    ASSERT_EQ(ditc.regulated, 0u);
    // Still torque to take off: it stays, though the error is negative.
    step(commutation, 1.0);
    ASSERT_LT(error_q24, 0);
    EXPECT_EQ(ditc.regulated, 0u);
    // No torque left, but torque missing: it stays, both build up.
    current_q9[0] = 0;
    step(commutation, 8.0);
    ASSERT_GT(error_q24, 0);
    EXPECT_EQ(ditc.regulated, 0u);
    // No torque left and none missing.
    current_q9[1] = 12 << 9;
    const double reference = torque_q24[1] / twins::Q24;
    step(commutation, 0.5 * reference);
    ASSERT_LE(error_q24, 0);
    EXPECT_EQ(ditc.regulated, 1u);
    EXPECT_EQ(duty_q15[0], -ONE_Q15);
    // It does not go back.
    current_q9[0] = 20 << 9;
    step(commutation, 8.0);
    EXPECT_EQ(ditc.regulated, 1u);
}

TEST(DitcDutyAims, are_the_map_s_currents_within_two_hundredths_and_small_ones_within_a_third_of_an_ampere) {
    for (const double angle_deg : {180.0, 210.0, 255.0, 300.0}) {
        const ditc_duty_aims_t aims = ditc_duty_aims(&machine_tables, electrical(angle_deg));
        double worst_part = 0.0, worst_A = 0.0;
        int32_t last_q9 = 0;
        for (int64_t wide_q24 = 0; wide_q24 <= INT32_MAX; wide_q24 += 1 + wide_q24 / 64) {
            const auto torque_q24 = int32_t(wide_q24);
            const double exact_A = map_current_q9(electrical(angle_deg), torque_q24) / twins::Q9;
            const int32_t aim_q9 = ditc_duty_aim_q9(&aims, torque_q24);
            const double off_A = std::fabs(aim_q9 / twins::Q9 - exact_A);
            ASSERT_GE(aim_q9, last_q9) << torque_q24;
            last_q9 = aim_q9;
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
        EXPECT_EQ(ditc_duty_aim_q9(&aims, 0), 0);
        EXPECT_GT(ditc_duty_aim_q9(&aims, INT32_MAX), LIMIT_Q9) << "more than the machine has";
    }
}

TEST_F(DitcDuty, the_aim_of_the_incoming_phase_is_its_surplus_above_the_reference) {
    const roles_t commutation = commutation_of(305.0);
    const double reference = 8.0;
    parameters.incoming_gain_q24 = 1 << 20; // not held at the ends
    current_q9[0] = map_current_q9(commutation.angle[0], twins::to_fixed(reference, twins::Q24));
    for (const double surplus : {0.0, 1.0 / 400.0, 1.0 / 16.0, 1.0 / 8.0}) {
        parameters.surplus_q32 = int32_t(surplus * twins::Q32);
        ditc_duty_reset(&parameters, &ditc);
        const double aim_A =
            ditc_duty_aim_q9(&parameters.aims, twins::to_fixed(reference * (1.0 + surplus), twins::Q24)) / twins::Q9;
        current_q9[1] = int32_t(aim_A) << 9;
        step(commutation, reference);
        ASSERT_NEAR(duty_q15[1] / twins::Q15, (aim_A - std::floor(aim_A)) / 16.0, 2.0 / twins::Q15) << surplus;
    }
}

TEST_F(DitcDuty, the_pid_leaves_an_outgoing_phase_below_the_spent_torque_an_eighth_of_the_reference_or_a_sixteenth_Nm) {
    const roles_t commutation = commutation_of(320.0);
    unsigned left = 0, held = 0;
    for (const double spent : {0.0, 0.03, 0.0625, 0.5, 1.5}) {
        parameters.spent_torque_q24 = twins::to_fixed(spent, twins::Q24);
        for (double reference = 0.0; reference < 16.0; reference += 0.5) {
            for (int current_eighth_A = 0; current_eighth_A < 80; current_eighth_A++) {
                ditc_duty_reset(&parameters, &ditc);
                current_q9[0] = current_eighth_A << 6;
                current_q9[1] = 52 << 9;
                step(commutation, reference);
                const double limit = std::max(0.0625, std::min(reference / 8.0, spent));
                const bool leaves = torque_q24[0] < limit * twins::Q24 && error_q24 <= 0;
                ASSERT_EQ(ditc.regulated, leaves ? 1u : 0u) << spent << " " << reference << " " << current_eighth_A;
                left += leaves;
                held += !leaves && error_q24 <= 0;
            }
        }
    }
    EXPECT_GT(left, 500u);
    EXPECT_GT(held, 500u);
}

TEST_F(DitcDuty, the_pid_moves_on_when_the_outgoing_phase_must_go_and_starts_from_the_incoming_duty) {
    current_q9[0] = 20 << 9;
    current_q9[1] = 8 << 9;
    for (int k = 0; k < 30; k++) {
        step(commutation_of(340.0), 3.0);
    }
    ASSERT_EQ(ditc.regulated, 0u);
    // The same sample again, past 348 degrees. Errors held, so that the PID's increment is known.
    std::fill_n(parameters.pid.scale_q28, BP_OUTPUTS, 0);
    step(commutation_of(347.99), 3.0);
    const int32_t incoming_q15 = duty_q15[1];
    ASSERT_NE(incoming_q15, duty_q15[0]);
    step(commutation_of(348.01), 3.0);
    EXPECT_EQ(ditc.regulated, 1u);
    EXPECT_NEAR(duty_q15[1], incoming_q15, 100);
    EXPECT_EQ(duty_q15[0], -ONE_Q15);
}

TEST_F(DitcDuty, a_phase_above_the_current_limit_is_never_driven) {
    std::mt19937 random(1);
    for (int i = 0; i < 200000; i++) {
        const roles_t commutation = commutation_at(&ANGLES, 3, 4, uint32_t(random()));
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

TEST_F(DitcDuty, nothing_overflows_at_the_ends_of_all_ranges) {
    std::mt19937 random(2);
    const int32_t ends[] = {INT32_MIN, INT32_MAX, 0, 1, -1};
    for (const int32_t gain : {0, 1, INT32_MAX}) {
        for (const bp_pid_mode_t mode : {BP_PID_FIXED, BP_PID_FROZEN, BP_PID_LEARNING}) {
            parameters = parameters_of(mode);
            parameters.incoming_gain_q24 = gain;
            parameters.surplus_q32 = gain;
            parameters.spent_torque_q24 = gain;
            ditc_duty_reset(&parameters, &ditc);
            for (int k = 0; k < 3000; k++) {
                const roles_t commutation = commutation_at(&ANGLES, 3, 4, uint32_t(random()));
                for (unsigned phase = 0; phase < 3; phase++) {
                    current_q9[phase] = int32_t(random() % 40951);
                    torque_q24[phase] = ends[random() % 5];
                }
                const ditc_duty_sample_t sample = {current_q9, torque_q24, int32_t(random() >> 1), ends[random() % 5]};
                ditc_duty_step(&parameters, &ditc, &commutation, &sample, duty_q15);
                for (unsigned phase = 0; phase < 3; phase++) {
                    ASSERT_LE(std::abs(duty_q15[phase]), ONE_Q15);
                }
            }
        }
    }
}

} // namespace
