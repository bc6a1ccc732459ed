/* Three numbers at a time: what the processor loads, or loads and stores, with one instruction. The same bits as the C
 * beside it; products as fixed_multiply_high has them. */
#ifndef FIXED_TRIPLE_H
#define FIXED_TRIPLE_H

#include <stdint.h>

#include "fixed/fixed.h"

/* Three numbers and what moves them. */
typedef struct {
    int32_t value[3];
    int32_t change[3]; /* of one fraction bit less than the values */
} triple_moving_t;

/* sum_k a_k b_k / 2^32, each product rounded; the caller knows every partial sum to fit in a word. */
static inline int32_t triple_dot(const int32_t a[3], int32_t b0, int32_t b1, int32_t b2) {
#if ARM_DSP_TRIPLE
    return arm_triple_dot(a, b0, b1, b2);
#else
    return fixed_multiply_high_add(fixed_multiply_high_add(fixed_multiply_high(a[0], b0), a[1], b1), a[2], b2);
#endif
}

/* sum_k += a_k scale / 2^32, each product rounded; the caller knows the sums to fit in a word. */
static inline void triple_add_scaled(int32_t sum[3], const int32_t a[3], int32_t scale) {
#if ARM_DSP_TRIPLE
    arm_triple_add_scaled(sum, a, scale);
#else
    for (unsigned k = 0; k < 3; k++) {
        sum[k] = fixed_multiply_high_add(sum[k], a[k], scale);
    }
#endif
}

/* change_k = inertia change_k + scale direction_k / 2^32, each product rounded, which the caller knows to fit in a
 * word; value_k = value_k + 2 change_k, saturated. Inertia: Q32, -1/2..1/2 - 2^-32, so that what is left of a change
 * without a scale dies out. */
static inline void triple_move(triple_moving_t *moving, const int32_t direction[3], int32_t scale,
                               int32_t inertia_q32) {
#if ARM_DSP_TRIPLE
    arm_triple_move(moving, direction, scale, inertia_q32);
#else
    for (unsigned k = 0; k < 3; k++) {
        moving->change[k] =
            fixed_multiply_high_add(fixed_multiply_high(moving->change[k], inertia_q32), scale, direction[k]);
        moving->value[k] = fixed_add_twice(moving->value[k], moving->change[k]);
    }
#endif
}

/* The same; returns the triple_dot of the direction and the values as they were before. */
static inline int32_t triple_dot_and_move(triple_moving_t *moving, const int32_t direction[3], int32_t scale,
                                          int32_t inertia_q32) {
#if ARM_DSP_TRIPLE
    return arm_triple_dot_and_move(moving, direction, scale, inertia_q32);
#else
    const int32_t sum = triple_dot(moving->value, direction[0], direction[1], direction[2]);
    triple_move(moving, direction, scale, inertia_q32);
    return sum;
#endif
}

#endif
