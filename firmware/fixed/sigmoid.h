/* The two activation functions of the network and their slopes.
 *
 *   symmetric f(x) = (1 - e^-x) / (1 + e^-x) = tanh(x/2)    (18) of the paper, hidden layer
 *   logistic  g(x) = 1 / (1 + e^-x) = (1 + f(x)) / 2        (19) of the paper, output layer
 */
#ifndef FIXED_SIGMOID_H
#define FIXED_SIGMOID_H

#include <stdint.h>

/* f(x), Q1.15, |f| <= 32767, for x in Q19.12, the whole range; odd to the bit. Error below 6e-5 (2 LSB). */
int32_t sigmoid_symmetric_q15(int32_t x_q12);

/* f'(x) = (1 - f^2) / 2 from f in Q1.15, |f| <= 32768; Q1.15, truncated by less than 1 LSB. */
int32_t sigmoid_symmetric_slope_q15(int32_t f_q15);

/* g(x), Q1.15, 1..32768, for x in Q19.12. Error below 5e-5. */
int32_t sigmoid_logistic_q15(int32_t x_q12);

/* g'(x) = g (1 - g) from g in Q1.15, 0..32768; Q1.15, truncated by less than 1 LSB. */
int32_t sigmoid_logistic_slope_q15(int32_t g_q15);

#endif
