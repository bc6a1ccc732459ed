/* Products of two words of which the upper word is kept, and what goes with them: one instruction each on a processor
 * with the DSP extension, of the same bits as the C beside it.
 *
 * The binary points add up less 32: Q31 times Q31 is Q30. Rounded to nearest (halves towards plus infinity): a sum that
 * goes on for hours must not drift by what truncation leaves out. */
#ifndef FIXED_HIGH_PRODUCT_H
#define FIXED_HIGH_PRODUCT_H

#include <stdint.h>

#include "fixed/fixed.h"

/* a b / 2^32. Cannot overflow: within 2^30. */
static inline int32_t high_product(int32_t a, int32_t b) {
#ifdef __ARM_FEATURE_DSP
    int32_t product;
    __asm__("smmulr %0, %1, %2" : "=r"(product) : "r"(a), "r"(b));
    return product;
#else
    return (int32_t)(((int64_t)a * b + ((int64_t)1 << 31)) >> 32);
#endif
}

/* sum + a b / 2^32, which the caller knows to fit in a word. */
static inline int32_t high_product_add(int32_t sum, int32_t a, int32_t b) {
#ifdef __ARM_FEATURE_DSP
    int32_t result;
    __asm__("smmlar %0, %1, %2, %3" : "=r"(result) : "r"(a), "r"(b), "r"(sum));
    return result;
#else
    return sum + high_product(a, b);
#endif
}

/* Nearest number of `bits` bits with its sign, 1..32, a constant. */
static inline int32_t fixed_saturate_bits(int32_t value, unsigned bits) {
#if defined __ARM_FEATURE_SAT && defined __OPTIMIZE__
    int32_t result;
    __asm__("ssat %0, %1, %2" : "=r"(result) : "I"(bits), "r"(value));
    return result;
#else
    return fixed_clamp(value, INT32_MIN >> (32 - bits), INT32_MAX >> (32 - bits));
#endif
}

/* a + 2 b, saturated, 2 b on its own before. */
static inline int32_t fixed_add_twice(int32_t a, int32_t b) {
#ifdef __ARM_FEATURE_DSP
    int32_t sum;
    __asm__("qdadd %0, %1, %2" : "=r"(sum) : "r"(a), "r"(b));
    return sum;
#else
    return fixed_add(a, fixed_add(b, b));
#endif
}

#endif
