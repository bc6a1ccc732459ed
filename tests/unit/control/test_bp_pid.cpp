// The BP-PID and its tuner against their reference model, and when they learn.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/bp_tuner.h"
#include "fixed/formats.h"
}

#include "support/reference_builders.h"

namespace {

using namespace fixed_point;
bp_pid_parameters_t parameters_of(bp_pid_mode_t mode) {
    bp_pid_parameters_t parameters{};
    parameters.mode = mode;
    parameters.seed = 1;
    parameters.error_scale_inverse_q24 = to_fixed(0.5, Q24); // 2 N m
    parameters.scale_q28[0] = to_fixed(1.0, Q28);
    parameters.scale_q28[1] = to_fixed(0.24, Q28);
    parameters.scale_q28[2] = to_fixed(0.4, Q28);
    parameters.network = {.learning_rate_q15 = to_fixed(0.05, Q15), .momentum_q32 = to_fixed(0.05, Q32)};
    return parameters;
}

// A PID with its tuner, of which each step follows the step of the PID, as in the drive.
struct tuned_pid_t {
    explicit tuned_pid_t(const bp_pid_parameters_t &of) : parameters(of) {
        bp_pid_reset(&pid);
        bp_tuner_reset(&parameters, &tuner);
    }

    int32_t step(int32_t error_q24) {
        const int32_t duty_q15 = bp_pid_step(&parameters, &pid, tuner.gain_q24, error_q24);
        bp_tuner_step(&parameters, &tuner, &pid.sample);
        return duty_q15;
    }

    bp_pid_parameters_t parameters;
    bp_pid_t pid{};
    bp_tuner_t tuner{};
};

reference_model::bp_pid_t model_of(const bp_pid_parameters_t &p, const bp_network_t &network) {
    reference_model::bp_pid_t model = reference_model::model_of(p);
    for (unsigned i = 0; i < BP_HIDDEN; i++) {
        for (unsigned j = 0; j < BP_INPUTS; j++) {
            // The first input of the model is the error, of the PID its difference.
            model.network.hidden_weight[i][j] = network.hidden[i].input.value[j == 2 ? 2 : 1 - j] / Q28;
        }
        for (unsigned l = 0; l < BP_OUTPUTS; l++) {
            model.network.output_weight[l][i] = network.hidden[i].output.value[l] / Q28;
        }
    }
    return model;
}

bool same_weights(const bp_network_t &a, const bp_network_t &b) {
    for (unsigned i = 0; i < BP_HIDDEN; i++) {
        if (std::memcmp(&a.hidden[i].input, &b.hidden[i].input, sizeof a.hidden[i].input) != 0 ||
            std::memcmp(&a.hidden[i].output, &b.hidden[i].output, sizeof a.hidden[i].output) != 0) {
            return false;
        }
    }
    return true;
}

// The torque follows the duty with a lag, the reference varies: errors as in a drive. Returns the largest difference of
// the duties of PID and model for the same errors.
double largest_difference(bp_pid_mode_t mode, int samples, double *largest_gain_difference) {
    tuned_pid_t tuned(parameters_of(mode));
    reference_model::bp_pid_t model = model_of(tuned.parameters, tuned.tuner.network);
    std::mt19937 random(1);
    std::normal_distribution<double> noise(0.0, 0.02);
    double torque = 0.0, largest = 0.0;
    *largest_gain_difference = 0.0;
    for (int k = 0; k < samples; k++) {
        const double reference = 4.0 + 3.0 * std::sin(k * 0.003) + (k / 700 % 2 == 0 ? 0.5 : -0.5);
        const int32_t error_q24 = to_fixed(reference - torque + noise(random), Q24);
        const double duty = tuned.step(error_q24) / Q15;
        largest = std::max(largest, std::fabs(duty - model.step(error_q24 / Q24)));
        for (unsigned l = 0; l < BP_OUTPUTS; l++) {
            *largest_gain_difference =
                std::max(*largest_gain_difference, std::fabs(tuned.pid.gain_q24[l] / Q24 - model.gain[l]));
        }
        torque += 0.3 * (8.0 * duty - torque);
    }
    return largest;
}

TEST(BpPid, follows_its_reference_model_with_fixed_gains) {
    double gain = 0.0;
    const double largest = largest_difference(BP_PID_FIXED, 20000, &gain);
    EXPECT_LT(largest, 3e-4);
    EXPECT_LT(gain, 1.0 / Q15);
}

TEST(BpPid, follows_its_reference_model_with_the_frozen_network) {
    double gain = 0.0;
    const double largest = largest_difference(BP_PID_FROZEN, 20000, &gain);
    EXPECT_LT(largest, 5e-4);
    EXPECT_LT(gain, 2e-4);
}

TEST(BpPid, follows_its_reference_model_while_it_learns) {
    double gain = 0.0;
    const double largest = largest_difference(BP_PID_LEARNING, 20000, &gain);
    EXPECT_LT(largest, 5e-4);
    EXPECT_LT(gain, 2e-4);
}

// (15) as (25) has it: with an error that steps from 0 to E, du is kp E + ki E + kd E, then ki E - kd E, then ki E.
TEST(BpPid, a_step_of_the_error_gives_the_increments_of_the_incremental_form) {
    bp_pid_parameters_t parameters = parameters_of(BP_PID_FIXED);
    parameters.error_scale_inverse_q24 = 1 << 24;
    parameters.scale_q28[0] = 2 * 8192 << 13;
    parameters.scale_q28[1] = 2 * 1024 << 13;
    parameters.scale_q28[2] = 2 * 2048 << 13;
    tuned_pid_t tuned(parameters);
    const int32_t error_q24 = 1 << 22; // 1/4
    EXPECT_EQ(tuned.step(error_q24), (8192 + 1024 + 2048) / 4);
    EXPECT_EQ(tuned.step(error_q24), (8192 + 2 * 1024 + 2048 - 2048) / 4);
    EXPECT_EQ(tuned.step(error_q24), (8192 + 3 * 1024) / 4);
    EXPECT_EQ(tuned.step(error_q24), (8192 + 4 * 1024) / 4);
    EXPECT_EQ(tuned.step(0), (4 * 1024 - 2048) / 4);
    EXPECT_EQ(tuned.step(0), 4 * 1024 / 4);
}

TEST(BpPid, gains_are_half_the_scales_at_first_and_the_network_s_are_its_outputs_times_the_scales) {
    for (const bp_pid_mode_t mode : {BP_PID_OFF, BP_PID_FIXED, BP_PID_FROZEN, BP_PID_LEARNING}) {
        tuned_pid_t tuned(parameters_of(mode));
        for (int k = 0; k < 3; k++) {
            const bool by_network = k > 0 && (mode == BP_PID_FROZEN || mode == BP_PID_LEARNING);
            double output[BP_OUTPUTS] = {0.5, 0.5, 0.5};
            for (unsigned l = 0; by_network && l < BP_OUTPUTS; l++) {
                output[l] = 0.5 + 0.5 * tuned.tuner.network.output_q27[l] / Q27;
            }
            tuned.step(1 << 23);
            for (unsigned l = 0; l < BP_OUTPUTS; l++) {
                EXPECT_NEAR(tuned.pid.gain_q24[l], output[l] * tuned.parameters.scale_q28[l] / 16.0, 0.51) << k;
            }
        }
    }
}

TEST(BpPid, only_learning_mode_changes_weights) {
    std::mt19937 random(2);
    for (const bp_pid_mode_t mode : {BP_PID_OFF, BP_PID_FIXED, BP_PID_FROZEN, BP_PID_LEARNING}) {
        tuned_pid_t tuned(parameters_of(mode));
        const bp_network_t start = tuned.tuner.network;
        for (int k = 0; k < 1000; k++) {
            tuned.step(int32_t(random() % (1u << 25)) - (1 << 24));
        }
        EXPECT_EQ(same_weights(tuned.tuner.network, start), mode != BP_PID_LEARNING) << mode;
    }
}

TEST(BpPid, learning_is_suspended_while_duty_or_error_is_saturated_and_of_a_sample_without_gains_of_its_network) {
    for (const int32_t sign : {1, -1}) {
        tuned_pid_t tuned(parameters_of(BP_PID_LEARNING));
        const bp_network_t &network = tuned.tuner.network;
        bp_network_t before = network;
        // Gains of no forward pass.
        tuned.step(sign * (1 << 24));
        EXPECT_TRUE(tuned.pid.sample.learns);
        EXPECT_TRUE(same_weights(network, before));
        // The error beyond its scale: 3 N m of 2.
        tuned.step(sign * (3 << 24));
        EXPECT_FALSE(tuned.pid.sample.learns);
        EXPECT_TRUE(same_weights(network, before));
        // Duty saturated, error not.
        bp_pid_preset(&tuned.pid, sign * ONE_Q15);
        tuned.pid.error_q16 = tuned.pid.error_difference_q16 = 0;
        EXPECT_EQ(tuned.step(sign * (1 << 24)), sign * ONE_Q15);
        EXPECT_TRUE(same_weights(network, before));
        // The same error, duty not saturated.
        bp_pid_preset(&tuned.pid, 0);
        tuned.pid.error_q16 = tuned.pid.error_difference_q16 = 0;
        tuned.step(sign * (1 << 24));
        EXPECT_FALSE(same_weights(network, before));
        // Leaving saturation: it learns.
        before = network;
        bp_pid_preset(&tuned.pid, sign * ONE_Q15);
        tuned.step(-sign * (1 << 24));
        EXPECT_FALSE(same_weights(network, before));
    }
}

TEST(BpPid, the_network_s_inputs_are_the_error_and_its_first_and_second_difference) {
    tuned_pid_t tuned(parameters_of(BP_PID_FROZEN));
    tuned.parameters.error_scale_inverse_q24 = 1 << 24;
    const double errors[] = {0.25, 0.5, -0.125, -0.9};
    double e1 = 0.0, e2 = 0.0;
    for (const double e : errors) {
        tuned.step(to_fixed(e, Q24));
        const auto limited = [](double v) { return std::clamp(v, -1.0, 65535.0 / 65536.0); };
        const double inputs[] = {limited(e - e1), e, limited(e - 2.0 * e1 + e2)};
        for (const bp_neuron_t &neuron : tuned.tuner.network.hidden) {
            double sum = 0.0;
            for (unsigned j = 0; j < BP_INPUTS; j++) {
                sum += neuron.input.value[j] / Q28 * inputs[j];
            }
            EXPECT_NEAR(neuron.activation_q27 / Q27, std::tanh(0.5 * sum), 1e-4);
        }
        e2 = e1;
        e1 = e;
    }
}

TEST(BpPid, a_preset_duty_gives_a_bumpless_transfer) {
    for (const bp_pid_mode_t mode : {BP_PID_FIXED, BP_PID_FROZEN, BP_PID_LEARNING}) {
        const bp_pid_parameters_t parameters = parameters_of(mode);
        for (const int32_t duty_q15 : {-32768, -20000, -1, 0, 1, 12345, 32767, 32768}) {
            tuned_pid_t tuned(parameters);
            bp_pid_preset(&tuned.pid, duty_q15);
            // Without an error it is constant.
            for (int k = 0; k < 3; k++) {
                ASSERT_EQ(tuned.step(0), duty_q15);
            }
        }
        tuned_pid_t tuned(parameters);
        bp_pid_preset(&tuned.pid, INT32_MAX);
        EXPECT_EQ(tuned.step(0), ONE_Q15);
        bp_pid_preset(&tuned.pid, INT32_MIN);
        EXPECT_EQ(tuned.step(0), -ONE_Q15);
    }
}

TEST(BpPid, nothing_overflows_and_the_duty_stays_within_one_for_any_error_and_extreme_parameters) {
    std::mt19937 random(3);
    const int32_t errors[] = {INT32_MIN, INT32_MAX, 1, -1, 0};
    for (const bp_pid_mode_t mode : {BP_PID_OFF, BP_PID_FIXED, BP_PID_FROZEN, BP_PID_LEARNING}) {
        for (const int32_t inverse_q24 : {1, 1 << 24, 64 << 24}) {
            for (const int32_t scale_q28 : {0, 1, 1 << 30}) {
                bp_pid_parameters_t parameters = parameters_of(mode);
                parameters.error_scale_inverse_q24 = inverse_q24;
                std::fill_n(parameters.scale_q28, BP_OUTPUTS, scale_q28);
                parameters.network = {.learning_rate_q15 = 32768, .momentum_q32 = INT32_MAX};
                tuned_pid_t tuned(parameters);
                for (int k = 0; k < 2000; k++) {
                    const int32_t error =
                        random() % 4 == 0 ? errors[random() % 5] : int32_t(uint32_t(random())) >> (random() % 20);
                    const int32_t duty = tuned.step(error);
                    ASSERT_LE(std::abs(duty), ONE_Q15);
                }
            }
        }
    }
}

TEST(BpPid, clearing_telemetry_zeroes_duty_and_gains) {
    tuned_pid_t tuned(parameters_of(BP_PID_LEARNING));
    tuned.step(to_fixed(0.5, Q24));
    ASSERT_NE(tuned.pid.duty_q23, 0);
    ASSERT_NE(tuned.pid.gain_q24[0], 0);
    bp_pid_clear_telemetry(&tuned.pid);
    EXPECT_EQ(tuned.pid.duty_q23, 0);
    for (const int32_t gain_q24 : tuned.pid.gain_q24) {
        EXPECT_EQ(gain_q24, 0);
    }
}

TEST(BpPid, a_reset_leaves_no_error_no_duty_no_gain_to_report_and_nothing_to_learn_from) {
    tuned_pid_t tuned(parameters_of(BP_PID_LEARNING));
    for (int k = 0; k < 5; k++) {
        tuned.step((k + 1) << 20);
    }
    ASSERT_TRUE(tuned.pid.sample.learns);
    ASSERT_NE(tuned.pid.duty_q23, 0);
    bp_pid_reset(&tuned.pid);
    EXPECT_EQ(tuned.pid.error_q16, 0);
    EXPECT_EQ(tuned.pid.error_difference_q16, 0);
    EXPECT_EQ(tuned.pid.duty_q23, 0);
    EXPECT_FALSE(tuned.pid.sample.learns);
    for (const int32_t gain_q24 : tuned.pid.gain_q24) {
        EXPECT_EQ(gain_q24, 0);
    }
}

TEST(BpTuner, after_a_reset_learns_as_a_new_one_and_not_from_the_samples_before) {
    const bp_pid_parameters_t parameters = parameters_of(BP_PID_LEARNING);
    bp_tuner_t used{}, fresh{};
    bp_tuner_reset(&parameters, &used);
    bp_tuner_reset(&parameters, &fresh);
    const bp_pid_sample_t before = {{1 << 30, -(1 << 29), 1 << 28}, true};
    const bp_pid_sample_t after[] = {{{1 << 28, 1 << 30, -(1 << 29)}, true}, {{-(1 << 29), 1 << 27, 1 << 30}, true}};
    for (int k = 0; k < 10; k++) {
        bp_tuner_step(&parameters, &used, &before);
    }
    bp_tuner_reset(&parameters, &used);
    for (unsigned l = 0; l < BP_OUTPUTS; l++) {
        EXPECT_NEAR(used.gain_q24[l], parameters.scale_q28[l] / 32, 1) << "half of the scale";
    }
    for (const bp_pid_sample_t &sample : after) {
        bp_tuner_step(&parameters, &used, &sample);
        bp_tuner_step(&parameters, &fresh, &sample);
        for (unsigned i = 0; i < BP_HIDDEN; i++) {
            for (unsigned l = 0; l < BP_OUTPUTS; l++) {
                EXPECT_EQ(used.network.hidden[i].output.value[l], fresh.network.hidden[i].output.value[l]) << i;
            }
            for (unsigned j = 0; j < BP_INPUTS; j++) {
                EXPECT_EQ(used.network.hidden[i].input.value[j], fresh.network.hidden[i].input.value[j]) << i;
            }
        }
    }
}

} // namespace
