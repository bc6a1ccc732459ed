#include "control/bp_network.h"

#include <assert.h>
#include <stddef.h>

#include "fixed/compiler.h"
#include "fixed/sigmoid.h"

static_assert(BP_INPUTS == 3 && BP_OUTPUTS == 3, "inputs and outputs are processed as vectors of three");

static_assert(offsetof(bp_neuron_t, input) == offsetof(bp_neuron_t, output) + sizeof(vec3_momentum_t) &&
                  sizeof(bp_neuron_t) == offsetof(bp_neuron_t, input) + sizeof(vec3_momentum_t),
              "bp_network_learn goes on after each vector");

static int32_t next_weight(uint32_t *generator) {
    *generator = *generator * 1664525u + 1013904223u; /* W. H. Press et al., "Numerical Recipes", ranqd1; modulo 2^32 */
    return (int32_t)(*generator >> 4) - (1 << 27);    /* 28 bits, centred: +-0.5 in Q28 */
}

void bp_network_reset(bp_network_t *network, uint32_t seed) {
    uint32_t generator = seed;
    for (unsigned i = 0; i < BP_HIDDEN; i++) {
        bp_neuron_t *neuron = &network->hidden[i];
        neuron->input.value[1] = next_weight(&generator);
        neuron->input.value[0] = next_weight(&generator);
        neuron->input.value[2] = next_weight(&generator);
        for (unsigned k = 0; k < 3; k++) {
            neuron->input.increment[k] = 0;
            neuron->output.increment[k] = 0;
        }
    }
    for (unsigned l = 0; l < BP_OUTPUTS; l++) {
        for (unsigned i = 0; i < BP_HIDDEN; i++) {
            network->hidden[i].output.value[l] = next_weight(&generator);
        }
    }
}

void bp_network_forward(bp_network_t *network, const int32_t input_q27[BP_INPUTS]) {
    /* Q28 * Q27 to Q23; sums within 3 * 8 and 6 * 8. */
    int32_t sum_q23[BP_OUTPUTS] = {0};
    for (unsigned i = 0; i < BP_HIDDEN; i++) {
        bp_neuron_t *neuron = &network->hidden[i];
        neuron->activation_q27 =
            sigmoid_symmetric_q27(vec3_dot(neuron->input.value, input_q27[0], input_q27[1], input_q27[2]));
        vec3_add_scaled(sum_q23, neuron->output.value, neuron->activation_q27);
    }
    UNROLL(3)
    for (unsigned l = 0; l < BP_OUTPUTS; l++) {
        network->output_q27[l] = sigmoid_symmetric_q27(sum_q23[l]);
    }
}

void bp_network_learn(const bp_network_parameters_t *parameters, bp_network_t *network, int32_t error_q16,
                      const int32_t input_q31[BP_INPUTS], const int32_t sensitivity_q31[BP_OUTPUTS]) {
    const int32_t rate_q31 = parameters->learning_rate_q15 * error_q16;
    const int32_t momentum_q32 = parameters->momentum_q32;
    int32_t delta_q32[BP_OUTPUTS]; /* eta d3 */
    UNROLL(3)
    for (unsigned l = 0; l < BP_OUTPUTS; l++) {
        delta_q32[l] = fixed_multiply_high(fixed_multiply_high(rate_q31, sensitivity_q31[l]),
                                           sigmoid_logistic_slope_q33(network->output_q27[l])) *
                       2;
    }
    bp_neuron_t *neuron = network->hidden;
    for (unsigned i = 0; i < BP_HIDDEN; i++) {
        const int32_t activation_q27 = neuron->activation_q27;
        /* The hidden layer learns through the output weights before their update. */
        int32_t back_q28;
        vec3_momentum_t *input =
            vec3_dot_and_momentum_step(&neuron->output, delta_q32, activation_q27, momentum_q32, &back_q28);
        const int32_t rate_q28 =
            fixed_multiply_high(back_q28, sigmoid_symmetric_slope_q32(activation_q27)); /* eta d2 */
        neuron = vec3_momentum_step(input, input_q31, rate_q28, momentum_q32);
    }
}
