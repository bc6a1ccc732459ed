// Every check alone at its boundary, and all together.
#include <cmath>
#include <cstdint>
#include <random>
#include <utility>

#include <gtest/gtest.h>

extern "C" {
#include "drive/fault.h"
#include "drive/protection.h"
}

namespace {

constexpr uint32_t ANGLE_STEP_MAX = 1000000;
constexpr uint32_t ANGLE_UNMOVED_MAX = 3000000;
constexpr int32_t SLOWING_Q22 = 209715; // 40 N m on 0.02 kg m^2 in 25 us: 0.05 rad/s
const protection_parameters_t PARAMETERS = {75 << 9,           300 << 6, 150 << 6, 377 << 22,  ANGLE_STEP_MAX,
                                            ANGLE_UNMOVED_MAX, 17089134, 100000,   SLOWING_Q22};

class Protection : public testing::Test {
  protected:
    Protection() { protection_reset(&protection, healthy.angle); }

    uint16_t check(const protection_sample_t &sample) { return protection_check(&PARAMETERS, &protection, &sample); }

    const protection_sample_t healthy = {0, 240 << 6, 0, 5000, 0, 0};
    protection_t protection{};
};

TEST_F(Protection, a_healthy_drive_fails_no_check) {
    for (int k = 0; k < 1000; k++) {
        ASSERT_EQ(check(healthy), 0);
    }
}

TEST_F(Protection, over_current_is_above_the_trip) {
    protection_sample_t sample = healthy;
    sample.current_max_q9 = 75 << 9;
    EXPECT_EQ(check(sample), 0);
    sample.current_max_q9++;
    EXPECT_EQ(check(sample), FAULT_BIT(FAULT_OVER_CURRENT));
}

TEST_F(Protection, over_voltage_is_above_and_under_voltage_below_its_limit) {
    protection_sample_t sample = healthy;
    sample.bus_voltage_q6 = 300 << 6;
    EXPECT_EQ(check(sample), 0);
    sample.bus_voltage_q6++;
    EXPECT_EQ(check(sample), FAULT_BIT(FAULT_OVER_VOLTAGE));
    sample.bus_voltage_q6 = 150 << 6;
    EXPECT_EQ(check(sample), 0);
    sample.bus_voltage_q6--;
    EXPECT_EQ(check(sample), FAULT_BIT(FAULT_UNDER_VOLTAGE));
}

TEST_F(Protection, over_speed_counts_in_both_directions) {
    protection_sample_t sample = healthy;
    for (const int32_t sign : {1, -1}) {
        sample.angle += 10; // not a frozen encoder
        sample.speed_q22 = sign * (377 << 22);
        EXPECT_EQ(check(sample), 0);
        sample.angle += 10;
        sample.speed_q22 += sign;
        EXPECT_EQ(check(sample), FAULT_BIT(FAULT_OVER_SPEED));
    }
    sample.angle += 10;
    sample.speed_q22 = INT32_MIN;
    EXPECT_EQ(check(sample), FAULT_BIT(FAULT_OVER_SPEED));
}

TEST_F(Protection, an_encoder_jumps_when_it_moves_further_than_the_limit_a_period) {
    protection_sample_t sample = healthy;
    for (const uint32_t step : {ANGLE_STEP_MAX, -ANGLE_STEP_MAX}) {
        sample.angle += step;
        EXPECT_EQ(check(sample), 0);
    }
    for (const uint32_t step : {ANGLE_STEP_MAX + 1, -ANGLE_STEP_MAX - 1, 0x80000000u}) {
        sample.angle += step;
        EXPECT_EQ(check(sample), FAULT_BIT(FAULT_ENCODER)) << step;
        EXPECT_EQ(check(sample), 0) << "it counts once";
    }
}

TEST_F(Protection, a_turn_s_end_is_no_jump) {
    protection_sample_t sample = healthy;
    sample.angle = 10;
    protection_reset(&protection, 0xFFFFFFF0u);
    EXPECT_EQ(check(sample), 0);
    sample.angle = 0xFFFFFFF0u;
    EXPECT_EQ(check(sample), 0);
}

TEST_F(Protection, lost_interrupts_allow_the_encoder_as_many_more_steps) {
    protection_sample_t sample = healthy;
    sample.missed_interrupts = 2;
    sample.angle += 3 * ANGLE_STEP_MAX;
    EXPECT_EQ(check(sample), 0);
    sample.missed_interrupts = 0;
    EXPECT_EQ(check(sample), 0);
    sample.missed_interrupts = 2;
    sample.angle += 3 * ANGLE_STEP_MAX + 1;
    EXPECT_EQ(check(sample), FAULT_BIT(FAULT_ENCODER));
}

TEST_F(Protection, an_observer_that_follows_a_frozen_encoder_to_standstill_hides_nothing) {
    // Slowed evenly from v, the rotor goes v^2 / 2a before it stands: 4.1 rad/s is within the limit, 4.5 beyond it.
    for (const int32_t sign : {1, -1}) {
        for (const auto &[speed_rad_s, fails] : {std::pair{4.1, false}, std::pair{4.5, true}, std::pair{60.0, true}}) {
            protection_reset(&protection, healthy.angle);
            protection_sample_t sample = healthy;
            sample.angle++;
            sample.speed_q22 = sign * int32_t(speed_rad_s * (1 << 22));
            ASSERT_EQ(check(sample), 0);
            sample.speed_q22 = 0;
            bool failed = false;
            for (int k = 0; k < 2000; k++) {
                failed |= check(sample) != 0;
            }
            EXPECT_EQ(failed, fails) << speed_rad_s;
            EXPECT_EQ(check(sample), 0) << "by now the rotor may stand";
        }
    }
}

TEST_F(Protection, an_encoder_is_frozen_when_the_rotor_should_have_moved_further_than_the_limit) {
    for (const int32_t sign : {1, -1}) {
        protection_reset(&protection, healthy.angle);
        protection_sample_t sample = healthy;
        sample.speed_q22 = sign * (10 << 22);
        const double moved_a_period = std::ldexp(double(10 << 22) * PARAMETERS.angle_step_q32, -32);
        const int periods = int(std::floor((ANGLE_UNMOVED_MAX + 1) / moved_a_period));
        ASSERT_GT(periods, 10);
        for (int k = 0; k < periods; k++) {
            ASSERT_EQ(check(sample), 0) << k;
        }
        EXPECT_EQ(check(sample), FAULT_BIT(FAULT_ENCODER));
        EXPECT_EQ(check(sample), FAULT_BIT(FAULT_ENCODER)) << "as long as it lasts";
        sample.angle++;
        EXPECT_EQ(check(sample), 0) << "a count is a movement";
    }
}

TEST_F(Protection, a_still_encoder_says_nothing_at_standstill) {
    protection_sample_t sample = healthy;
    sample.speed_q22 = (1 << 22) - 1;
    for (int k = 0; k < 200000; k++) {
        ASSERT_EQ(check(sample), 0);
    }
    EXPECT_EQ(protection.unmoved, 0);
}

TEST_F(Protection, both_directions_give_the_same_checks_on_mirrored_random_motion) {
    std::mt19937 random(11);
    protection_t mirrored{};
    protection_sample_t sample = healthy, mirror = healthy;
    protection_reset(&mirrored, healthy.angle);
    unsigned over_speed = 0, encoder = 0;
    for (int k = 0; k < 200000; k++) {
        // Often still, now and then beyond a limit.
        const uint32_t step = random() % 4 == 0 ? random() % (ANGLE_STEP_MAX + 50) : 0;
        sample.angle += step;
        mirror.angle -= step;
        if (k % 50 == 0) {
            const uint32_t fastest_rad_s = random() % 20 == 0 ? 400 : 10;
            sample.speed_q22 = int32_t(random() % (fastest_rad_s << 22));
            mirror.speed_q22 = -sample.speed_q22;
        }
        const uint16_t checks = check(sample);
        ASSERT_EQ(protection_check(&PARAMETERS, &mirrored, &mirror), checks) << k;
        ASSERT_EQ(mirrored.unmoved, protection.unmoved) << k;
        over_speed += (checks & FAULT_BIT(FAULT_OVER_SPEED)) != 0;
        encoder += (checks & FAULT_BIT(FAULT_ENCODER)) != 0;
    }
    EXPECT_GT(over_speed, 10u);
    EXPECT_LT(over_speed, 1000u);
    EXPECT_GT(encoder, 1000u);
    EXPECT_LT(encoder, 50000u);
}

TEST_F(Protection, a_reversal_at_a_count_s_edge_is_no_frozen_encoder) {
    protection_sample_t sample = healthy;
    // From 50 rad/s to -50 rad/s in 2000 periods, the count still while the speed is below 2 rad/s.
    for (int k = -1000; k <= 1000; k++) {
        sample.speed_q22 = -k * ((50 << 22) / 1000);
        if (k < -40 || k > 40) {
            sample.angle += sample.speed_q22 > 0 ? 100 : -100;
        }
        ASSERT_EQ(check(sample), 0) << k;
    }
}

TEST_F(Protection, an_encoder_frozen_for_ever_does_not_overflow_its_account) {
    protection_sample_t sample = healthy;
    sample.speed_q22 = INT32_MAX;
    for (int k = 0; k < 1000; k++) {
        check(sample);
        ASSERT_GE(protection.unmoved, 0);
    }
    EXPECT_EQ(check(sample), FAULT_BIT(FAULT_ENCODER) | FAULT_BIT(FAULT_OVER_SPEED));
}

TEST_F(Protection, a_command_is_lost_when_it_is_older_than_the_timeout) {
    protection_sample_t sample = healthy;
    sample.command_age_us = 100000;
    EXPECT_EQ(check(sample), 0);
    sample.command_age_us++;
    EXPECT_EQ(check(sample), FAULT_BIT(FAULT_COMMAND_TIMEOUT));
}

TEST_F(Protection, three_lost_interrupts_in_a_row_are_an_overrun_and_a_good_period_ends_the_row) {
    protection_sample_t sample = healthy, missed = healthy;
    missed.missed_interrupts = 1;
    EXPECT_EQ(check(missed), 0);
    EXPECT_EQ(check(missed), 0);
    EXPECT_EQ(check(missed), FAULT_BIT(FAULT_INTERRUPT_OVERRUN));
    EXPECT_EQ(check(missed), FAULT_BIT(FAULT_INTERRUPT_OVERRUN));
    EXPECT_EQ(check(sample), 0);
    EXPECT_EQ(check(missed), 0);
    EXPECT_EQ(check(missed), 0);
    EXPECT_EQ(check(sample), 0);
    missed.missed_interrupts = 3;
    EXPECT_EQ(check(missed), FAULT_BIT(FAULT_INTERRUPT_OVERRUN));
}

TEST_F(Protection, all_failed_checks_are_reported_together_in_every_combination) {
    for (unsigned mask = 0; mask < 64; mask++) {
        protection_reset(&protection, healthy.angle);
        protection_sample_t sample = healthy;
        sample.angle += 10;
        uint16_t expected = 0;
        const auto fails = [&](unsigned bit, fault_t fault) {
            if ((mask >> bit & 1u) != 0) {
                expected |= FAULT_BIT(fault);
                return true;
            }
            return false;
        };
        if (fails(0, FAULT_OVER_CURRENT)) {
            sample.current_max_q9 = 76 << 9;
        }
        if (fails(1, mask % 3 == 0 ? FAULT_OVER_VOLTAGE : FAULT_UNDER_VOLTAGE)) {
            sample.bus_voltage_q6 = mask % 3 == 0 ? 310 << 6 : 140 << 6;
        }
        if (fails(2, FAULT_OVER_SPEED)) {
            sample.speed_q22 = -(400 << 22);
        }
        if (fails(3, FAULT_ENCODER)) {
            sample.angle += 1u << 30;
        }
        if (fails(4, FAULT_COMMAND_TIMEOUT)) {
            sample.command_age_us = UINT32_MAX;
        }
        if (fails(5, FAULT_INTERRUPT_OVERRUN)) {
            sample.missed_interrupts = 5;
        }
        EXPECT_EQ(check(sample), expected) << mask;
    }
}

} // namespace
