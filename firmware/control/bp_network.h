/* Back-propagation (BP) network 3-6-3 with online learning, (16) to (27) of the paper with errata corrected:
 *
 *   hidden  net2_i = sum_j W2_ij x_j,   O2_i = f(net2_i)        (17), indices corrected
 *   output  net3_l = sum_i W3_li O2_i,  O3_l = g(net3_l)        (20), indices corrected
 *   dW3_li(k) = eta d3_l O2_i + alpha dW3_li(k-1)               (26): alpha dW as in (22), published as alpha W, which
 *                                                               makes every weight grow without bound
 *   d3_l = e sgn(dy/du) (du/dO3_l) g'(net3_l)
 *   dW2_ij(k) = eta d2_i x_j + alpha dW2_ij(k-1)                (27)
 *   d2_i = f'(net2_i) sum_l d3_l W3_li
 *
 * Gradient descent with momentum alpha: D. E. Rumelhart, G. E. Hinton, R. J. Williams, "Learning representations by
 * back-propagating errors", Nature 323, 1986.
 *
 * Formats: inputs and activations Q4.27; weights Q3.28, saturating at +-8, their increments Q4.27; sums of a layer
 * Q8.23, within 6 * 8. Accumulators: 32 bits; every product is rounded to nearest in the format of its sum
 * (fixed_multiply_high). With f' <= 1/2, d3 <= 1/4 and eta <= 1, |eta d2| <= 3 * 8 / 8, and with alpha < 1/2 an
 * increment is within +-6: no sum overflows.
 */
#ifndef CONTROL_BP_NETWORK_H
#define CONTROL_BP_NETWORK_H

#include <stdint.h>

#include "fixed/vec3.h"

#define BP_INPUTS 3
#define BP_HIDDEN 6
#define BP_OUTPUTS 3

typedef struct {
    int32_t learning_rate_q15; /* eta, Q1.15, 0..1 */
    int32_t momentum_q32;      /* momentum alpha, Q0.32, 0..1/2 - 2^-32 */
} bp_network_parameters_t;

/* Hidden neuron: activation O2_i, weights in Q3.28 and their increments in Q4.27. */
typedef struct {
    int32_t activation_q27;
    vec3_momentum_t output; /* W3_li, by output l */
    vec3_momentum_t input;  /* W2_ij, by input j */
} bp_neuron_t;

typedef struct {
    bp_neuron_t hidden[BP_HIDDEN];
    int32_t output_q27[BP_OUTPUTS]; /* f(net3); O3 = g(net3) = (1 + f(net3)) / 2 */
} bp_network_t;

/* Initial weights: uniform in +-0.5 from a linear congruential generator, so that a seed gives the same weights on
 * every platform; drawn neuron by neuron, second input first, then output by output. Activations are not reset: a
 * forward pass must precede learning. */
void bp_network_reset(bp_network_t *network, uint32_t seed);

/* Forward pass for inputs in Q4.27, |input| <= 1; activations are stored in the network for learning. */
void bp_network_forward(bp_network_t *network, const int32_t input_q27[BP_INPUTS]);

/* One gradient step for the last forward pass: error e in Q1.16, -1..1 - 2^-16; inputs of that pass and sensitivity
 * du/dO3 in Q0.31. sgn(dy/du) is 1: more voltage gives more torque. */
void bp_network_learn(const bp_network_parameters_t *parameters, bp_network_t *network, int32_t error_q16,
                      const int32_t input_q31[BP_INPUTS], const int32_t sensitivity_q31[BP_OUTPUTS]);

#endif
