/* The two activation functions of the network and their slopes.
 *
 *   symmetric f(x) = (1 - e^-x) / (1 + e^-x) = tanh(x/2)    (18) of the paper, hidden layer
 *   logistic  g(x) = 1 / (1 + e^-x) = (1 + f(x)) / 2        (19) of the paper, output layer
 */
#ifndef FIXED_SIGMOID_H
#define FIXED_SIGMOID_H

#include <stdint.h>

#include "fixed/fixed.h"
#include "fixed/high_product.h"

#define SIGMOID_RANGE_BITS 27 /* over 0..16 in Q23 */
#define SIGMOID_STEP_BITS 19  /* of 1/16 each */
#define SIGMOID_STEPS (1 << (SIGMOID_RANGE_BITS - SIGMOID_STEP_BITS))
#define SIGMOID_FRACTION_BITS 12 /* of a step: with the table's 15 the fraction bits of the result */
#define SIGMOID_HALF_Q28 (1 << 27)

extern const int16_t sigmoid_symmetric_q15[SIGMOID_STEPS + 1];

/* f(x), Q4.27, |f| < 1, for x in Q8.23, the whole range, held within +-16; odd but for 1 LSB, as -x is taken as the
 * complement. Error below 8e-5. */
static inline int32_t sigmoid_symmetric_q27(int32_t x_q23) {
    const int32_t within_q23 = fixed_saturate_bits(x_q23, SIGMOID_RANGE_BITS + 1);
    /* -1 or 0. A branch on the sign of a neuron's sum is one that no processor can predict. */
    const int32_t sign = x_q23 >> 31;
    const uint32_t magnitude = (uint32_t)(within_q23 ^ sign);
    const int16_t *entry = &sigmoid_symmetric_q15[magnitude >> SIGMOID_STEP_BITS];
    const int32_t fraction =
        (int32_t)(magnitude >> (SIGMOID_STEP_BITS - SIGMOID_FRACTION_BITS)) & ((1 << SIGMOID_FRACTION_BITS) - 1);
    const int32_t rest = (1 << SIGMOID_FRACTION_BITS) - fraction;
#ifdef __ARM_FEATURE_SIMD32
    /* Both entries in one word, and both products in one instruction. */
    int16x2_t entries;
    __builtin_memcpy(&entries, entry, sizeof entries);
    const int32_t value_q27 = __smuad(entries, rest | fraction << 16);
#else
    const int32_t value_q27 = entry[0] * rest + entry[1] * fraction;
#endif
    return value_q27 ^ sign;
}

/* f'(x) = (1 - f^2) / 2 from f in Q4.27, |f| <= 1 - 2^-15; Q32, 0..1/2, within 2^-22 of it. */
static inline int32_t sigmoid_symmetric_slope_q32(int32_t f_q27) {
    /* The complement of f^2 in its 22 bits, which is at most 1 - 2^-22, in Q32: so f' of 1/2 has no overflow. */
    const uint32_t square_q22 = (uint32_t)high_product(f_q27, f_q27);
    return (int32_t)(~(square_q22 << 10) >> 1);
}

/* g(x), Q3.28, 0 < g < 1, for x in Q8.23, the whole range. Error below 4e-5. */
static inline int32_t sigmoid_logistic_q28(int32_t x_q23) {
    return SIGMOID_HALF_Q28 + sigmoid_symmetric_q27(x_q23);
}

/* g'(x) = g (1 - g) = (1 - f^2) / 4 from g in Q3.28, 2^-16..1 - 2^-16; Q33, 0..1/4, within 2^-23 of it. */
static inline int32_t sigmoid_logistic_slope_q33(int32_t g_q28) {
    return sigmoid_symmetric_slope_q32(g_q28 - SIGMOID_HALF_Q28);
}

#endif
