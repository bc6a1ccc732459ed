#include "control/bp_network.h"

#include "fixed/fixed.h"
#include "fixed/sigmoid.h"

#define WEIGHT_TO_PRODUCT 16 /* Q3.28 to Q3.12 */

static int32_t next_weight(uint32_t *generator) {
    *generator = *generator * 1664525u + 1013904223u; /* Numerical Recipes, modulo 2^32 */
    return (int32_t)(*generator >> 4) - (1 << 27);    /* 28 bits, centred: +-0.5 in Q28 */
}

void bp_network_reset(bp_network_t *network, uint32_t seed) {
    uint32_t generator = seed;
    *network = (bp_network_t){0};
    for (unsigned i = 0; i < BP_HIDDEN; i++) {
        for (unsigned j = 0; j < BP_INPUTS; j++) {
            network->hidden_weight_q28[i][j] = next_weight(&generator);
        }
    }
    for (unsigned l = 0; l < BP_OUTPUTS; l++) {
        for (unsigned i = 0; i < BP_HIDDEN; i++) {
            network->output_weight_q28[l][i] = next_weight(&generator);
        }
    }
}

/* Weighted sum in Q12, |sum| <= 6 * 8: products Q12 * Q15, summed in 64 bits. */
static inline int32_t weighted_sum_q12(const int32_t *weight_q28, const int32_t *value_q15, unsigned count) {
    int64_t sum_q27 = 0;
#pragma GCC unroll 6
    for (unsigned k = 0; k < count; k++) {
        sum_q27 += (int64_t)(weight_q28[k] >> WEIGHT_TO_PRODUCT) * value_q15[k];
    }
    return (int32_t)fixed_shift(sum_q27, 15);
}

void bp_network_forward(bp_network_t *network, const int32_t input_q15[BP_INPUTS]) {
    for (unsigned j = 0; j < BP_INPUTS; j++) {
        network->input_q15[j] = input_q15[j];
    }
    for (unsigned i = 0; i < BP_HIDDEN; i++) {
        network->hidden_q15[i] =
            sigmoid_symmetric_q15(weighted_sum_q12(network->hidden_weight_q28[i], network->input_q15, BP_INPUTS));
    }
    for (unsigned l = 0; l < BP_OUTPUTS; l++) {
        network->output_q15[l] =
            sigmoid_logistic_q15(weighted_sum_q12(network->output_weight_q28[l], network->hidden_q15, BP_HIDDEN));
    }
}

/* Moves the weights of one neuron: eta d (Q30) times value (Q15) is Q45, to Q28; inertia Q28 * Q15, to Q28. With
 * |eta d| < 2^32 and |value| <= 2^15 the gradient is within 2^30, with inertia <= 1 its part is within the last change:
 * both fit in a word, only their sum may not. */
static inline void move_weights(int32_t *restrict weight_q28, int32_t *restrict change_q28,
                                const int32_t *restrict value_q15, unsigned count, int64_t rate_delta_q30,
                                int32_t inertia_q15) {
#pragma GCC unroll 6
    for (unsigned k = 0; k < count; k++) {
        const int32_t gradient_q28 = (int32_t)fixed_shift(rate_delta_q30 * value_q15[k], 17);
        const int32_t inertia_q28 = (int32_t)fixed_shift((int64_t)change_q28[k] * inertia_q15, 15);
        change_q28[k] = fixed_add(gradient_q28, inertia_q28);
        weight_q28[k] = fixed_add(weight_q28[k], change_q28[k]);
    }
}

void bp_network_learn(const bp_network_parameters_t *parameters, bp_network_t *network, int32_t error_q15,
                      const int32_t sensitivity_q15[BP_OUTPUTS]) {
    int32_t output_delta_q30[BP_OUTPUTS]; /* within 2^28: a slope is at most 1/4 */
    for (unsigned l = 0; l < BP_OUTPUTS; l++) {
        const int32_t product_q30 = error_q15 * sensitivity_q15[l];
        output_delta_q30[l] =
            (int32_t)fixed_shift((int64_t)product_q30 * sigmoid_logistic_slope_q15(network->output_q15[l]), 15);
    }
    /* The hidden layer learns through the output weights as they were in this sample: before those move. */
    for (unsigned i = 0; i < BP_HIDDEN; i++) {
        int64_t back_q42 = 0; /* 3 * 2^28 * 2^15 */
        for (unsigned l = 0; l < BP_OUTPUTS; l++) {
            back_q42 += (int64_t)output_delta_q30[l] * (network->output_weight_q28[l][i] >> WEIGHT_TO_PRODUCT);
        }
        const int64_t delta_q30 =
            fixed_shift(fixed_shift(back_q42, 12) * sigmoid_symmetric_slope_q15(network->hidden_q15[i]), 15);
        move_weights(network->hidden_weight_q28[i], network->hidden_change_q28[i], network->input_q15, BP_INPUTS,
                     fixed_shift(delta_q30 * parameters->learning_rate_q15, 15), parameters->inertia_q15);
    }
    for (unsigned l = 0; l < BP_OUTPUTS; l++) {
        move_weights(network->output_weight_q28[l], network->output_change_q28[l], network->hidden_q15, BP_HIDDEN,
                     (int32_t)fixed_shift((int64_t)output_delta_q30[l] * parameters->learning_rate_q15, 15),
                     parameters->inertia_q15);
    }
}
