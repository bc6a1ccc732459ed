/* Activation functions of the BP network and their derivatives, by table and linear interpolation.
 *
 *   symmetric f(x) = (1 - e^-x) / (1 + e^-x) = tanh(x/2)    (18) of the paper, hidden layer
 *   logistic  g(x) = 1 / (1 + e^-x) = (1 + f(x)) / 2        (19) of the paper, output layer
 */
#ifndef FIXED_SIGMOID_H
#define FIXED_SIGMOID_H

#include <stdint.h>

#include "fixed/dual16.h"
#include "fixed/fixed.h"

#define SIGMOID_RANGE_BITS 26 /* 0..8 in Q23; the table covers -8..8 */
#define SIGMOID_STEP_BITS 19  /* 1/16 in Q23 */
#define SIGMOID_STEPS (1 << (SIGMOID_RANGE_BITS - SIGMOID_STEP_BITS))
#define SIGMOID_FRACTION_BITS 12 /* of the position within a step: Q15 entries give a Q27 result */

extern const int16_t sigmoid_symmetric_q15[2 * SIGMOID_STEPS + 1];

/* f(x), Q4.27, |f| < 1 - 2^-11, for x in Q8.23, the whole range; x saturates at +-8. Error below 8e-5 within +-8, below
 * 7e-4 beyond. x is cut to 16 fraction bits; the products and their sum are exact. */
static inline int32_t sigmoid_symmetric_q27(int32_t x_q23) {
    const int32_t clamped_q23 = fixed_saturate_bits(x_q23, SIGMOID_RANGE_BITS + 1);
    const int16_t *entry = &sigmoid_symmetric_q15[SIGMOID_STEPS] + (clamped_q23 >> SIGMOID_STEP_BITS);
    const int32_t fraction =
        clamped_q23 >> (SIGMOID_STEP_BITS - SIGMOID_FRACTION_BITS) & ((1 << SIGMOID_FRACTION_BITS) - 1);
    return dual16_multiply_add(entry, dual16_pack((1 << SIGMOID_FRACTION_BITS) - fraction, fraction), 0);
}

/* f'(x) = (1 - f^2) / 2 from f in Q4.27, |f| <= 1 - 2^-15; Q32, 0..1/2. Error below 2^-22. */
static inline int32_t sigmoid_symmetric_slope_q32(int32_t f_q27) {
    /* f^2 in Q22 is f^2 / 2 in Q23, 9 bits short of Q32; 1/2 itself would be 2^31, hence INT32_MAX. */
    return INT32_MAX - fixed_multiply_high(f_q27, f_q27) * (1 << 9);
}

/* g(x), Q3.28, from f(x) in Q4.27; half the error of f. */
static inline int32_t sigmoid_logistic_q28(int32_t f_q27) {
    return (1 << 27) + f_q27;
}

/* g'(x) = g (1 - g) = (1 - f^2) / 4 from f(x) in Q4.27; Q33, 0..1/4. Error below 2^-23. */
static inline int32_t sigmoid_logistic_slope_q33(int32_t f_q27) {
    return sigmoid_symmetric_slope_q32(f_q27);
}

#endif
