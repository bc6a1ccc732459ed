// [SR-24]
#include <cmath>

#include <gtest/gtest.h>

extern "C" {
#include "control/machine_tables.h"
#include "monitors/stall_monitor.h"
}

namespace {

constexpr uint32_t START_US = UINT32_MAX - 50000; // the clock wraps during the tests
constexpr int32_t RAD_S = 1 << 22, NM = 1 << 24;

class Stall : public testing::Test {
  protected:
    // Time from the first input to the fault, or 0 when there is none in `length_us`; one input each millisecond.
    template <typename Change> uint32_t time_to_fault_us(uint32_t length_us, Change change) {
        stall_monitor_t monitor = {};
        const stall_input_t off = {};
        EXPECT_FALSE(stall_monitor_failed(&monitor, &off, START_US - 1000));
        for (uint32_t us = 0; us <= length_us; us += 1000) {
            change(us);
            input.electrical += turned_in_1_ms(input.speed_q22);
            if (stall_monitor_failed(&monitor, &input, START_US + us)) {
                return us;
            }
        }
        return 0;
    }
    // 2^-32 electrical rev.
    static uint32_t turned_in_1_ms(int32_t speed_q22) {
        const double turned = speed_q22 * 0.001 / RAD_S * machine_tables.rotor_poles / (2 * M_PI);
        return static_cast<uint32_t>(static_cast<int64_t>(turned * 4294967296.0));
    }
    uint32_t time_to_fault_us() {
        return time_to_fault_us(1000000, [](uint32_t) {});
    }

    stall_input_t input = {
        .speed_mode = true,
        .speed_reference_q22 = 60 * RAD_S,
        .speed_q22 = 0,
        .torque_reference_q24 = 19 * NM,
        .torque_min_q24 = -19 * NM,
        .torque_max_q24 = 19 * NM,
    };
};

TEST_F(Stall, rotor_at_standstill_is_stalled_after_100_ms_in_both_directions) {
    EXPECT_EQ(time_to_fault_us(), 101000u);
    input.speed_reference_q22 = -60 * RAD_S;
    input.torque_reference_q24 = -19 * NM;
    EXPECT_EQ(time_to_fault_us(), 101000u);
}

TEST_F(Stall, torque_at_the_limit_of_the_reference_s_own_direction_is_in_vain_and_at_the_other_one_s_is_not) {
    for (const int direction : {1, -1}) {
        input.speed_reference_q22 = direction * 60 * RAD_S;
        input.torque_max_q24 = direction > 0 ? 6 * NM : 19 * NM;
        input.torque_min_q24 = direction > 0 ? -19 * NM : -6 * NM;
        input.torque_reference_q24 = direction * 6 * NM;
        EXPECT_EQ(time_to_fault_us(), 101000u) << direction;
        input.torque_max_q24 = direction > 0 ? 19 * NM : 6 * NM;
        input.torque_min_q24 = direction > 0 ? -6 * NM : -19 * NM;
        EXPECT_EQ(time_to_fault_us(), 0u) << direction;
    }
}

TEST_F(Stall, rotor_that_the_load_turns_the_other_way_is_stalled) {
    input.speed_q22 = -20 * RAD_S;
    EXPECT_EQ(time_to_fault_us(), 101000u);
}

TEST_F(Stall, rotor_that_the_load_drives_backwards_faster_and_faster_is_not_stalled) {
    EXPECT_EQ(time_to_fault_us(
                  1000000,
                  [this](uint32_t us) { input.speed_q22 = -static_cast<int32_t>(int64_t{20} * RAD_S * us / 1000000); }),
              0u);
}

// Before the reversal it accelerates at the limit: the range of the speeds, in the direction of the reference, is then
// that on the other side of standstill.
TEST_F(Stall, rotor_that_reverses_while_it_accelerates_is_not_stalled_and_one_that_then_stands_is) {
    const auto reverses = [this](uint32_t us, uint32_t stops_us) {
        const bool back = us >= 100000;
        input.speed_reference_q22 = back ? -60 * RAD_S : 60 * RAD_S;
        input.torque_reference_q24 = back ? -19 * NM : 19 * NM;
        const int64_t way_us = us < stops_us ? us : stops_us;
        input.speed_q22 = static_cast<int32_t>((back ? 200000 - way_us : way_us) * 29 / 100 * RAD_S / 1000);
    };
    EXPECT_EQ(time_to_fault_us(380000, [&](uint32_t us) { reverses(us, UINT32_MAX); }), 0u);
    EXPECT_NEAR(time_to_fault_us(380000, [&](uint32_t us) { reverses(us, 150000); }), 250000, 3000);
}

// As by a stop that is withdrawn: the speed would belong to both directions.
TEST_F(Stall, reversing_rotor_whose_reference_is_0_for_some_milliseconds_is_not_stalled) {
    for (const int direction : {1, -1}) {
        input.torque_reference_q24 = direction * 19 * NM;
        const auto reverses = [&](uint32_t us) {
            input.speed_reference_q22 = us >= 30000 && us < 35000 ? 0 : direction * 60 * RAD_S;
            input.speed_q22 = -direction * (25 * RAD_S - static_cast<int32_t>(us / 1000) * (RAD_S / 10));
        };
        EXPECT_EQ(time_to_fault_us(240000, reverses), 0u) << direction;
    }
}

TEST_F(Stall, rotor_that_swings_without_progress_is_stalled) {
    EXPECT_NEAR(time_to_fault_us(
                    1000000, [this](uint32_t us) { input.speed_q22 = us / 1000 % 20 < 10 ? 3 * RAD_S : -3 * RAD_S; }),
                101000, 20000);
}

TEST_F(Stall, rotor_that_swings_faster_than_at_half_of_the_reference_is_stalled_and_one_that_runs_on_so_is_not) {
    const auto speed_q22 = [](uint32_t us) { return us < 10000 ? 0 : us / 1000 % 20 < 10 ? 40 * RAD_S : -40 * RAD_S; };
    EXPECT_EQ(time_to_fault_us(1000000, [&](uint32_t us) { input.speed_q22 = speed_q22(us); }), 121000u);
    const auto once_q22 = [&](uint32_t us) { return speed_q22(us < 20000 ? us : 20000); };
    EXPECT_EQ(time_to_fault_us(1000000, [&](uint32_t us) { input.speed_q22 = once_q22(us); }), 0u);
}

// The amplitude of the swing is in electrical revolutions; the torque is at its limit only at times, as when the speed
// is above the reference within each swing.
TEST_F(Stall,
       rotor_that_swings_between_two_angles_is_stalled_whatever_the_torque_and_one_that_advances_meanwhile_is_not) {
    const auto swings = [this](double amplitude, double advance_per_s) {
        return [=, this](uint32_t us) {
            const double angle_rad = 2 * M_PI / machine_tables.rotor_poles, rate = 2 * M_PI * 20.0, s = us * 1e-6;
            const double speed = angle_rad * (amplitude * rate * std::cos(rate * s) + advance_per_s);
            input.speed_q22 = static_cast<int32_t>(speed * RAD_S);
            input.torque_reference_q24 = us / 1000 % 20 < 5 ? 0 : 19 * NM;
        };
    };
    for (const int direction : {1, -1}) {
        input.speed_reference_q22 = direction * 30 * RAD_S;
        EXPECT_NEAR(time_to_fault_us(1000000, swings(0.3, 0)), 310000, 35000);
        EXPECT_NEAR(time_to_fault_us(1000000, swings(0.45, 0)), 310000, 35000);
        EXPECT_EQ(time_to_fault_us(1000000, swings(0.3, direction * 1.0)), 0u);
        EXPECT_EQ(time_to_fault_us(1000000, swings(0.3, direction * -6.0)), 0u);
    }
    // A slow reference has the time of three strokes more: 4 rad/s turn by three of 30 degrees in 393 ms.
    input.speed_reference_q22 = 4 * RAD_S;
    ASSERT_EQ(machine_tables.rotor_poles * machine_tables.phases, 12);
    EXPECT_NEAR(time_to_fault_us(1000000, swings(0.05, 0)), 630000, 30000);
    input.speed_reference_q22 = 0;
    EXPECT_EQ(time_to_fault_us(1000000, swings(0.3, 0)), 0u);
}

// A reversal, or the start of a rotor that turns backwards, of a large inertia: half a stroke before it stands, and
// after it, takes longer than a swing may. The ripple is the observer's, 0.1 rad/s at 300 Hz.
TEST_F(Stall, rotor_that_comes_to_its_reference_from_the_other_side_is_not_stalled_however_slowly) {
    for (const int direction : {1, -1}) {
        input.speed_reference_q22 = direction * 30 * RAD_S;
        input.torque_reference_q24 = direction * 19 * NM;
        for (const double ripple : {0.0, 0.1}) {
            for (const double rad_s2 : {3.0, 4.0, 5.0, 6.0, 8.0}) {
                const auto comes = [&](uint32_t us) {
                    const double speed = rad_s2 * us * 1e-6 - 30.0 + ripple * std::sin(2 * M_PI * 300.0 * us * 1e-6);
                    input.speed_q22 = static_cast<int32_t>(direction * speed * RAD_S);
                };
                EXPECT_EQ(time_to_fault_us(static_cast<uint32_t>(60e6 / rad_s2), comes), 0u)
                    << direction * rad_s2 << " " << ripple;
            }
        }
    }
}

TEST_F(Stall, rotor_held_within_a_swing_for_long_may_take_its_time_to_follow_a_reference) {
    EXPECT_EQ(time_to_fault_us(5200000,
                               [this](uint32_t us) {
                                   input.speed_reference_q22 = us < 5000000 ? 0 : 60 * RAD_S;
                                   input.torque_reference_q24 = 0;
                                   input.speed_q22 = us / 1000 % 2 == 0 ? RAD_S / 8 : -RAD_S / 8;
                               }),
              0u);
}

TEST_F(Stall, rotor_that_follows_a_reference_which_rises_as_fast_is_not_stalled_and_one_that_stands_is) {
    const auto rising_q22 = [](uint32_t us) { return static_cast<int32_t>(int64_t{300} * RAD_S * us / 300000); };
    const auto both_rise = [&](uint32_t us) {
        input.speed_reference_q22 = 60 * RAD_S + rising_q22(us);
        input.speed_q22 = rising_q22(us) / 4;
    };
    EXPECT_EQ(time_to_fault_us(300000, both_rise), 0u);
    const auto lags_behind = [&](uint32_t us) {
        input.speed_reference_q22 = 200 * RAD_S + rising_q22(us) / 8;
        input.speed_q22 = rising_q22(us) / 8;
    };
    EXPECT_EQ(time_to_fault_us(300000, lags_behind), 0u);
    const auto stands = [&](uint32_t us) { input.speed_reference_q22 = 60 * RAD_S + rising_q22(us); };
    input.speed_q22 = 0;
    EXPECT_EQ(time_to_fault_us(300000, stands), 101000u);
}

TEST_F(Stall, start_of_12_s_is_none) {
    EXPECT_EQ(time_to_fault_us(
                  12000000,
                  [this](uint32_t us) { input.speed_q22 = static_cast<int32_t>(int64_t{60} * RAD_S * us / 12000000); }),
              0u);
}

TEST_F(Stall, without_the_torque_at_its_limit_or_a_large_error_or_a_reference_there_is_none) {
    input.torque_reference_q24 = 17 * NM;
    EXPECT_EQ(time_to_fault_us(), 0u);
    input.torque_reference_q24 = -19 * NM; // against the error
    EXPECT_EQ(time_to_fault_us(), 0u);
    input.torque_reference_q24 = 19 * NM;
    input.speed_q22 = 30 * RAD_S;
    EXPECT_EQ(time_to_fault_us(), 0u);
    input.speed_q22 = -30 * RAD_S;
    input.speed_reference_q22 = 0;
    EXPECT_EQ(time_to_fault_us(), 0u);
}

// At a speed of 0 it does not turn backwards, in either direction of the reference.
TEST_F(Stall, a_rotor_that_stands_with_less_torque_than_the_limit_or_where_there_is_none_is_not_stalled) {
    for (const int direction : {1, -1}) {
        for (const int torque_Nm : {0, 17}) {
            input.speed_reference_q22 = direction * 60 * RAD_S;
            input.torque_reference_q24 = direction * torque_Nm * NM;
            input.torque_max_q24 = torque_Nm == 0 ? 0 : 19 * NM;
            input.torque_min_q24 = -input.torque_max_q24;
            EXPECT_EQ(time_to_fault_us(), 0u) << direction * torque_Nm;
        }
    }
}

TEST_F(Stall, outside_speed_mode_there_is_none) {
    input.speed_mode = false;
    EXPECT_EQ(time_to_fault_us(), 0u);
}

TEST_F(Stall, extremes_saturate) {
    input.speed_reference_q22 = INT32_MIN;
    input.torque_reference_q24 = input.torque_min_q24 = INT32_MIN;
    EXPECT_EQ(time_to_fault_us(), 101000u);
    input.speed_q22 = INT32_MAX; // over-speed
    EXPECT_EQ(time_to_fault_us(), 0u);
}

TEST_F(Stall, rotor_that_stands_without_much_torque_is_not_stalled_when_the_clock_comes_round) {
    input.torque_reference_q24 = 5 * NM;
    stall_monitor_t monitor = {};
    input.speed_q22 = -RAD_S;
    stall_monitor_failed(&monitor, &input, START_US);
    input.speed_q22 = 0;
    constexpr uint32_t STEP_US = 20000;
    for (uint64_t us = 0; us < uint64_t{2} << 32; us += STEP_US) {
        const bool failed = stall_monitor_failed(&monitor, &input, uint32_t(START_US + us));
        ASSERT_FALSE(failed && us > 1000000) << us;
    }
}

// Electrical rev/s to rad/s, Q22.
int32_t electrical_q22(double rev_s) {
    return static_cast<int32_t>(rev_s * 2 * M_PI / machine_tables.rotor_poles * RAD_S);
}

// 0.4 electrical revolutions forwards and back again: within where it has been. The last new angle, by half a stroke, a
// sixth of a revolution each, was at 208 ms; 225 ms and a quarter of that for three strokes of the reference later it
// is stalled.
TEST_F(Stall, rotor_that_comes_back_to_where_it_has_been_makes_no_progress) {
    for (const int direction : {1, -1}) {
        input.speed_reference_q22 = direction * 30 * RAD_S;
        input.torque_reference_q24 = 0;
        EXPECT_NEAR(
            time_to_fault_us(
                520000, [&](uint32_t us) { input.speed_q22 = direction * electrical_q22(us < 250000 ? 1.6 : -1.6); }),
            490000, 10000);
    }
}

TEST_F(Stall, rotor_that_swings_after_it_was_driven_backwards_by_several_revolutions_is_stalled) {
    input.speed_reference_q22 = 30 * RAD_S;
    input.torque_reference_q24 = 0;
    const auto swings = [&](uint32_t us) {
        const double rate = 2 * M_PI * 20.0;
        input.speed_q22 = electrical_q22(us < 1000000 ? -6.0 : 0.3 * rate * std::cos(rate * us * 1e-6));
    };
    EXPECT_NEAR(time_to_fault_us(2000000, swings), 1310000, 50000);
}

TEST_F(Stall, rotor_that_turns_backwards_has_more_time_when_it_becomes_slower_but_not_when_it_stands_for_a_moment) {
    input.speed_reference_q22 = 30 * RAD_S;
    input.torque_reference_q24 = 0;
    for (const auto &[then, fault_us] :
         {std::pair{0.0, 281000.0}, std::pair{-0.2, 281000.0}, std::pair{-0.03, 481000.0}}) {
        const auto turns = [&, then = then](uint32_t us) {
            input.speed_q22 = electrical_q22(us == 200000 ? then : -0.2);
        };
        EXPECT_NEAR(time_to_fault_us(600000, turns), fault_us, 3000) << then;
    }
}

TEST_F(Stall, rotor_that_is_at_its_reference_is_not_stalled_though_it_was_slow_with_the_torque_at_its_limit) {
    for (const int direction : {1, -1}) {
        input.torque_reference_q24 = direction * 19 * NM;
        input.speed_q22 = direction * 25 * RAD_S;
        const auto lowered = [&](uint32_t us) {
            input.speed_reference_q22 = direction * (us < 50000 ? 60 : 25) * RAD_S;
        };
        EXPECT_EQ(time_to_fault_us(1000000, lowered), 0u) << direction;
    }
}

} // namespace
