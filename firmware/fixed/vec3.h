/* Vectors of three 32-bit numbers, loaded and stored with one instruction each (LDM, STM) on a processor with DSP
 * extension. The C alternatives give identical results; products are rounded as by fixed_multiply_high(). */
#ifndef FIXED_VEC3_H
#define FIXED_VEC3_H

#include <stdint.h>

#include "fixed/fixed.h"

/* The instructions name up to nine registers, which the compiler can spare only when it optimises. */
#if defined __ARM_FEATURE_DSP && defined __OPTIMIZE__
#define VEC3_IN_REGISTERS 1
#else
#define VEC3_IN_REGISTERS 0
#endif

#if VEC3_IN_REGISTERS
/* The direction is in r8 to r10, the values in r1 to r3, their increments in r4 to r6. */
#define VEC3_MOMENTUM_STEP(scale, momentum)                                                                            \
    "smmulr r4, r4, " momentum "\n\t"                                                                                  \
    "smmulr r5, r5, " momentum "\n\t"                                                                                  \
    "smmulr r6, r6, " momentum "\n\t"                                                                                  \
    "smmlar r4, r8, " scale ", r4\n\t"                                                                                 \
    "smmlar r5, r9, " scale ", r5\n\t"                                                                                 \
    "smmlar r6, r10, " scale ", r6\n\t"                                                                                \
    "qdadd r1, r1, r4\n\t"                                                                                             \
    "qdadd r2, r2, r5\n\t"                                                                                             \
    "qdadd r3, r3, r6\n\t"
#endif

/* Three numbers that are updated by increments with momentum. */
typedef struct {
    int32_t value[3];
    int32_t increment[3]; /* one fraction bit less than the values */
} vec3_momentum_t;

/* sum_k a_k b_k / 2^32, each product rounded to nearest; the caller ensures that every partial sum fits in 32 bits. */
static inline int32_t vec3_dot(const int32_t a[3], int32_t b0, int32_t b1, int32_t b2) {
#if VEC3_IN_REGISTERS
    int32_t sum;
    __asm__("ldm %1, {r1, r2, r3}\n\t"
            "smmulr %0, r1, %2\n\t"
            "smmlar %0, r2, %3, %0\n\t"
            "smmlar %0, r3, %4, %0"
            : "=&r"(sum)
            : "r"(a), "r"(b0), "r"(b1), "r"(b2), "m"(*(const int32_t(*)[3])a)
            : "r1", "r2", "r3");
    return sum;
#else
    return fixed_multiply_high_add(fixed_multiply_high_add(fixed_multiply_high(a[0], b0), a[1], b1), a[2], b2);
#endif
}

/* sum_k += a_k scale / 2^32, each product rounded to nearest; the caller ensures that the sums fit in 32 bits. */
static inline void vec3_add_scaled(int32_t sum[3], const int32_t a[3], int32_t scale) {
#if VEC3_IN_REGISTERS
    __asm__("ldm %3, {r1, r2, r3}\n\t"
            "smmlar %0, r1, %4, %0\n\t"
            "smmlar %1, r2, %4, %1\n\t"
            "smmlar %2, r3, %4, %2"
            : "+r"(sum[0]), "+r"(sum[1]), "+r"(sum[2])
            : "r"(a), "r"(scale), "m"(*(const int32_t(*)[3])a)
            : "r1", "r2", "r3");
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
 * Momentum in Q32, -1/2..1/2 - 2^-32, so that with scale 0 an increment decays to exactly 0. */
static inline void vec3_momentum_step(vec3_momentum_t *vector, const int32_t direction[3], int32_t scale,
                                      int32_t momentum_q32) {
#if VEC3_IN_REGISTERS
    register const int32_t *first __asm__("r8") = direction;
    __asm__ volatile(
        "ldm r8, {r8, r9, r10}\n\t"
        "ldm %1, {r1, r2, r3, r4, r5, r6}\n\t" VEC3_MOMENTUM_STEP("%2", "%3") "stm %1, {r1, r2, r3, r4, r5, r6}"
        : "+r"(first)
        : "r"(vector), "r"(scale), "r"(momentum_q32)
        : "r1", "r2", "r3", "r4", "r5", "r6", "r9", "r10", "memory");
#else
    for (unsigned k = 0; k < 3; k++) {
        vector->increment[k] =
            fixed_multiply_high_add(fixed_multiply_high(vector->increment[k], momentum_q32), scale, direction[k]);
        vector->value[k] = fixed_add_twice(vector->value[k], vector->increment[k]);
    }
#endif
}

/* vec3_momentum_step(); returns the vec3_dot() of the direction and the values before the step. */
static inline int32_t vec3_dot_and_momentum_step(vec3_momentum_t *vector, const int32_t direction[3], int32_t scale,
                                                 int32_t momentum_q32) {
#if VEC3_IN_REGISTERS
    int32_t sum;
    register const int32_t *first __asm__("r8") = direction;
    __asm__ volatile("ldm r8, {r8, r9, r10}\n\t"
                     "ldm %2, {r1, r2, r3, r4, r5, r6}\n\t"
                     "smmulr %0, r8, r1\n\t"
                     "smmlar %0, r9, r2, %0\n\t"
                     "smmlar %0, r10, r3, %0\n\t" VEC3_MOMENTUM_STEP("%3", "%4") "stm %2, {r1, r2, r3, r4, r5, r6}"
                     : "=&r"(sum), "+r"(first)
                     : "r"(vector), "r"(scale), "r"(momentum_q32)
                     : "r1", "r2", "r3", "r4", "r5", "r6", "r9", "r10", "memory");
    return sum;
#else
    const int32_t sum = vec3_dot(vector->value, direction[0], direction[1], direction[2]);
    vec3_momentum_step(vector, direction, scale, momentum_q32);
    return sum;
#endif
}

#endif
