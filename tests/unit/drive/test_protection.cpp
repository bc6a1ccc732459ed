// Each check at its limit, and all combinations.
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
constexpr uint32_t UNDETECTED_TRAVEL_MAX = 3000000;
constexpr int32_t DECELERATION_MAX_Q22 = 209715; // 40 N m on 0.02 kg m^2 in 25 us: 0.05 rad/s
const protection_parameters_t PARAMETERS = {
    .current_trip_q9 = 75 << 9,
    .dc_link_over_voltage_q6 = 300 << 6,
    .dc_link_under_voltage_q6 = 150 << 6,
    .over_speed_q22 = 377 << 22,
    .angle_step_max = ANGLE_STEP_MAX,
    .undetected_travel_max = UNDETECTED_TRAVEL_MAX,
    .angle_step_q32 = 17089134,
    .deceleration_max_q22 = DECELERATION_MAX_Q22,
    .command_timeout_us = 100000,
};

class Protection : public testing::Test {
  protected:
    Protection() { protection_reset(&protection, healthy.encoder_angle); }

    uint64_t check(const protection_input_t &input) { return protection_check(&PARAMETERS, &protection, &input); }

    const protection_input_t healthy = {
        .current_max_q9 = 0,
        .dc_link_voltage_q6 = 240 << 6,
        .speed_q22 = 0,
        .encoder_angle = 5000,
        .missed_interrupts = 0,
        .command_age_us = 0,
    };
    protection_t protection{};
};

TEST_F(Protection, no_check_fails_in_a_healthy_drive) {
    for (int k = 0; k < 1000; k++) {
        ASSERT_EQ(check(healthy), 0);
    }
}

TEST_F(Protection, a_current_above_the_trip_is_an_over_current) {
    protection_input_t input = healthy;
    input.current_max_q9 = 75 << 9;
    EXPECT_EQ(check(input), 0);
    input.current_max_q9++;
    EXPECT_EQ(check(input), FAULT_BIT(FAULT_OVER_CURRENT));
}

TEST_F(Protection, a_voltage_beyond_its_limit_is_an_over_or_under_voltage) {
    protection_input_t input = healthy;
    input.dc_link_voltage_q6 = 300 << 6;
    EXPECT_EQ(check(input), 0);
    input.dc_link_voltage_q6++;
    EXPECT_EQ(check(input), FAULT_BIT(FAULT_OVER_VOLTAGE));
    input.dc_link_voltage_q6 = 150 << 6;
    EXPECT_EQ(check(input), 0);
    input.dc_link_voltage_q6--;
    EXPECT_EQ(check(input), FAULT_BIT(FAULT_UNDER_VOLTAGE));
}

TEST_F(Protection, over_speed_is_detected_in_both_directions) {
    protection_input_t input = healthy;
    for (const int32_t sign : {1, -1}) {
        input.encoder_angle += 10; // not a frozen encoder
        input.speed_q22 = sign * (377 << 22);
        EXPECT_EQ(check(input), 0);
        input.encoder_angle += 10;
        input.speed_q22 += sign;
        EXPECT_EQ(check(input), FAULT_BIT(FAULT_OVER_SPEED));
    }
    input.encoder_angle += 10;
    input.speed_q22 = INT32_MIN;
    EXPECT_EQ(check(input), FAULT_BIT(FAULT_OVER_SPEED));
}

TEST_F(Protection, an_encoder_step_above_the_limit_per_period_is_a_fault) {
    protection_input_t input = healthy;
    for (const uint32_t step : {ANGLE_STEP_MAX, -ANGLE_STEP_MAX}) {
        input.encoder_angle += step;
        EXPECT_EQ(check(input), 0);
    }
    for (const uint32_t step : {ANGLE_STEP_MAX + 1, -ANGLE_STEP_MAX - 1, 0x80000000u}) {
        input.encoder_angle += step;
        EXPECT_EQ(check(input), FAULT_BIT(FAULT_ENCODER)) << step;
        EXPECT_EQ(check(input), 0) << "it is reported once";
    }
}

TEST_F(Protection, a_wrap_of_the_angle_is_no_jump) {
    protection_input_t input = healthy;
    input.encoder_angle = 10;
    protection_reset(&protection, 0xFFFFFFF0u);
    EXPECT_EQ(check(input), 0);
    input.encoder_angle = 0xFFFFFFF0u;
    EXPECT_EQ(check(input), 0);
}

TEST_F(Protection, the_limit_of_an_encoder_step_scales_with_the_lost_periods) {
    protection_input_t input = healthy;
    input.missed_interrupts = 2;
    input.encoder_angle += 3 * ANGLE_STEP_MAX;
    EXPECT_EQ(check(input), 0);
    input.missed_interrupts = 0;
    EXPECT_EQ(check(input), 0);
    input.missed_interrupts = 2;
    input.encoder_angle += 3 * ANGLE_STEP_MAX + 1;
    EXPECT_EQ(check(input), FAULT_BIT(FAULT_ENCODER));
}

TEST_F(Protection, a_frozen_encoder_is_detected_although_the_observer_follows_it_to_standstill) {
    // At constant deceleration from v the rotor travels v^2 / 2a: 4.1 rad/s is within the limit, 4.5 rad/s beyond it.
    for (const int32_t sign : {1, -1}) {
        for (const auto &[speed_rad_s, fails] : {std::pair{4.1, false}, std::pair{4.5, true}, std::pair{60.0, true}}) {
            protection_reset(&protection, healthy.encoder_angle);
            protection_input_t input = healthy;
            input.encoder_angle++;
            input.speed_q22 = sign * int32_t(speed_rad_s * (1 << 22));
            ASSERT_EQ(check(input), 0);
            input.speed_q22 = 0;
            bool failed = false;
            for (int k = 0; k < 2000; k++) {
                failed |= check(input) != 0;
            }
            EXPECT_EQ(failed, fails) << speed_rad_s;
            EXPECT_EQ(check(input), 0) << "by then the rotor may be at standstill";
        }
    }
}

TEST_F(Protection, an_encoder_is_frozen_when_the_expected_travel_exceeds_the_limit) {
    for (const int32_t sign : {1, -1}) {
        protection_reset(&protection, healthy.encoder_angle);
        protection_input_t input = healthy;
        input.speed_q22 = sign * (10 << 22);
        const double moved_a_period = std::ldexp(double(10 << 22) * PARAMETERS.angle_step_q32, -32);
        const int periods = int(std::floor((UNDETECTED_TRAVEL_MAX + 1) / moved_a_period));
        ASSERT_GT(periods, 10);
        for (int k = 0; k < periods; k++) {
            ASSERT_EQ(check(input), 0) << k;
        }
        EXPECT_EQ(check(input), FAULT_BIT(FAULT_ENCODER));
        EXPECT_EQ(check(input), FAULT_BIT(FAULT_ENCODER)) << "for as long as it lasts";
        input.encoder_angle++;
        EXPECT_EQ(check(input), 0) << "a count proves a rotation";
    }
}

TEST_F(Protection, a_constant_encoder_angle_is_no_fault_at_standstill) {
    protection_input_t input = healthy;
    input.speed_q22 = (1 << 22) - 1;
    for (int k = 0; k < 200000; k++) {
        ASSERT_EQ(check(input), 0);
    }
    EXPECT_EQ(protection.undetected_travel, 0);
}

TEST_F(Protection, mirrored_random_motion_gives_the_same_fault_masks) {
    std::mt19937 random(11);
    protection_t mirrored{};
    protection_input_t input = healthy, mirror = healthy;
    protection_reset(&mirrored, healthy.encoder_angle);
    unsigned over_speed = 0, encoder = 0;
    for (int k = 0; k < 200000; k++) {
        // Often at standstill, occasionally beyond a limit.
        const uint32_t step = random() % 4 == 0 ? random() % (ANGLE_STEP_MAX + 50) : 0;
        input.encoder_angle += step;
        mirror.encoder_angle -= step;
        if (k % 50 == 0) {
            const uint32_t fastest_rad_s = random() % 20 == 0 ? 400 : 10;
            input.speed_q22 = int32_t(random() % (fastest_rad_s << 22));
            mirror.speed_q22 = -input.speed_q22;
        }
        const uint64_t checks = check(input);
        ASSERT_EQ(protection_check(&PARAMETERS, &mirrored, &mirror), checks) << k;
        ASSERT_EQ(mirrored.undetected_travel, protection.undetected_travel) << k;
        over_speed += (checks & FAULT_BIT(FAULT_OVER_SPEED)) != 0;
        encoder += (checks & FAULT_BIT(FAULT_ENCODER)) != 0;
    }
    EXPECT_GT(over_speed, 10u);
    EXPECT_LT(over_speed, 1000u);
    EXPECT_GT(encoder, 1000u);
    EXPECT_LT(encoder, 50000u);
}

TEST_F(Protection, a_reversal_within_one_count_is_no_frozen_encoder) {
    protection_input_t input = healthy;
    // From 50 rad/s to -50 rad/s in 2000 periods, the count is constant while the speed is below 2 rad/s.
    for (int k = -1000; k <= 1000; k++) {
        input.speed_q22 = -k * ((50 << 22) / 1000);
        if (k < -40 || k > 40) {
            input.encoder_angle += input.speed_q22 > 0 ? 100 : -100;
        }
        ASSERT_EQ(check(input), 0) << k;
    }
}

TEST_F(Protection, the_undetected_travel_of_a_permanently_frozen_encoder_does_not_overflow) {
    protection_input_t input = healthy;
    input.speed_q22 = INT32_MAX;
    for (int k = 0; k < 1000; k++) {
        check(input);
        ASSERT_GE(protection.undetected_travel, 0);
    }
    EXPECT_EQ(check(input), FAULT_BIT(FAULT_ENCODER) | FAULT_BIT(FAULT_OVER_SPEED));
}

TEST_F(Protection, a_command_older_than_the_timeout_is_a_fault) {
    protection_input_t input = healthy;
    input.command_age_us = 100000;
    EXPECT_EQ(check(input), 0);
    input.command_age_us++;
    EXPECT_EQ(check(input), FAULT_BIT(FAULT_COMMAND_TIMEOUT));
}

TEST_F(Protection, three_consecutive_lost_interrupts_are_an_overrun_and_a_period_in_time_resets_the_count) {
    protection_input_t input = healthy, missed = healthy;
    missed.missed_interrupts = 1;
    EXPECT_EQ(check(missed), 0);
    EXPECT_EQ(check(missed), 0);
    EXPECT_EQ(check(missed), FAULT_BIT(FAULT_INTERRUPT_OVERRUN));
    EXPECT_EQ(check(missed), FAULT_BIT(FAULT_INTERRUPT_OVERRUN));
    EXPECT_EQ(check(input), 0);
    EXPECT_EQ(check(missed), 0);
    EXPECT_EQ(check(missed), 0);
    EXPECT_EQ(check(input), 0);
    missed.missed_interrupts = 3;
    EXPECT_EQ(check(missed), FAULT_BIT(FAULT_INTERRUPT_OVERRUN));
}

TEST_F(Protection, every_combination_of_failed_checks_is_reported) {
    for (unsigned mask = 0; mask < 64; mask++) {
        protection_reset(&protection, healthy.encoder_angle);
        protection_input_t input = healthy;
        input.encoder_angle += 10;
        uint64_t expected = 0;
        const auto fails = [&](unsigned bit, fault_t fault) {
            if ((mask >> bit & 1u) != 0) {
                expected |= FAULT_BIT(fault);
                return true;
            }
            return false;
        };
        if (fails(0, FAULT_OVER_CURRENT)) {
            input.current_max_q9 = 76 << 9;
        }
        if (fails(1, mask % 3 == 0 ? FAULT_OVER_VOLTAGE : FAULT_UNDER_VOLTAGE)) {
            input.dc_link_voltage_q6 = mask % 3 == 0 ? 310 << 6 : 140 << 6;
        }
        if (fails(2, FAULT_OVER_SPEED)) {
            input.speed_q22 = -(400 << 22);
        }
        if (fails(3, FAULT_ENCODER)) {
            input.encoder_angle += 1u << 30;
        }
        if (fails(4, FAULT_COMMAND_TIMEOUT)) {
            input.command_age_us = UINT32_MAX;
        }
        if (fails(5, FAULT_INTERRUPT_OVERRUN)) {
            input.missed_interrupts = 5;
        }
        EXPECT_EQ(check(input), expected) << mask;
    }
}

} // namespace
