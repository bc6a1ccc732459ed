/* Back-propagation network 3-6-3 with online learning: (16) to (27) of the paper, misprints mended.
 *
 *   hidden  net2_i = sum_j W2_ij x_j,   O2_i = f(net2_i)        (17), indices put right
 *   output  net3_l = sum_i W3_li O2_i,  O3_l = g(net3_l)        (20), indices put right
 *   dW3_li(k) = eta d3_l O2_i + alpha dW3_li(k-1)               (26): alpha dW, not alpha W, which grows every weight
 *   d3_l = e sgn(dy/du) (du/dO3_l) g'(net3_l)
 *   dW2_ij(k) = eta d2_i x_j + alpha dW2_ij(k-1)                (27)
 *   d2_i = f'(net2_i) sum_l d3_l W3_li
 *
 * Formats: inputs and activations Q4.27; weights Q3.28 held within +-8 (saturation), their increments Q4.27; sums of a
 * layer Q8.23, within 6 * 8. Every product is rounded to the format of its sum (fixed_multiply_high). With f' <= 1/2,
 * d3 <= 1/4 and eta <= 1, eta d2 is within 3 * 8 / 8, and with alpha < 1/2 an increment within 6.
 */
#ifndef CONTROL_BP_NETWORK_H
#define CONTROL_BP_NETWORK_H

#include <stdint.h>

#include "fixed/triple.h"

#define BP_INPUTS 3
#define BP_HIDDEN 6
#define BP_OUTPUTS 3

typedef struct {
    int32_t learning_rate_q15; /* eta, Q1.15, 0..1 */
    int32_t inertia_q32;       /* alpha, Q32, 0..1/2 - 2^-32 */
} bp_network_parameters_t;

/* A hidden neuron with its weights in Q3.28 and their changes in Q4.27. */
typedef struct {
    int32_t value_q27;
    triple_moving_t output; /* W3_li, by output l */
    triple_moving_t input;  /* W2_ij, by input j */
} bp_neuron_t;

typedef struct {
    bp_neuron_t hidden[BP_HIDDEN];
    int32_t output_q27[BP_OUTPUTS]; /* f(net3): O3 is the logistic function, (1 + f) / 2 */
} bp_network_t;

/* Initial weights: uniform in +-0.5 from a linear congruential generator, so that a seed gives the same on any machine;
 * drawn neuron by neuron, for its second input first, then output by output. The layers' values are those of the next
 * forward pass. */
void bp_network_reset(bp_network_t *network, uint32_t seed);

/* Outputs for inputs in Q4.27, |input| <= 1; the layers' values stay in the network for learning. */
void bp_network_forward(bp_network_t *network, const int32_t input_q27[BP_INPUTS]);

/* One step down the gradient for the last forward pass: error e in Q1.16, -1..1 - 2^-16, its inputs and du/dO3 in
 * Q0.31; sgn(dy/du) is 1, more voltage gives more torque. */
void bp_network_learn(const bp_network_parameters_t *parameters, bp_network_t *network, int32_t error_q16,
                      const int32_t input_q31[BP_INPUTS], const int32_t sensitivity_q31[BP_OUTPUTS]);

#endif
