// The torque trim against its reference model.
#include <algorithm>
#include <cmath>
#include <cstdint>

#include <gtest/gtest.h>

extern "C" {
#include "control/bp_tuner.h"
#include "control/torque_trim.h"
}

#include "support/reference_builders.h"

namespace {

using namespace fixed_point;
constexpr double LIMIT_NM = 3.0;

torque_trim_parameters_t parameters_of(bp_pid_mode_t mode) {
    torque_trim_parameters_t p{};
    p.pid.mode = mode;
    p.pid.seed = 1;
    p.pid.error_scale_inverse_q24 = to_fixed(0.5, Q24); // 2 N m
    p.pid.scale_q28[0] = to_fixed(0.07, Q28);
    p.pid.scale_q28[1] = to_fixed(0.07, Q28);
    p.pid.scale_q28[2] = to_fixed(0.03, Q28);
    p.pid.network = {.learning_rate_q15 = to_fixed(0.05, Q15), .momentum_q32 = to_fixed(0.05, Q32)};
    p.limit_q24 = to_fixed(LIMIT_NM, Q24);
    return p;
}

// Each step of the tuner follows that of the trim.
int32_t step(const torque_trim_parameters_t &p, torque_trim_t &trim, bp_tuner_t &tuner, int32_t reference_q24,
             int32_t torque_q24, bool voltage_limited) {
    const int32_t out_q24 = torque_trim_step(&p, &trim, tuner.gain_q24, reference_q24, torque_q24, voltage_limited);
    bp_tuner_step(&p.pid, &tuner, &trim.pid.sample);
    return out_q24;
}

bp_tuner_t tuner_of(const torque_trim_parameters_t &p) {
    bp_tuner_t tuner{};
    bp_tuner_reset(&p.pid, &tuner);
    return tuner;
}

TEST(TorqueTrim, follows_its_reference_model_within_2_mNm_on_a_machine_with_too_little_torque) {
    const torque_trim_parameters_t p = parameters_of(BP_PID_FIXED);
    torque_trim_t trim;
    bp_tuner_t tuner = tuner_of(p);
    torque_trim_reset(&trim, 0);
    reference_model::trim_t model = reference_model::model_of(p);
    double produced_Nm[2] = {0.0, 0.0}, worst = 0.0;
    for (int k = 0; k < 4000; k++) {
        const double reference = 6.0 + 2.0 * std::sin(k * 0.002);
        const bool voltage_limited = k / 500 % 4 == 3;
        const int32_t reference_q24 = to_fixed(reference, Q24);
        const int32_t torque_q24 = to_fixed(produced_Nm[1], Q24);
        const double out = step(p, trim, tuner, reference_q24, torque_q24, voltage_limited) / Q24;
        const double expected = model.step(reference_q24 / Q24, torque_q24 / Q24, voltage_limited);
        worst = std::max(worst, std::fabs(out - expected));
        produced_Nm[1] = produced_Nm[0];
        produced_Nm[0] = 0.9 * out; // measured two samples later
    }
    EXPECT_LT(worst, 2e-3); // an LSB of the PID's output is 0.09 mN m
    EXPECT_GT(worst, 1e-6);
    // The trim adds the torque that the machine lacks.
    EXPECT_NEAR(trim.trim_q24 / Q24, model.trim_Nm, 2e-3);
    EXPECT_GT(trim.trim_q24 / Q24, 0.3);
}

TEST(TorqueTrim, a_machine_that_follows_its_reference_with_two_samples_delay_gets_no_trim) {
    const torque_trim_parameters_t p = parameters_of(BP_PID_FIXED);
    torque_trim_t trim;
    bp_tuner_t tuner = tuner_of(p);
    torque_trim_reset(&trim, 1 << 24);
    int32_t produced_q24[2] = {1 << 24, 1 << 24};
    for (int k = 0; k < 4000; k++) {
        const int32_t reference_q24 = to_fixed(1.0 + 9.0 * std::fabs(std::sin(k * 0.01)), Q24);
        ASSERT_EQ(step(p, trim, tuner, reference_q24, produced_q24[1], false), reference_q24) << k;
        produced_q24[1] = produced_q24[0];
        produced_q24[0] = reference_q24;
    }
}

TEST(TorqueTrim, is_constant_while_the_voltage_is_limited_and_continues_from_there) {
    const torque_trim_parameters_t p = parameters_of(BP_PID_FIXED);
    torque_trim_t trim;
    bp_tuner_t tuner = tuner_of(p);
    torque_trim_reset(&trim, 4 << 24);
    for (int k = 0; k < 10; k++) {
        step(p, trim, tuner, 4 << 24, 3 << 24, false);
    }
    const int32_t constant_q24 = trim.trim_q24;
    EXPECT_GT(constant_q24, 0);
    for (int k = 0; k < 100; k++) {
        EXPECT_EQ(step(p, trim, tuner, 4 << 24, 3 << 24, true), (4 << 24) + constant_q24);
    }
    step(p, trim, tuner, 4 << 24, 3 << 24, false);
    EXPECT_GT(trim.trim_q24, constant_q24);
    EXPECT_LT(trim.trim_q24, constant_q24 + constant_q24 / 5);
}

TEST(TorqueTrim, is_limited_and_the_sum_saturates) {
    for (const bp_pid_mode_t mode : {BP_PID_FIXED, BP_PID_FROZEN, BP_PID_LEARNING}) {
        torque_trim_parameters_t p = parameters_of(mode);
        torque_trim_t trim;
        bp_tuner_t tuner = tuner_of(p);
        torque_trim_reset(&trim, 0);
        for (int k = 0; k < 4000; k++) {
            step(p, trim, tuner, INT32_MAX, INT32_MIN, false);
            ASSERT_LE(trim.trim_q24, p.limit_q24);
        }
        EXPECT_EQ(trim.trim_q24, p.limit_q24);
        EXPECT_EQ(step(p, trim, tuner, INT32_MAX, INT32_MIN, false), INT32_MAX);
        for (int k = 0; k < 8000; k++) {
            step(p, trim, tuner, INT32_MIN, INT32_MAX, false);
            ASSERT_GE(trim.trim_q24, -p.limit_q24);
        }
        EXPECT_EQ(trim.trim_q24, -p.limit_q24);
        EXPECT_EQ(step(p, trim, tuner, INT32_MIN, INT32_MAX, false), INT32_MIN);
    }
}

TEST(TorqueTrim, switched_off_passes_the_reference_unchanged) {
    const torque_trim_parameters_t p = parameters_of(BP_PID_OFF);
    torque_trim_t trim;
    bp_tuner_t tuner = tuner_of(p);
    torque_trim_reset(&trim, 0);
    for (const int32_t reference_q24 : {0, 1, -1, 5 << 24, INT32_MAX, INT32_MIN}) {
        EXPECT_EQ(step(p, trim, tuner, reference_q24, 1 << 24, false), reference_q24);
        EXPECT_EQ(trim.trim_q24, 0);
    }
}

} // namespace
