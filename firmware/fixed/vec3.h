/* Vectors of three 32-bit numbers, loaded and stored with one instruction each (LDM, STM) on a processor with DSP
 * extension. The C alternatives give identical results; products are rounded as by fixed_multiply_high(). */
#ifndef FIXED_VEC3_H
#define FIXED_VEC3_H

#include <stdint.h>

#include "fixed/fixed.h"

/* Three numbers that are updated by increments with momentum. */
typedef struct {
    int32_t value[3];
    int32_t increment[3]; /* one fraction bit less than the values */
} vec3_momentum_t;

/* sum_k a_k b_k / 2^32, each product rounded to nearest; the caller ensures that every partial sum fits in 32 bits. */
static inline int32_t vec3_dot(const int32_t a[3], int32_t b0, int32_t b1, int32_t b2) {
#if ARM_DSP_VEC3
    return arm_vec3_dot(a, b0, b1, b2);
#else
    return fixed_multiply_high_add(fixed_multiply_high_add(fixed_multiply_high(a[0], b0), a[1], b1), a[2], b2);
#endif
}

/* sum_k += a_k scale / 2^32, each product rounded to nearest; the caller ensures that the sums fit in 32 bits. */
static inline void vec3_add_scaled(int32_t sum[3], const int32_t a[3], int32_t scale) {
#if ARM_DSP_VEC3
    arm_vec3_add_scaled(sum, a, scale);
#else
    for (unsigned k = 0; k < 3; k++) {
        sum[k] = fixed_multiply_high_add(sum[k], a[k], scale);
    }
#endif
}

/* Gradient step with momentum:
 *
 *   increment_k = momentum increment_k + scale direction_k / 2^32     each product rounded; the caller ensures it fits
 *   value_k     = value_k + 2 increment_k                             saturates
 *
 * Momentum in Q32, -1/2..1/2 - 2^-32, so that with scale 0 an increment decays to exactly 0. Returns the address after
 * the vector, where a loop goes on: 12 of the computed bound of paper. */
static inline void *vec3_momentum_step(vec3_momentum_t *vector, const int32_t direction[3], int32_t scale,
                                       int32_t momentum_q32) {
#if ARM_DSP_VEC3
    return arm_vec3_momentum_step(vector, direction, scale, momentum_q32);
#else
    for (unsigned k = 0; k < 3; k++) {
        vector->increment[k] =
            fixed_multiply_high_add(fixed_multiply_high(vector->increment[k], momentum_q32), scale, direction[k]);
        vector->value[k] = fixed_add_twice(vector->value[k], vector->increment[k]);
    }
    return vector + 1;
#endif
}

/* vec3_momentum_step(); *dot becomes the vec3_dot() of the direction and the values before the step. */
static inline void *vec3_dot_and_momentum_step(vec3_momentum_t *vector, const int32_t direction[3], int32_t scale,
                                               int32_t momentum_q32, int32_t *dot) {
#if ARM_DSP_VEC3
    return arm_vec3_dot_and_momentum_step(vector, direction, scale, momentum_q32, dot);
#else
    *dot = vec3_dot(vector->value, direction[0], direction[1], direction[2]);
    return vec3_momentum_step(vector, direction, scale, momentum_q32);
#endif
}

#endif
