/* Back-propagation network 3-6-3 with online learning: (16) to (27) of the paper, misprints mended.
 *
 *   hidden  net2_i = sum_j W2_ij x_j,   O2_i = f(net2_i)        (17), indices put right
 *   output  net3_l = sum_i W3_li O2_i,  O3_l = g(net3_l)        (20), indices put right
 *   dW3_li(k) = eta d3_l O2_i + alpha dW3_li(k-1)               (26): alpha dW, not alpha W, which grows every weight
 *   d3_l = e sgn(dy/du) (du/dO3_l) g'(net3_l)
 *   dW2_ij(k) = eta d2_i x_j + alpha dW2_ij(k-1)                (27)
 *   d2_i = f'(net2_i) sum_l d3_l W3_li
 *
 * Formats: inputs and activations Q1.15, weights and their increments Q3.28 held within +-8 (saturation), of which the
 * top 16 bits (Q3.12, truncated) enter products; sums in 64 bits; d3, d2 in Q1.30.
 */
#ifndef CONTROL_BP_NETWORK_H
#define CONTROL_BP_NETWORK_H

#include <stdint.h>

#define BP_INPUTS 3
#define BP_HIDDEN 6
#define BP_OUTPUTS 3

typedef struct {
    int32_t learning_rate_q15; /* eta, Q1.15, 0..1 */
    int32_t inertia_q15;       /* alpha, Q1.15, 0..1 */
} bp_network_parameters_t;

typedef struct {
    int32_t hidden_weight_q28[BP_HIDDEN][BP_INPUTS];
    int32_t output_weight_q28[BP_OUTPUTS][BP_HIDDEN];
    int32_t hidden_change_q28[BP_HIDDEN][BP_INPUTS];
    int32_t output_change_q28[BP_OUTPUTS][BP_HIDDEN];
    int32_t input_q15[BP_INPUTS];
    int32_t hidden_q15[BP_HIDDEN];
    int32_t output_q15[BP_OUTPUTS]; /* 0..32768 */
} bp_network_t;

/* Initial weights: uniform in +-0.5 from a linear congruential generator, so that a seed gives the same on any machine.
 */
void bp_network_reset(bp_network_t *network, uint32_t seed);

/* Outputs for inputs in Q1.15, |input| <= 32767; the layers' values stay in the network for learning. */
void bp_network_forward(bp_network_t *network, const int32_t input_q15[BP_INPUTS]);

/* One step down the gradient for the last forward pass: error e and du/dO3 in Q1.15, |value| <= 32768; sgn(dy/du) is 1,
 * more voltage gives more torque. */
void bp_network_learn(const bp_network_parameters_t *parameters, bp_network_t *network, int32_t error_q15,
                      const int32_t sensitivity_q15[BP_OUTPUTS]);

#endif
