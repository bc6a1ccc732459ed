// The trim of the torque reference, against the double-precision twin.
#include <algorithm>
#include <cmath>
#include <cstdint>

#include <gtest/gtest.h>

extern "C" {
#include "control/torque_trim.h"
}

#include "support/reference_models.h"

namespace {

constexpr double LIMIT_NM = 3.0;

torque_trim_parameters_t parameters_of(bp_pid_mode_t mode) {
    torque_trim_parameters_t p{};
    p.pid.mode = mode;
    p.pid.seed = 1;
    p.pid.error_scale_inverse_q24 = twins::to_fixed(0.5, twins::Q24); // 2 N m
    p.pid.scale_q28[0] = twins::to_fixed(0.07, twins::Q28);
    p.pid.scale_q28[1] = twins::to_fixed(0.07, twins::Q28);
    p.pid.scale_q28[2] = twins::to_fixed(0.03, twins::Q28);
    p.pid.network = {twins::to_fixed(0.05, twins::Q15), twins::to_fixed(0.05, twins::Q32)};
    p.limit_q24 = twins::to_fixed(LIMIT_NM, twins::Q24);
    return p;
}

twins::trim_t twin_of(const torque_trim_parameters_t &p) {
    twins::trim_t twin{};
    twin.pid.mode = twins::bp_pid_t::FIXED;
    twin.pid.error_scale_inverse = p.pid.error_scale_inverse_q24 / twins::Q24;
    twin.pid.scale = {p.pid.scale_q28[0] / twins::Q28, p.pid.scale_q28[1] / twins::Q28,
                      p.pid.scale_q28[2] / twins::Q28};
    twin.limit_Nm = p.limit_q24 / twins::Q24;
    return twin;
}

TEST(TorqueTrim, follows_its_twin_within_2_mNm_through_a_machine_that_gives_too_little) {
    const torque_trim_parameters_t p = parameters_of(BP_PID_FIXED);
    torque_trim_t trim;
    torque_trim_reset(&p, &trim, 0);
    twins::trim_t twin = twin_of(p);
    double made[2] = {0.0, 0.0}, worst = 0.0;
    for (int k = 0; k < 4000; k++) {
        const double reference = 6.0 + 2.0 * std::sin(k * 0.002);
        const bool hold = k / 500 % 4 == 3;
        const int32_t reference_q24 = twins::to_fixed(reference, twins::Q24);
        const int32_t torque_q24 = twins::to_fixed(made[1], twins::Q24);
        const double out = torque_trim_step(&p, &trim, reference_q24, torque_q24, hold) / twins::Q24;
        const double expected = twin.step(reference_q24 / twins::Q24, torque_q24 / twins::Q24, hold);
        worst = std::max(worst, std::fabs(out - expected));
        made[1] = made[0];
        made[0] = 0.9 * out; // seen two samples later
    }
    EXPECT_LT(worst, 2e-3); // an LSB of the PID's output is 0.09 mN m
    EXPECT_GT(worst, 1e-6);
    // What the machine gives too little is what the trim adds.
    EXPECT_NEAR(trim.trim_q24 / twins::Q24, twin.trim_Nm, 2e-3);
    EXPECT_GT(trim.trim_q24 / twins::Q24, 0.3);
}

TEST(TorqueTrim, a_machine_that_gives_what_was_asked_two_samples_ago_gets_no_trim) {
    const torque_trim_parameters_t p = parameters_of(BP_PID_FIXED);
    torque_trim_t trim;
    torque_trim_reset(&p, &trim, 1 << 24);
    int32_t made[2] = {1 << 24, 1 << 24};
    for (int k = 0; k < 4000; k++) {
        const int32_t reference_q24 = twins::to_fixed(1.0 + 9.0 * std::fabs(std::sin(k * 0.01)), twins::Q24);
        ASSERT_EQ(torque_trim_step(&p, &trim, reference_q24, made[1], false), reference_q24) << k;
        made[1] = made[0];
        made[0] = reference_q24;
    }
}

TEST(TorqueTrim, holds_while_it_is_told_to_and_goes_on_from_there) {
    const torque_trim_parameters_t p = parameters_of(BP_PID_FIXED);
    torque_trim_t trim;
    torque_trim_reset(&p, &trim, 4 << 24);
    for (int k = 0; k < 10; k++) {
        torque_trim_step(&p, &trim, 4 << 24, 3 << 24, false);
    }
    const int32_t held_q24 = trim.trim_q24;
    EXPECT_GT(held_q24, 0);
    for (int k = 0; k < 100; k++) {
        EXPECT_EQ(torque_trim_step(&p, &trim, 4 << 24, 3 << 24, true), (4 << 24) + held_q24);
    }
    torque_trim_step(&p, &trim, 4 << 24, 3 << 24, false);
    EXPECT_GT(trim.trim_q24, held_q24);
    EXPECT_LT(trim.trim_q24, held_q24 + held_q24 / 5);
}

TEST(TorqueTrim, stays_within_its_limit_and_the_sum_saturates) {
    for (const bp_pid_mode_t mode : {BP_PID_FIXED, BP_PID_FROZEN, BP_PID_LEARNING}) {
        torque_trim_parameters_t p = parameters_of(mode);
        torque_trim_t trim;
        torque_trim_reset(&p, &trim, 0);
        for (int k = 0; k < 4000; k++) {
            torque_trim_step(&p, &trim, INT32_MAX, INT32_MIN, false);
            ASSERT_LE(trim.trim_q24, p.limit_q24);
        }
        EXPECT_EQ(trim.trim_q24, p.limit_q24);
        EXPECT_EQ(torque_trim_step(&p, &trim, INT32_MAX, INT32_MIN, false), INT32_MAX);
        for (int k = 0; k < 8000; k++) {
            torque_trim_step(&p, &trim, INT32_MIN, INT32_MAX, false);
            ASSERT_GE(trim.trim_q24, -p.limit_q24);
        }
        EXPECT_EQ(trim.trim_q24, -p.limit_q24);
        EXPECT_EQ(torque_trim_step(&p, &trim, INT32_MIN, INT32_MAX, false), INT32_MIN);
    }
}

TEST(TorqueTrim, off_it_passes_the_reference_on) {
    const torque_trim_parameters_t p = parameters_of(BP_PID_OFF);
    torque_trim_t trim;
    torque_trim_reset(&p, &trim, 0);
    for (const int32_t reference_q24 : {0, 1, -1, 5 << 24, INT32_MAX, INT32_MIN}) {
        EXPECT_EQ(torque_trim_step(&p, &trim, reference_q24, 1 << 24, false), reference_q24);
        EXPECT_EQ(trim.trim_q24, 0);
    }
}

} // namespace
