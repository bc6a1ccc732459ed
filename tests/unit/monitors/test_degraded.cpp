// Degraded running: which loss of a phase is accepted, and the torque that remains. Machine: saturating. [SR-31]
#include <cmath>
#include <cstdint>

#include <gtest/gtest.h>

extern "C" {
#include "monitors/degraded.h"
#include "storage/fault.h"
}

#include "support/phase_map_results.h"

namespace {

constexpr double Q24 = 16777216.0;
const uint64_t OPEN = FAULT_BIT(FAULT_PHASE_OPEN), SENSOR = FAULT_BIT(FAULT_CURRENT_SENSOR);

class Degraded : public testing::Test {
  protected:
    Degraded() {
        parameters.allowed = true;
        parameters.stroke = 0x55555555u;
        parameters.window = {0x80000000u, 0x7FFFFFFFu};
        parameters.current_limit_q9 = 52 * 512;
        parameters.torque_max_q24 = int32_t(19.0 * Q24);
    }

    degraded_parameters_t parameters{};
    degraded_t degraded{};
};

TEST_F(Degraded, the_loss_of_one_phase_is_accepted_in_a_run_if_allowed) {
    EXPECT_TRUE(degraded_accepts(&parameters, &degraded, true, OPEN, 2u));
    EXPECT_EQ(degraded.lost, 2u);
    degraded = {};
    EXPECT_TRUE(degraded_accepts(&parameters, &degraded, true, SENSOR | OPEN, 4u));
    degraded = {};
    EXPECT_FALSE(degraded_accepts(&parameters, &degraded, false, OPEN, 2u));
    parameters.allowed = false;
    EXPECT_FALSE(degraded_accepts(&parameters, &degraded, true, OPEN, 2u));
    EXPECT_EQ(degraded.lost, 0u);
}

TEST_F(Degraded, nothing_else_is_accepted) {
    EXPECT_FALSE(degraded_accepts(&parameters, &degraded, true, 0, 2u));
    EXPECT_FALSE(degraded_accepts(&parameters, &degraded, true, OPEN, 3u));
    EXPECT_FALSE(degraded_accepts(&parameters, &degraded, true, OPEN, 0u));
    EXPECT_FALSE(degraded_accepts(&parameters, &degraded, true, FAULT_BIT(FAULT_PHASE_SHORTED), 2u));
    EXPECT_FALSE(degraded_accepts(&parameters, &degraded, true, OPEN | FAULT_BIT(FAULT_PHASE_SHORTED), 2u));
    ASSERT_TRUE(degraded_accepts(&parameters, &degraded, true, OPEN, 2u));
    EXPECT_FALSE(degraded_accepts(&parameters, &degraded, true, OPEN, 4u));
    EXPECT_EQ(degraded.lost, 2u);
}

TEST_F(Degraded, a_phase_has_no_torque_before_its_turn_on_angle_nor_from_its_turn_off_angle_on) {
    parameters.window = {0xA0000000u, 0x30000000u};
    degraded.lost = 6u; // phase 0 alone
    const auto torque = [this](uint32_t electrical) {
        return degraded_torque_q24(&parameters, &degraded, &machine_tables, electrical);
    };
    EXPECT_EQ(torque(0xA0000000u - 1u), 0);
    EXPECT_GT(torque(0xA0000000u), 0);
    EXPECT_GT(torque(0xD0000000u - 1u), 0);
    EXPECT_EQ(torque(0xD0000000u), 0);
    EXPECT_EQ(torque(0x40000000u), 0) << "beyond the aligned position it would brake";
}

TEST_F(Degraded, the_torque_that_remains_is_the_sum_of_the_others_at_the_current_limit) {
    degraded.lost = 2u;
    for (uint32_t k = 0; k < 64; k++) {
        const uint32_t electrical = k << 26;
        double sum_Nm = 0.0;
        for (const uint32_t phase : {0u, 2u}) {
            const uint32_t angle = electrical - phase * parameters.stroke;
            const double torque_Nm =
                phase_map_results::torque_q24(machine_tables, angle, parameters.current_limit_q9) / Q24;
            sum_Nm += torque_Nm > 0.0 ? torque_Nm : 0.0;
        }
        const double expected_Nm = sum_Nm < 19.0 ? sum_Nm : 19.0;
        EXPECT_NEAR(degraded_torque_q24(&parameters, &degraded, &machine_tables, electrical) / Q24, expected_Nm, 1e-3);
    }
}

TEST_F(Degraded, mean_least_and_limit_are_those_of_all_angles_after_one_step_for_each) {
    for (const uint32_t lost : {1u, 2u, 4u}) {
        degraded = {};
        ASSERT_TRUE(degraded_accepts(&parameters, &degraded, true, OPEN, lost));
        double sum_Nm = 0.0, least_Nm = INFINITY, most_Nm = 0.0;
        for (uint32_t k = 0; k < DEGRADED_ANGLES; k++) {
            EXPECT_EQ(degraded_torque_limit_q24(&degraded), INT32_MAX);
            const double torque_Nm = degraded_torque_q24(&parameters, &degraded, &machine_tables, k << 26) / Q24;
            sum_Nm += torque_Nm;
            least_Nm = std::fmin(least_Nm, torque_Nm);
            most_Nm = std::fmax(most_Nm, torque_Nm);
            degraded_step(&parameters, &degraded, &machine_tables);
        }
        EXPECT_NEAR(degraded.mean_q24 / Q24, sum_Nm / DEGRADED_ANGLES, 1e-6);
        EXPECT_NEAR(degraded.least_q24 / Q24, least_Nm, 1e-6);
        EXPECT_NEAR(degraded_torque_limit_q24(&degraded) / Q24, most_Nm, 1e-6);
        EXPECT_LT(least_Nm, 1.0);
        EXPECT_GT(degraded.mean_q24 / Q24, 10.0);
    }
}

TEST_F(Degraded, a_second_loss_is_found_from_its_own_angles_alone) {
    ASSERT_TRUE(degraded_accepts(&parameters, &degraded, true, OPEN, 1u));
    for (uint32_t k = 0; k < DEGRADED_ANGLES; k++) {
        degraded_step(&parameters, &degraded, &machine_tables);
    }
    const degraded_t first = degraded;
    degraded.lost = 0; // cleared by the drive
    parameters.current_limit_q9 /= 2;
    ASSERT_TRUE(degraded_accepts(&parameters, &degraded, true, OPEN, 2u));
    EXPECT_EQ(degraded_torque_limit_q24(&degraded), INT32_MAX) << "not yet known";
    for (uint32_t k = 0; k < DEGRADED_ANGLES; k++) {
        degraded_step(&parameters, &degraded, &machine_tables);
    }
    EXPECT_GT(degraded.mean_q24, 0);
    EXPECT_LT(degraded.mean_q24, first.mean_q24 / 4 * 3);
    EXPECT_LT(degraded_torque_limit_q24(&degraded), first.most_q24 / 4 * 3);
}

} // namespace
