/* Three numbers at a time: what the processor loads, or loads and stores, with one instruction. The same bits as the C
 * beside it; products as fixed_multiply_high has them. */
#ifndef FIXED_TRIPLE_H
#define FIXED_TRIPLE_H

#include <stdint.h>

#include "fixed/fixed.h"

/* The instructions name up to nine registers, which the compiler can spare only when it optimises. */
#if defined __ARM_FEATURE_DSP && defined __OPTIMIZE__
#define TRIPLE_IN_REGISTERS 1
#else
#define TRIPLE_IN_REGISTERS 0
#endif

#if TRIPLE_IN_REGISTERS
/* The direction is in r8 to r10, the values in r1 to r3, their changes in r4 to r6. */
#define TRIPLE_MOVE(scale, inertia)                                                                                    \
    "smmulr r4, r4, " inertia "\n\t"                                                                                   \
    "smmulr r5, r5, " inertia "\n\t"                                                                                   \
    "smmulr r6, r6, " inertia "\n\t"                                                                                   \
    "smmlar r4, r8, " scale ", r4\n\t"                                                                                 \
    "smmlar r5, r9, " scale ", r5\n\t"                                                                                 \
    "smmlar r6, r10, " scale ", r6\n\t"                                                                                \
    "qdadd r1, r1, r4\n\t"                                                                                             \
    "qdadd r2, r2, r5\n\t"                                                                                             \
    "qdadd r3, r3, r6\n\t"
#endif

/* Three numbers and what moves them. */
typedef struct {
    int32_t value[3];
    int32_t change[3]; /* of one fraction bit less than the values */
} triple_moving_t;

/* sum_k a_k b_k / 2^32, each product rounded; the caller knows every partial sum to fit in a word. */
static inline int32_t triple_dot(const int32_t a[3], int32_t b0, int32_t b1, int32_t b2) {
#if TRIPLE_IN_REGISTERS
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

/* sum_k += a_k scale / 2^32, each product rounded; the caller knows the sums to fit in a word. */
static inline void triple_add_scaled(int32_t sum[3], const int32_t a[3], int32_t scale) {
#if TRIPLE_IN_REGISTERS
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

/* change_k = inertia change_k + scale direction_k / 2^32, each product rounded, which the caller knows to fit in a
 * word; value_k = value_k + 2 change_k, saturated. Inertia: Q32, -1/2..1/2 - 2^-32, so that what is left of a change
 * without a scale dies out. */
static inline void triple_move(triple_moving_t *moving, const int32_t direction[3], int32_t scale,
                               int32_t inertia_q32) {
#if TRIPLE_IN_REGISTERS
    register const int32_t *first __asm__("r8") = direction;
    __asm__ volatile("ldm r8, {r8, r9, r10}\n\t"
                     "ldm %1, {r1, r2, r3, r4, r5, r6}\n\t" TRIPLE_MOVE("%2", "%3") "stm %1, {r1, r2, r3, r4, r5, r6}"
                     : "+r"(first)
                     : "r"(moving), "r"(scale), "r"(inertia_q32)
                     : "r1", "r2", "r3", "r4", "r5", "r6", "r9", "r10", "memory");
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
#if TRIPLE_IN_REGISTERS
    int32_t sum;
    register const int32_t *first __asm__("r8") = direction;
    __asm__ volatile("ldm r8, {r8, r9, r10}\n\t"
                     "ldm %2, {r1, r2, r3, r4, r5, r6}\n\t"
                     "smmulr %0, r8, r1\n\t"
                     "smmlar %0, r9, r2, %0\n\t"
                     "smmlar %0, r10, r3, %0\n\t" TRIPLE_MOVE("%3", "%4") "stm %2, {r1, r2, r3, r4, r5, r6}"
                     : "=&r"(sum), "+r"(first)
                     : "r"(moving), "r"(scale), "r"(inertia_q32)
                     : "r1", "r2", "r3", "r4", "r5", "r6", "r9", "r10", "memory");
    return sum;
#else
    const int32_t sum = triple_dot(moving->value, direction[0], direction[1], direction[2]);
    triple_move(moving, direction, scale, inertia_q32);
    return sum;
#endif
}

#endif
