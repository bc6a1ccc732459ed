// Each check at its limit, and all combinations. [SR-39]
#include <cmath>
#include <cstdint>
#include <random>
#include <utility>

#include <gtest/gtest.h>

extern "C" {
#include "hal_pwm.h"
#include "monitors/protection.h"
#include "storage/fault.h"
}

namespace {

constexpr uint32_t ANGLE_STEP_MAX = 1000000;
constexpr uint32_t UNDETECTED_TRAVEL_MAX = 3000000;
constexpr int32_t DECELERATION_MAX_Q22 = 209715; // 40 N m on 0.02 kg m^2 in 25 us: 0.05 rad/s
const protection_parameters_t PARAMETERS = {
    .current_trip_q9 = 75 << 9,
    .dc_link_over_voltage_q6 = 300 << 6,
    .dc_link_under_voltage_q6 = 150 << 6,
    .angle_step_max = ANGLE_STEP_MAX,
    .undetected_travel_max = UNDETECTED_TRAVEL_MAX,
    .angle_step_q32 = 17089134,
    .deceleration_max_q22 = DECELERATION_MAX_Q22,
    .command_timeout_us = 100000,
};

// Values of one period for all checks.
struct input_t {
    int32_t current_max_q9, dc_link_voltage_q6, speed_q22;
    uint32_t encoder_angle, missed_interrupts, command_age_us;
    uint32_t skipped_deferred = 0, periods = 1, break_causes = 0;
};

struct checks_t {
    protection_t immediate;
    protection_deferred_t deferred;

    void reset(uint32_t encoder_angle) {
        protection_reset(&immediate, encoder_angle);
        protection_deferred_reset(&deferred, encoder_angle);
    }

    uint64_t check_immediate(const input_t &input) {
        const protection_input_t values = {
            .current_max_q9 = input.current_max_q9,
            .dc_link_voltage_q6 = input.dc_link_voltage_q6,
            .encoder_angle = input.encoder_angle,
            .missed_interrupts = input.missed_interrupts,
            .break_causes = input.break_causes,
            .skipped_deferred = input.skipped_deferred,
        };
        return protection_check(&PARAMETERS, &immediate, &values);
    }

    uint64_t check_deferred(const input_t &input) {
        const protection_deferred_input_t values = {
            .dc_link_voltage_q6 = input.dc_link_voltage_q6,
            .speed_q22 = input.speed_q22,
            .encoder_angle = input.encoder_angle,
            .command_age_us = input.command_age_us,
            .periods = input.periods,
        };
        return protection_check_deferred(&PARAMETERS, &deferred, &values);
    }

    // Failed checks of both, one after the other.
    uint64_t check(const input_t &input) { return check_immediate(input) | check_deferred(input); }
};

class Protection : public testing::Test {
  protected:
    Protection() { checks.reset(healthy.encoder_angle); }

    uint64_t check(const input_t &input) { return checks.check(input); }

    // Two counts of a rotor that turns at a speed.
    void turn(input_t &input, int32_t speed_q22) {
        input.speed_q22 = speed_q22;
        for (int count = 0; count < 2; count++) {
            input.encoder_angle++;
            ASSERT_EQ(check(input), 0);
        }
    }

    const input_t healthy = {
        .current_max_q9 = 0,
        .dc_link_voltage_q6 = 240 << 6,
        .speed_q22 = 0,
        .encoder_angle = 5000,
        .missed_interrupts = 0,
        .command_age_us = 0,
    };
    checks_t checks{};
};

// [SR-05] [SR-15]
TEST_F(Protection, under_voltage_and_command_are_checked_in_the_deferred_step_and_the_others_in_the_interrupt) {
    input_t input = healthy;
    input.current_max_q9 = 76 << 9;
    input.dc_link_voltage_q6 = 310 << 6;
    input.encoder_angle += 1u << 30;
    input.command_age_us = UINT32_MAX;
    input.break_causes = HAL_PWM_BREAK_NOT_RENEWED | HAL_PWM_BREAK_OVER_CURRENT | HAL_PWM_BREAK_STO_1;
    EXPECT_EQ(checks.check_immediate(input), FAULT_BIT(FAULT_OVER_CURRENT) | FAULT_BIT(FAULT_OVER_VOLTAGE) |
                                                 FAULT_BIT(FAULT_ENCODER) | FAULT_BIT(FAULT_INTERRUPT_OVERRUN) |
                                                 FAULT_BIT(FAULT_HARDWARE_OVER_CURRENT) | FAULT_BIT(FAULT_STO));
    EXPECT_EQ(checks.check_deferred(input), FAULT_BIT(FAULT_COMMAND_TIMEOUT));
    input.dc_link_voltage_q6 = 140 << 6;
    input.encoder_angle++; // not a frozen encoder
    EXPECT_EQ(checks.check_deferred(input), FAULT_BIT(FAULT_UNDER_VOLTAGE) | FAULT_BIT(FAULT_COMMAND_TIMEOUT));
}

// [SR-46]
TEST_F(Protection, eight_periods_without_a_deferred_step_are_an_overrun) {
    input_t input = healthy;
    input.skipped_deferred = PROTECTION_SKIPPED_DEFERRED_MAX - 1;
    EXPECT_EQ(check(input), 0);
    input.skipped_deferred++;
    EXPECT_EQ(check(input), FAULT_BIT(FAULT_INTERRUPT_OVERRUN));
    input.skipped_deferred = UINT32_MAX;
    EXPECT_EQ(check(input), FAULT_BIT(FAULT_INTERRUPT_OVERRUN));
    input.skipped_deferred = 0;
    EXPECT_EQ(check(input), 0);
}

// [SR-20]
TEST_F(Protection, a_frozen_encoder_is_detected_after_the_same_travel_when_periods_are_skipped) {
    for (const int32_t speed_rad_s : {10, 60, 300}) {
        int detected[3] = {};
        int n = 0;
        for (const uint32_t periods : {1u, 2u, 5u}) {
            checks.reset(healthy.encoder_angle);
            input_t input = healthy;
            turn(input, speed_rad_s << 22);
            input.speed_q22 = 0; // the observer follows the encoder
            input.periods = periods;
            while (detected[n] < 2000 && checks.check_deferred(input) == 0) {
                detected[n] += int(periods);
            }
            n++;
        }
        EXPECT_LT(detected[0], 2000);
        EXPECT_NEAR(detected[1], detected[0], 2 + detected[0] / 20) << speed_rad_s;
        EXPECT_NEAR(detected[2], detected[0], 5 + detected[0] / 10) << speed_rad_s;
    }
}

// [SR-20] [SR-46]
TEST_F(Protection, any_number_of_skipped_periods_overflows_nothing) {
    input_t input = healthy;
    turn(input, INT32_MAX);
    for (const uint32_t periods : {16u, 17u, UINT32_MAX}) {
        input.periods = periods;
        for (int k = 0; k < 100; k++) {
            check(input);
            ASSERT_GE(checks.deferred.undetected_travel, 0);
        }
    }
    EXPECT_EQ(check(input), FAULT_BIT(FAULT_ENCODER));
}

// [SR-20] [SR-46]
TEST_F(Protection, more_than_eight_periods_without_a_deferred_step_count_as_eight) {
    for (const uint32_t periods : {9u, 1000u, UINT32_MAX}) {
        protection_deferred_t after[2];
        for (const bool more : {false, true}) {
            checks.reset(healthy.encoder_angle);
            input_t input = healthy;
            turn(input, 10 << 22);
            input.periods = more ? periods : PROTECTION_SKIPPED_DEFERRED_MAX;
            EXPECT_EQ(checks.check_deferred(input), 0u) << periods;
            after[more] = checks.deferred;
        }
        EXPECT_EQ(after[1].speed_lower_bound_q22, after[0].speed_lower_bound_q22) << periods;
        EXPECT_EQ(after[1].undetected_travel, after[0].undetected_travel) << periods;
    }
}

// [SR-30]
TEST_F(Protection, no_check_fails_in_a_healthy_drive) {
    for (int k = 0; k < 1000; k++) {
        ASSERT_EQ(check(healthy), 0);
    }
}

// [SR-11]
TEST_F(Protection, a_current_above_the_trip_is_an_over_current) {
    input_t input = healthy;
    input.current_max_q9 = 75 << 9;
    EXPECT_EQ(check(input), 0);
    input.current_max_q9++;
    EXPECT_EQ(check(input), FAULT_BIT(FAULT_OVER_CURRENT));
}

// [SR-13] [SR-15]
TEST_F(Protection, a_voltage_beyond_its_limit_is_an_over_or_under_voltage) {
    input_t input = healthy;
    input.dc_link_voltage_q6 = 300 << 6;
    EXPECT_EQ(check(input), 0);
    input.dc_link_voltage_q6++;
    EXPECT_EQ(check(input), FAULT_BIT(FAULT_OVER_VOLTAGE));
    input.dc_link_voltage_q6 = 150 << 6;
    EXPECT_EQ(check(input), 0);
    input.dc_link_voltage_q6--;
    EXPECT_EQ(check(input), FAULT_BIT(FAULT_UNDER_VOLTAGE));
}

// [SR-19]
TEST_F(Protection, an_encoder_step_above_the_limit_per_period_is_a_fault) {
    input_t input = healthy;
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

// [SR-19]
TEST_F(Protection, a_wrap_of_the_angle_is_no_jump) {
    input_t input = healthy;
    input.encoder_angle = 10;
    checks.reset(0xFFFFFFF0u);
    EXPECT_EQ(check(input), 0);
    input.encoder_angle = 0xFFFFFFF0u;
    EXPECT_EQ(check(input), 0);
}

// [SR-19]
TEST_F(Protection, the_limit_of_an_encoder_step_scales_with_the_lost_periods) {
    input_t input = healthy;
    input.missed_interrupts = 2;
    input.encoder_angle += 3 * ANGLE_STEP_MAX;
    EXPECT_EQ(check(input), 0);
    input.missed_interrupts = 0;
    EXPECT_EQ(check(input), 0);
    input.missed_interrupts = 2;
    input.encoder_angle += 3 * ANGLE_STEP_MAX + 1;
    EXPECT_EQ(check(input), FAULT_BIT(FAULT_ENCODER));
}

// [SR-20]
TEST_F(Protection, a_frozen_encoder_is_detected_although_the_observer_follows_it_to_standstill) {
    // At constant deceleration from v the rotor travels v^2 / 2a: 4.1 rad/s is within the limit, 4.5 rad/s beyond it.
    for (const int32_t sign : {1, -1}) {
        for (const auto &[speed_rad_s, fails] : {std::pair{4.1, false}, std::pair{4.5, true}, std::pair{60.0, true}}) {
            checks.reset(healthy.encoder_angle);
            input_t input = healthy;
            turn(input, sign * int32_t(speed_rad_s * (1 << 22)));
            input.speed_q22 = 0;
            bool failed = false;
            for (int k = 0; k < 2000; k++) {
                failed |= check(input) != 0;
            }
            EXPECT_EQ(failed, fails) << speed_rad_s;
            EXPECT_EQ(check(input) != 0, fails) << "until it counts, though the rotor may be at standstill by then";
            input.encoder_angle++;
            EXPECT_EQ(check(input), 0);
        }
    }
}

// [SR-20]
TEST_F(Protection, what_the_observer_makes_of_one_count_after_rest_is_no_speed_and_of_a_second_one_is) {
    input_t input = healthy;
    input.encoder_angle++;
    input.speed_q22 = 60 << 22;
    for (int k = 0; k < 2000; k++) {
        ASSERT_EQ(check(input), 0) << k;
    }
    input.encoder_angle++;
    ASSERT_EQ(check(input), 0);
    int periods = 1;
    while (periods < 2000 && check(input) == 0) {
        periods++;
    }
    EXPECT_GT(periods, 2);
    EXPECT_LT(periods, 1000);
}

// [SR-20]
TEST_F(Protection, an_encoder_is_frozen_when_the_travel_of_the_slowest_possible_rotor_exceeds_the_limit) {
    for (const int32_t sign : {1, -1}) {
        checks.reset(healthy.encoder_angle);
        input_t input = healthy;
        turn(input, sign * (10 << 22));
        double speed_q22 = 10 << 22, travel = 0;
        int periods = 0;
        while (travel <= UNDETECTED_TRAVEL_MAX) {
            speed_q22 -= PARAMETERS.deceleration_max_q22;
            travel += std::floor(std::ldexp(speed_q22 * PARAMETERS.angle_step_q32, -32));
            periods++;
        }
        ASSERT_GT(periods, 10);
        for (int k = 1; k < periods; k++) {
            ASSERT_EQ(check(input), 0) << k;
        }
        EXPECT_EQ(check(input), FAULT_BIT(FAULT_ENCODER));
        EXPECT_EQ(check(input), FAULT_BIT(FAULT_ENCODER)) << "for as long as it lasts";
        input.encoder_angle++;
        EXPECT_EQ(check(input), 0) << "a count proves a rotation";
    }
}

// [SR-20]
TEST_F(Protection, a_rotor_that_is_only_predicted_to_leave_standstill_is_no_evidence) {
    input_t input = healthy;
    input.speed_q22 = 100 << 22; // a locked rotor under torque, by the observer
    for (int k = 0; k < 2000; k++) {
        ASSERT_EQ(check(input), 0);
    }
}

// [SR-20]
TEST_F(Protection, a_constant_encoder_angle_is_no_fault_at_standstill) {
    input_t input = healthy;
    input.speed_q22 = (1 << 22) - 1;
    for (int k = 0; k < 200000; k++) {
        ASSERT_EQ(check(input), 0);
    }
    EXPECT_EQ(checks.deferred.undetected_travel, 0);
}

// [SR-19] [SR-20]
TEST_F(Protection, mirrored_random_motion_gives_the_same_fault_masks) {
    std::mt19937 random(11);
    checks_t mirrored{};
    input_t input = healthy, mirror = healthy;
    mirrored.reset(healthy.encoder_angle);
    unsigned encoder = 0;
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
        const uint64_t failed = check(input);
        ASSERT_EQ(mirrored.check(mirror), failed) << k;
        ASSERT_EQ(mirrored.deferred.undetected_travel, checks.deferred.undetected_travel) << k;
        encoder += (failed & FAULT_BIT(FAULT_ENCODER)) != 0;
    }
    EXPECT_GT(encoder, 1000u);
    EXPECT_LT(encoder, 50000u);
}

// [SR-20]
TEST_F(Protection, a_reversal_within_one_count_is_no_frozen_encoder) {
    input_t input = healthy;
    // From 50 rad/s to -50 rad/s in 2000 periods, the count is constant while the speed is below 2 rad/s.
    for (int k = -1000; k <= 1000; k++) {
        input.speed_q22 = -k * ((50 << 22) / 1000);
        if (k < -40 || k > 40) {
            input.encoder_angle += input.speed_q22 > 0 ? 100 : -100;
        }
        ASSERT_EQ(check(input), 0) << k;
    }
}

// [SR-20]
TEST_F(Protection, the_undetected_travel_of_a_permanently_frozen_encoder_does_not_overflow) {
    input_t input = healthy;
    turn(input, INT32_MAX);
    for (int k = 0; k < 1000; k++) {
        check(input);
        ASSERT_GE(checks.deferred.undetected_travel, 0);
    }
    EXPECT_EQ(check(input), FAULT_BIT(FAULT_ENCODER));
}

// [SR-05]
TEST_F(Protection, a_command_older_than_the_timeout_is_a_fault) {
    input_t input = healthy;
    input.command_age_us = 100000;
    EXPECT_EQ(check(input), 0);
    input.command_age_us++;
    EXPECT_EQ(check(input), FAULT_BIT(FAULT_COMMAND_TIMEOUT));
}

// [SR-46]
TEST_F(Protection, three_consecutive_lost_interrupts_are_an_overrun_and_a_period_in_time_resets_the_count) {
    input_t input = healthy, missed = healthy;
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

// [SR-19]
TEST_F(Protection, a_jump_of_the_encoder_over_lost_interrupts_that_are_a_fault_is_no_fault_of_the_encoder) {
    for (const uint32_t missed : {3u, 15u, 400u, UINT32_MAX}) {
        checks.reset(healthy.encoder_angle);
        input_t input = healthy;
        input.missed_interrupts = missed;
        input.encoder_angle += 1u << 30;
        EXPECT_EQ(check(input), FAULT_BIT(FAULT_INTERRUPT_OVERRUN));
    }
}

// [SR-02] [SR-11] [SR-12] [SR-13] [SR-19] [SR-46]
TEST_F(Protection, every_combination_of_failed_checks_is_reported) {
    for (unsigned mask = 0; mask < 32; mask++) {
        checks.reset(healthy.encoder_angle);
        input_t input = healthy;
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
        if (fails(2, FAULT_ENCODER)) {
            input.encoder_angle += 1u << 30;
        }
        if (fails(3, FAULT_COMMAND_TIMEOUT)) {
            input.command_age_us = UINT32_MAX;
        }
        if (fails(4, FAULT_INTERRUPT_OVERRUN)) {
            input.break_causes = HAL_PWM_BREAK_NOT_RENEWED;
        }
        EXPECT_EQ(check(input), expected) << mask;
    }
}

// [SR-20]
TEST(ProtectionStandstill, an_encoder_that_does_not_count_is_a_fault_from_1_rad_s_on_and_none_below) {
    protection_parameters_t parameters = PARAMETERS;
    parameters.deceleration_max_q22 = 0;
    for (const int32_t sign : {1, -1}) {
        for (const int32_t speed_q22 : {(1 << 22) - 1, 1 << 22}) {
            protection_deferred_t state;
            protection_deferred_reset(&state, 5000);
            protection_deferred_input_t input = {
                .dc_link_voltage_q6 = 240 << 6,
                .speed_q22 = sign * speed_q22,
                .encoder_angle = 5000,
                .command_age_us = 0,
                .periods = 1,
            };
            uint64_t failed = 0;
            for (int period = 0; period < 1000; period++) {
                input.encoder_angle += period < 2 ? 1u : 0u;
                failed |= protection_check_deferred(&parameters, &state, &input);
            }
            EXPECT_EQ(failed, speed_q22 == 1 << 22 ? FAULT_BIT(FAULT_ENCODER) : 0u) << sign * speed_q22;
        }
    }
}

} // namespace
