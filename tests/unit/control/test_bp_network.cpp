// The BP network against its reference model, the model against the gradient, and the paper's (26) as published.
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/bp_network.h"
#include "fixed/sigmoid.h"
}

#include "support/reference_models.h"
#include "support/wide_integer.h"

namespace {

using namespace fixed_point;
constexpr int32_t WEIGHT_END_Q28 = INT32_MAX; // 8
const bp_network_parameters_t DEFAULTS = {.learning_rate_q15 = to_fixed(0.05, Q15),
                                          .momentum_q32 = to_fixed(0.05, Q32)};

reference_model::network_t model_of(const bp_network_t &network) {
    reference_model::network_t model;
    for (unsigned i = 0; i < BP_HIDDEN; i++) {
        for (unsigned j = 0; j < BP_INPUTS; j++) {
            model.hidden_weight[i][j] = network.hidden[i].input.value[j] / Q28;
            model.hidden_increment[i][j] = network.hidden[i].input.increment[j] / Q27;
        }
    }
    for (unsigned l = 0; l < BP_OUTPUTS; l++) {
        for (unsigned i = 0; i < BP_HIDDEN; i++) {
            model.output_weight[l][i] = network.hidden[i].output.value[l] / Q28;
            model.output_increment[l][i] = network.hidden[i].output.increment[l] / Q27;
        }
    }
    return model;
}

template <typename visitor_t> void for_each_weight(const bp_network_t &network, visitor_t visit) {
    for (unsigned i = 0; i < BP_HIDDEN; i++) {
        for (unsigned j = 0; j < BP_INPUTS; j++) {
            visit(network.hidden[i].input.value[j]);
        }
    }
    for (unsigned l = 0; l < BP_OUTPUTS; l++) {
        for (unsigned i = 0; i < BP_HIDDEN; i++) {
            visit(network.hidden[i].output.value[l]);
        }
    }
}

double largest_weight_difference(const bp_network_t &network, const reference_model::network_t &model) {
    double largest = 0.0;
    for (unsigned i = 0; i < BP_HIDDEN; i++) {
        for (unsigned j = 0; j < BP_INPUTS; j++) {
            largest = std::max(largest, std::fabs(network.hidden[i].input.value[j] / Q28 - model.hidden_weight[i][j]));
        }
    }
    for (unsigned l = 0; l < BP_OUTPUTS; l++) {
        for (unsigned i = 0; i < BP_HIDDEN; i++) {
            largest = std::max(largest, std::fabs(network.hidden[i].output.value[l] / Q28 - model.output_weight[l][i]));
        }
    }
    return largest;
}

double output(const bp_network_t &network, unsigned l) {
    return 0.5 + 0.5 * network.output_q27[l] / Q27;
}

double largest_output_difference(const bp_network_t &network, const reference_model::network_t &model) {
    double largest = 0.0;
    for (unsigned l = 0; l < BP_OUTPUTS; l++) {
        largest = std::max(largest, std::fabs(output(network, l) - model.output[l]));
    }
    return largest;
}

reference_model::network_t::inputs_t to_double(const int32_t (&value)[3], double one) {
    return {value[0] / one, value[1] / one, value[2] / one};
}

void random_weights(bp_network_t &network, std::mt19937 &random, double limit) {
    std::uniform_real_distribution<double> weight(-limit, limit);
    for (bp_neuron_t &neuron : network.hidden) {
        for (unsigned k = 0; k < 3; k++) {
            neuron.input.value[k] = to_fixed(weight(random), Q28);
            neuron.output.value[k] = to_fixed(weight(random), Q28);
        }
    }
}

int32_t any_q15(std::mt19937 &random) {
    return int32_t(random() % 65535) - 32767;
}

int32_t any_q27(std::mt19937 &random) {
    return any_q15(random) * 4096;
}

int32_t any_q31(std::mt19937 &random) {
    return any_q15(random) * 65536;
}

TEST(BpNetwork, initial_weights_are_within_one_half_and_depend_only_on_the_seed) {
    bp_network_t first{}, second{}, other{};
    bp_network_reset(&first, 1);
    bp_network_reset(&second, 1);
    bp_network_reset(&other, 2);
    double sum = 0.0, squares = 0.0;
    int count = 0, same = 0;
    for_each_weight(first, [&](int32_t w) {
        EXPECT_LE(std::abs(w), 1 << 27);
        sum += w / Q28;
        squares += std::pow(w / Q28, 2.0);
        count++;
    });
    for (unsigned i = 0; i < BP_HIDDEN; i++) {
        for (unsigned j = 0; j < BP_INPUTS; j++) {
            EXPECT_EQ(first.hidden[i].input.value[j], second.hidden[i].input.value[j]);
            same += first.hidden[i].input.value[j] == other.hidden[i].input.value[j];
        }
    }
    EXPECT_EQ(count, 36);
    EXPECT_EQ(same, 0);
    EXPECT_LT(std::fabs(sum / count), 0.2);
    EXPECT_NEAR(std::sqrt(squares / count), 1.0 / std::sqrt(12.0), 0.06); // uniform
    // The same on any machine: the generator's first number.
    const uint32_t generated = 1664525u + 1013904223u;
    EXPECT_EQ(first.hidden[0].input.value[1], int32_t(generated >> 4) - (1 << 27));
}

TEST(BpNetwork, a_reset_leaves_neither_weights_nor_increments_of_what_was_learned) {
    std::mt19937 random(6);
    bp_network_t fresh{}, used{};
    bp_network_reset(&fresh, 1);
    bp_network_reset(&used, 2);
    for (int k = 0; k < 10; k++) {
        const int32_t input_q27[BP_INPUTS] = {any_q27(random), any_q27(random), any_q27(random)};
        const int32_t input_q31[BP_INPUTS] = {any_q31(random), any_q31(random), any_q31(random)};
        const int32_t sensitivity_q31[BP_OUTPUTS] = {any_q31(random), any_q31(random), any_q31(random)};
        bp_network_forward(&used, input_q27);
        bp_network_learn(&DEFAULTS, &used, 30000, input_q31, sensitivity_q31);
    }
    int learned = 0;
    for (const bp_neuron_t &neuron : used.hidden) {
        for (unsigned k = 0; k < 3; k++) {
            learned += (neuron.input.increment[k] != 0) + (neuron.output.increment[k] != 0);
        }
    }
    EXPECT_EQ(learned, 36);
    bp_network_reset(&used, 1);
    for (unsigned i = 0; i < BP_HIDDEN; i++) {
        for (unsigned k = 0; k < 3; k++) {
            EXPECT_EQ(used.hidden[i].input.value[k], fresh.hidden[i].input.value[k]);
            EXPECT_EQ(used.hidden[i].output.value[k], fresh.hidden[i].output.value[k]);
            EXPECT_EQ(used.hidden[i].input.increment[k], 0);
            EXPECT_EQ(used.hidden[i].output.increment[k], 0);
        }
    }
}

// The difference is the error of the activations, 8e-5 (7e-4 for sums beyond 8), through the 6 weights of the next
// layer.
TEST(BpNetwork, outputs_equal_the_reference_model_for_small_and_for_saturated_weights) {
    std::mt19937 random(1);
    for (const double limit : {0.5, 2.6, 8.0}) {
        double worst = 0.0;
        for (int run = 0; run < 20000; run++) {
            bp_network_t network{};
            random_weights(network, random, limit);
            const int32_t input_q27[BP_INPUTS] = {any_q27(random), any_q27(random), any_q27(random)};
            bp_network_forward(&network, input_q27);
            reference_model::network_t model = model_of(network);
            model.forward(to_double(input_q27, Q27));
            for (unsigned i = 0; i < BP_HIDDEN; i++) {
                ASSERT_NEAR(network.hidden[i].activation_q27 / Q27, model.hidden[i], limit < 2.7 ? 8e-5 : 7e-4);
            }
            worst = std::max(worst, largest_output_difference(network, model));
        }
        EXPECT_LT(worst, limit < 1.0 ? 4e-5 : limit < 3.0 ? 1.5e-4 : 2.5e-3);
        EXPECT_GT(worst, 2e-5);
    }
}

// Each product of a sum is rounded to its format: half an LSB. The sums are seen through the activation function, which
// takes multiples of 2^-16.
TEST(BpNetwork, sums_of_a_layer_err_by_half_an_lsb_for_each_product) {
    std::mt19937 random(4);
    int seen = 0;
    for (int run = 0; run < 20000; run++) {
        bp_network_t network{};
        random_weights(network, random, run % 2 ? 2.6 : 8.0);
        const int32_t input_q27[BP_INPUTS] = {any_q27(random), any_q27(random), any_q27(random)};
        bp_network_forward(&network, input_q27);
        const auto expect = [&](int32_t activation_q27, double sum, double error_q23) {
            const auto low_q23 = int32_t(std::floor(sum * Q23 - error_q23));
            const auto high_q23 = int32_t(std::ceil(sum * Q23 + error_q23));
            ASSERT_GE(activation_q27, sigmoid_symmetric_q27(low_q23)) << run;
            ASSERT_LE(activation_q27, sigmoid_symmetric_q27(high_q23)) << run;
            seen += sigmoid_symmetric_q27(low_q23) == sigmoid_symmetric_q27(high_q23);
        };
        double output_sum[BP_OUTPUTS] = {};
        for (const bp_neuron_t &neuron : network.hidden) {
            double sum = 0.0;
            for (unsigned k = 0; k < 3; k++) {
                sum += neuron.input.value[k] / Q28 * (input_q27[k] / Q27);
                output_sum[k] += neuron.output.value[k] / Q28 * (neuron.activation_q27 / Q27);
            }
            ASSERT_NO_FATAL_FAILURE(expect(neuron.activation_q27, sum, 3 * 0.5));
        }
        for (unsigned l = 0; l < BP_OUTPUTS; l++) {
            ASSERT_NO_FATAL_FAILURE(expect(network.output_q27[l], output_sum[l], 6 * 0.5));
        }
    }
    EXPECT_GT(seen, 100000) << "where an error of less than 2^-16 would show";
}

// For the slopes of the activation functions as the firmware has them. An increment is the sum of two products, each
// rounded to its LSB, of which the error's share (1.5 LSB of eta d3 in Q32, 2.4 of eta d2 in Q28) adds less than one.
TEST(BpNetwork, increments_of_a_learning_step_err_by_their_roundings) {
    std::mt19937 random(5);
    double worst_output = 0.0, worst_hidden = 0.0;
    for (int run = 0; run < 20000; run++) {
        const bp_network_parameters_t parameters = {.learning_rate_q15 = int32_t(random() % 32769),
                                                    .momentum_q32 = int32_t(random() % (1u << 31))};
        bp_network_t network{};
        random_weights(network, random, 8.0);
        for (bp_neuron_t &neuron : network.hidden) {
            for (unsigned k = 0; k < 3; k++) {
                neuron.input.increment[k] = int32_t(random() % (1u << 27)) - (1 << 26);
                neuron.output.increment[k] = int32_t(random() % (1u << 27)) - (1 << 26);
            }
        }
        const int32_t input_q31[BP_INPUTS] = {any_q31(random), any_q31(random), any_q31(random)};
        const int32_t input_q27[BP_INPUTS] = {input_q31[0] / 16, input_q31[1] / 16, input_q31[2] / 16};
        const int32_t sensitivity_q31[BP_OUTPUTS] = {any_q31(random), any_q31(random), any_q31(random)};
        const int32_t error_q16 = any_q15(random) * 2;
        bp_network_forward(&network, input_q27);
        const bp_network_t before = network;
        bp_network_learn(&parameters, &network, error_q16, input_q31, sensitivity_q31);
        const double momentum = parameters.momentum_q32 / Q32;
        double delta[BP_OUTPUTS]; // eta d3
        for (unsigned l = 0; l < BP_OUTPUTS; l++) {
            delta[l] = parameters.learning_rate_q15 / Q15 * (error_q16 / Q16) * (sensitivity_q31[l] / Q31) *
                       (sigmoid_logistic_slope_q33(before.output_q27[l]) / (2.0 * Q32));
        }
        for (unsigned i = 0; i < BP_HIDDEN; i++) {
            const bp_neuron_t &from = before.hidden[i], &to = network.hidden[i];
            double back = 0.0;
            for (unsigned l = 0; l < BP_OUTPUTS; l++) {
                back += delta[l] * (from.output.value[l] / Q28);
            }
            const double rate = back * (sigmoid_symmetric_slope_q32(from.activation_q27) / Q32);
            for (unsigned k = 0; k < 3; k++) {
                const double output = momentum * from.output.increment[k] + delta[k] * from.activation_q27;
                const double hidden = momentum * from.input.increment[k] + rate * (input_q31[k] / Q31) * Q27;
                const double output_error = std::fabs(to.output.increment[k] - output);
                const double hidden_error = std::fabs(to.input.increment[k] - hidden);
                ASSERT_LE(output_error, 1.1) << run << " " << i << " " << k;
                ASSERT_LE(hidden_error, 2.3) << run << " " << i << " " << k;
                worst_output = std::max(worst_output, output_error);
                worst_hidden = std::max(worst_hidden, hidden_error);
                const auto moved = [](int32_t value, int32_t increment) {
                    return wide_integer::saturated(wide_integer::wide_t(value) + 2 * wide_integer::wide_t(increment));
                };
                ASSERT_EQ(to.output.value[k], moved(from.output.value[k], to.output.increment[k]));
                ASSERT_EQ(to.input.value[k], moved(from.input.value[k], to.input.increment[k]));
            }
        }
    }
    EXPECT_GT(worst_output, 0.9);
    EXPECT_GT(worst_hidden, 0.9);
}

TEST(BpNetwork, a_learning_step_changes_the_weights_as_the_reference_model_does) {
    std::mt19937 random(2);
    const bp_network_parameters_t parameters = {.learning_rate_q15 = 32768, .momentum_q32 = 1 << 30};
    double worst = 0.0, largest_update = 0.0;
    for (int run = 0; run < 20000; run++) {
        bp_network_t network{};
        random_weights(network, random, 2.6);
        for (bp_neuron_t &neuron : network.hidden) {
            for (unsigned k = 0; k < 3; k++) {
                neuron.input.increment[k] = int32_t(random() % (1u << 23)) - (1 << 22);
                neuron.output.increment[k] = int32_t(random() % (1u << 23)) - (1 << 22);
            }
        }
        const int32_t input_q31[BP_INPUTS] = {any_q31(random), any_q31(random), any_q31(random)};
        const int32_t input_q27[BP_INPUTS] = {input_q31[0] / 16, input_q31[1] / 16, input_q31[2] / 16};
        const int32_t sensitivity_q31[BP_OUTPUTS] = {any_q31(random), any_q31(random), any_q31(random)};
        const int32_t error_q16 = any_q15(random) * 2;
        reference_model::network_t model = model_of(network);
        const reference_model::network_t before = model;
        bp_network_forward(&network, input_q27);
        model.forward(to_double(input_q27, Q27));
        bp_network_learn(&parameters, &network, error_q16, input_q31, sensitivity_q31);
        model.learn(1.0, 0.25, error_q16 / Q16, to_double(sensitivity_q31, Q31));
        worst = std::max(worst, largest_weight_difference(network, model));
        largest_update = std::max(largest_update, largest_weight_difference(network, before));
    }
    EXPECT_LT(worst, 2e-4);
    EXPECT_GT(worst, 1e-5);
    EXPECT_GT(largest_update, 0.2);
}

TEST(BpNetwork, a_hundred_thousand_learning_steps_stay_bounded_and_near_the_reference_model) {
    std::mt19937 random(3);
    std::normal_distribution<double> noise(0.0, 0.3);
    bp_network_t network;
    bp_network_reset(&network, 1);
    reference_model::network_t model = model_of(network);
    const reference_model::network_t start = model;
    double e1 = 0.0, e2 = 0.0, worst_weight = 0.0, worst_output = 0.0;
    int32_t largest_q28 = 0;
    for (int k = 0; k < 100000; k++) {
        const double e = std::clamp(0.8 * e1 + noise(random), -0.9999, 0.9999);
        const double first_difference = std::clamp(e - e1, -0.9999, 0.9999);
        const double second_difference = std::clamp(e - 2.0 * e1 + e2, -0.9999, 0.9999);
        e2 = e1;
        e1 = e;
        const int32_t error_q16 = to_fixed(e, Q16);
        const int32_t term_q31[3] = {to_fixed(first_difference, Q31), to_fixed(e, Q31),
                                     to_fixed(second_difference, Q31)};
        const int32_t input_q31[3] = {term_q31[1], term_q31[0], term_q31[2]};
        const int32_t input_q27[3] = {input_q31[0] / 16, input_q31[1] / 16, input_q31[2] / 16};
        bp_network_forward(&network, input_q27);
        model.forward(to_double(input_q27, Q27));
        bp_network_learn(&DEFAULTS, &network, error_q16, input_q31, term_q31);
        model.learn(DEFAULTS.learning_rate_q15 / Q15, DEFAULTS.momentum_q32 / Q32, error_q16 / Q16,
                    to_double(term_q31, Q31));
        worst_output = std::max(worst_output, largest_output_difference(network, model));
        worst_weight = std::max(worst_weight, largest_weight_difference(network, model));
        for_each_weight(network, [&](int32_t w) { largest_q28 = std::max(largest_q28, std::abs(w)); });
    }
    EXPECT_LT(worst_weight, 1.5e-3);
    EXPECT_LT(worst_output, 2e-4);
    EXPECT_GT(worst_weight, 1e-4);
    EXPECT_LT(largest_q28 / Q28, 2.6);
    EXPECT_GT(largest_weight_difference(network, start), 0.1) << "it learned nothing";
}

TEST(BpNetwork, weights_saturate_and_never_wrap_under_extreme_learning) {
    std::mt19937 random(4);
    const bp_network_parameters_t parameters = {.learning_rate_q15 = 32768,
                                                .momentum_q32 = INT32_MAX}; // eta 1, alpha 1/2
    bp_network_t network{};
    random_weights(network, random, 8.0);
    int32_t last[BP_OUTPUTS][BP_HIDDEN];
    bool reached = false;
    for (int k = 0; k < 20000; k++) {
        const int32_t sign = k / 500 % 2 == 0 ? 1 : -1;
        const int32_t input_q31[3] = {sign * INT32_MAX, INT32_MAX, any_q31(random)};
        const int32_t input_q27[3] = {input_q31[0] / 16, input_q31[1] / 16, input_q31[2] / 16};
        const int32_t sensitivity_q31[3] = {INT32_MAX, INT32_MIN, sign * INT32_MAX};
        for (unsigned l = 0; l < BP_OUTPUTS; l++) {
            for (unsigned i = 0; i < BP_HIDDEN; i++) {
                last[l][i] = network.hidden[i].output.value[l];
            }
        }
        bp_network_forward(&network, input_q27);
        bp_network_learn(&parameters, &network, k % 3 == 0 ? 65535 : -65535 * sign, input_q31, sensitivity_q31);
        for (unsigned l = 0; l < BP_OUTPUTS; l++) {
            ASSERT_GT(output(network, l), 0.0);
            ASSERT_LT(output(network, l), 1.0);
            for (unsigned i = 0; i < BP_HIDDEN; i++) {
                const int32_t now = network.hidden[i].output.value[l],
                              increment = network.hidden[i].output.increment[l];
                // In the direction of the increment: saturated, not wrapped.
                ASSERT_TRUE(increment >= 0 ? now >= last[l][i] : now <= last[l][i]);
                reached = reached || now == WEIGHT_END_Q28 || now == INT32_MIN;
            }
        }
    }
    EXPECT_TRUE(reached) << "no weight reached saturation";
}

// E = e^2 / 2, y = y0 + du, so dE/dW = -e d(du)/dW with sgn(dy/du) = 1: (26) and (27) with alpha 0 must be -eta dE/dW.
TEST(BpNetwork, the_corrected_rules_26_and_27_are_the_gradient_of_the_error_through_the_pid) {
    std::mt19937 random(5);
    std::uniform_real_distribution<double> unit(-1.0, 1.0);
    const double step = 1e-6;
    for (int run = 0; run < 200; run++) {
        bp_network_t start{};
        random_weights(start, random, 2.0);
        const reference_model::network_t at = model_of(start);
        const double e = unit(random), e1 = unit(random), e2 = unit(random);
        const reference_model::network_t::outputs_t term = {e - e1, e, e - 2.0 * e1 + e2}; // (25)
        const reference_model::network_t::inputs_t input = {e, e - e1, e - 2.0 * e1 + e2};
        const auto increment = [&](reference_model::network_t network) {
            network.forward(input);
            return network.output[0] * term[0] + network.output[1] * term[1] + network.output[2] * term[2];
        };
        reference_model::network_t learned = at;
        learned.forward(input);
        learned.learn(1.0, 0.0, e, term);
        const auto expect_gradient = [&](double &(*weight)(reference_model::network_t &, unsigned, unsigned),
                                         unsigned row, unsigned column) {
            reference_model::network_t up = at, down = at;
            weight(up, row, column) += step;
            weight(down, row, column) -= step;
            const double slope = -e * (increment(up) - increment(down)) / (2.0 * step);
            reference_model::network_t origin = at;
            ASSERT_NEAR(weight(learned, row, column) - weight(origin, row, column), -slope, 1e-8);
        };
        for (unsigned i = 0; i < BP_HIDDEN; i++) {
            for (unsigned j = 0; j < BP_INPUTS; j++) {
                ASSERT_NO_FATAL_FAILURE(expect_gradient([](reference_model::network_t &n, unsigned r,
                                                           unsigned c) -> double & { return n.hidden_weight[r][c]; },
                                                        i, j));
            }
        }
        for (unsigned l = 0; l < BP_OUTPUTS; l++) {
            for (unsigned i = 0; i < BP_HIDDEN; i++) {
                ASSERT_NO_FATAL_FAILURE(expect_gradient([](reference_model::network_t &n, unsigned r,
                                                           unsigned c) -> double & { return n.output_weight[r][c]; },
                                                        l, i));
            }
        }
    }
}

TEST(BpNetwork, a_learning_step_reduces_the_error_it_learned_from) {
    // One PID sample on a plant y = u: with the weights after the step, the same sample's error is smaller.
    std::mt19937 random(6);
    const bp_network_parameters_t parameters = {to_fixed(0.1, Q15), 0};
    int better = 0, worse = 0;
    for (int run = 0; run < 2000; run++) {
        bp_network_t network{};
        random_weights(network, random, 1.0);
        const int32_t e = any_q15(random), first_difference = any_q15(random), second_difference = any_q15(random);
        const int32_t input_q27[3] = {e * 4096, first_difference * 4096, second_difference * 4096};
        const int32_t input_q31[3] = {e * 65536, first_difference * 65536, second_difference * 65536};
        const int32_t term_q31[3] = {first_difference * 65536, e * 65536, second_difference * 65536};
        const auto increment = [&]() {
            bp_network_forward(&network, input_q27);
            return (output(network, 0) * first_difference + output(network, 1) * e +
                    output(network, 2) * second_difference) /
                   Q15;
        };
        const double before = increment();
        bp_network_learn(&parameters, &network, 2 * e, input_q31, term_q31);
        const double gain = (increment() - before) * (e > 0 ? 1.0 : -1.0);
        if (std::fabs(gain) > 1e-4) {
            (gain > 0.0 ? better : worse)++;
        }
    }
    EXPECT_GT(better, 1000);
    EXPECT_EQ(worse, 0);
}

// Erratum: (26) is published with alpha W_li(k-1) where (22) has alpha dW_li(k-1).
TEST(BpNetwork, rule_26_as_published_grows_every_weight_by_1_plus_alpha_per_step_and_the_corrected_one_does_not) {
    const double alpha = 0.05;
    bp_network_t network;
    bp_network_reset(&network, 1);
    const double start = network.hidden[0].output.value[0] / Q28;
    double published = start;
    const bp_network_parameters_t parameters = {DEFAULTS.learning_rate_q15, to_fixed(alpha, Q32)};
    const int32_t input_q27[3] = {1 << 26, 1 << 25, 1 << 24}, nothing[3] = {0, 0, 0};
    for (int k = 1; k <= 100; k++) {
        // No error, so delta is zero: all that is left of (26) as published is dW = alpha W.
        published += alpha * published;
        EXPECT_NEAR(published, start * std::pow(1.0 + alpha, k), 1e-9 * std::fabs(published));
        bp_network_forward(&network, input_q27);
        bp_network_learn(&parameters, &network, 0, input_q27, nothing);
    }
    EXPECT_GT(std::fabs(published), 130.0 * std::fabs(start));
    EXPECT_EQ(network.hidden[0].output.value[0] / Q28, start);
}

} // namespace
