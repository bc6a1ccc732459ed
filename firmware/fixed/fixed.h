/* Fixed-point arithmetic: every operation saturates or states why it cannot overflow.
 *
 * Notation: Qm.n is a signed number with m integer bits and n fraction bits; `speed_q22` holds Q9.22. An unsigned
 * format is called unsigned. Unless a function states otherwise, products are formed in 64 bits, rounded to nearest
 * (halves towards plus infinity) and saturated.
 *
 * Right shifts of negative numbers are arithmetic: C leaves that to the compiler, the assertion below pins it.
 */
#ifndef FIXED_FIXED_H
#define FIXED_FIXED_H

#include <assert.h>
#include <stdint.h>

#include "fixed/arm_dsp.h"
#include "fixed/compiler.h"

static_assert((-3 >> 1) == -2, "right shift of a negative number must be arithmetic");

/* numerator / denominator in a format, rounded to nearest; numerator >= 0. A constant expression. */
#define FIXED_CONSTANT(numerator, denominator, fraction_bits)                                                          \
    ((int32_t)((((int64_t)(numerator) << (fraction_bits)) + (denominator) / 2) / (denominator)))

/* Saturates to 32 bits. */
static inline int32_t fixed_saturate(int64_t value) {
    const int32_t low_word = (int32_t)value;
    const int32_t high_word = (int32_t)(value >> 32);
    /* The value fits when the high word is only copies of the sign bit. */
    if (high_word == low_word >> 31) {
        return low_word;
    }
    return INT32_MAX ^ (high_word >> 31);
}

static inline int32_t fixed_min(int32_t a, int32_t b) {
    return a < b ? a : b;
}

static inline int32_t fixed_max(int32_t a, int32_t b) {
    return a > b ? a : b;
}

static inline uint32_t fixed_min_u32(uint32_t a, uint32_t b) {
    return a < b ? a : b;
}

static inline uint32_t fixed_max_u32(uint32_t a, uint32_t b) {
    return a > b ? a : b;
}

static inline int32_t fixed_clamp(int32_t value, int32_t low, int32_t high) {
    if (value > high) {
        return high;
    }
    return value < low ? low : value;
}

static inline int64_t fixed_clamp_64(int64_t value, int64_t low, int64_t high) {
    if (value > high) {
        return high;
    }
    return value < low ? low : value;
}

/* Right shift that brings a magnitude below 2^bits, bits 1..63. For a negative number, as a sum of squares that has
 * changed in memory may be, it is the shift of the largest ones. */
static inline unsigned fixed_shift_below(uint64_t magnitude, unsigned bits) {
    const uint64_t above = magnitude >> bits;
    return above != 0 ? 64u - (unsigned)__builtin_clzll(above) : 0;
}

/* Saturating sum and difference: one instruction each on a processor with DSP extension, with identical results. */
static inline int32_t fixed_add(int32_t a, int32_t b) {
#ifdef __ARM_FEATURE_DSP
    return __qadd(a, b);
#else
    int32_t sum;
    if (__builtin_add_overflow(a, b, &sum)) {
        return a < 0 ? INT32_MIN : INT32_MAX;
    }
    return sum;
#endif
}

static inline int32_t fixed_subtract(int32_t a, int32_t b) {
#ifdef __ARM_FEATURE_DSP
    return __qsub(a, b);
#else
    int32_t difference;
    if (__builtin_sub_overflow(a, b, &difference)) {
        return a < 0 ? INT32_MIN : INT32_MAX;
    }
    return difference;
#endif
}

/* Magnitude; saturates: INT32_MAX for INT32_MIN. */
static inline int32_t fixed_abs(int32_t value) {
    const int32_t sign = value >> 31; /* -1 or 0: -v is ~v + 1 */
    return fixed_subtract(value ^ sign, sign);
}

/* Magnitude of any value, unsigned: an instruction less than fixed_abs(). */
static inline uint32_t fixed_magnitude(int32_t value) {
    const uint32_t sign = (uint32_t)(value >> 31);
    return ((uint32_t)value ^ sign) - sign;
}

/* Value, or 0 when it is negative. */
static inline int32_t fixed_non_negative(int32_t value) {
#ifdef __ARM_FEATURE_DSP
    return arm_usat31(value);
#else
    return value & ~(value >> 31);
#endif
}

/* Value saturated to 0..2^16 - 1. */
static inline int32_t fixed_saturate_u16(int32_t value) {
#ifdef __ARM_FEATURE_DSP
    return arm_usat16(value);
#else
    return fixed_clamp(value, 0, UINT16_MAX);
#endif
}

/* a * b, exact. Written as an instruction because the compiler otherwise sign-extends a factor of several products once
 * and multiplies 64-bit words. */
static inline int64_t fixed_product(int32_t a, int32_t b) {
#ifdef __ARM_FEATURE_DSP
    return arm_smull(a, b);
#else
    return (int64_t)a * b;
#endif
}

/* sum + a * b; wraps. */
static inline int64_t fixed_accumulate(int64_t sum, int32_t a, int32_t b) {
#ifdef __ARM_FEATURE_DSP
    return arm_smlal(sum, a, b);
#else
    return (int64_t)((uint64_t)sum + (uint64_t)((int64_t)a * b));
#endif
}

/* value / 2^shift, rounded to nearest; shift 1..62. Cannot overflow for value < 2^63 - 2^(shift-1). */
static inline int64_t fixed_shift(int64_t value, unsigned shift) {
    return (value + ((int64_t)1 << (shift - 1))) >> shift;
}

/* a * b / 2^shift, rounded and saturated; shift 1..62. */
static inline int32_t fixed_multiply(int32_t a, int32_t b, unsigned shift) {
    return fixed_saturate(fixed_shift((int64_t)a * b, shift));
}

/* a * b / 2^32, rounded to nearest; cannot overflow. One instruction (SMMULR) on a processor with DSP extension, hence
 * the choice of many formats such that their products end here. */
static inline int32_t fixed_multiply_high(int32_t a, int32_t b) {
#ifdef __ARM_FEATURE_DSP
    return arm_smmulr(a, b);
#else
    return (int32_t)fixed_shift((int64_t)a * b, 32);
#endif
}

/* sum + a * b / 2^32, the product rounded to nearest; the caller ensures that the sum fits. */
static inline int32_t fixed_multiply_high_add(int32_t sum, int32_t a, int32_t b) {
#ifdef __ARM_FEATURE_DSP
    return arm_smmlar(sum, a, b);
#else
    return sum + fixed_multiply_high(a, b);
#endif
}

/* a + 2 b; first 2 b saturates, then the sum. */
static inline int32_t fixed_add_twice(int32_t a, int32_t b) {
    return fixed_add(a, fixed_add(b, b));
}

/* Saturates to `bits` bits including the sign, 1..32, a constant: one instruction (SSAT) where the processor has it. */
ALWAYS_INLINE int32_t fixed_saturate_bits(int32_t value, unsigned bits) {
#if defined __ARM_FEATURE_SAT && defined __OPTIMIZE__
    return ARM_SSAT(value, bits);
#else
    return fixed_clamp(value, INT32_MIN >> (32 - bits), INT32_MAX >> (32 - bits));
#endif
}

/* value * 2^shift, which fits in 32 bits, saturated as fixed_saturate_bits(); shift 1..31, a constant. */
ALWAYS_INLINE int32_t fixed_shift_up_saturate_bits(int32_t value, unsigned shift, unsigned bits) {
#if defined __ARM_FEATURE_SAT && defined __OPTIMIZE__
    return ARM_SSAT_SHIFTED(value, shift, bits);
#else
    return fixed_saturate_bits((int32_t)((uint32_t)value << shift), bits);
#endif
}

/* value / 2^shift, rounded down; shift 1..31, a constant. Saturates to within 2^(32-shift) of INT32_MIN or INT32_MAX:
 * only the high word saturates, in one instruction, the low bits of the result pass unchanged. */
ALWAYS_INLINE int32_t fixed_words_shift_saturate(int32_t high, uint32_t low, unsigned shift) {
    return (int32_t)((uint32_t)fixed_saturate_bits(high, shift) << (32 - shift) | low >> shift);
}

ALWAYS_INLINE int32_t fixed_shift_saturate(int64_t value, unsigned shift) {
    return fixed_words_shift_saturate((int32_t)(value >> 32), (uint32_t)value, shift);
}

/* a * b / 2^shift, as fixed_shift_saturate(). */
ALWAYS_INLINE int32_t fixed_product_shift_saturate(int32_t a, int32_t b, unsigned shift) {
#ifdef __ARM_FEATURE_DSP
    uint32_t low;
    const int32_t high = arm_smull_words(a, b, &low);
    return fixed_words_shift_saturate(high, low, shift);
#else
    return fixed_shift_saturate(fixed_product(a, b), shift);
#endif
}

/* a * b / 2^shift, rounded to nearest; saturates as fixed_shift_saturate(); shift 1..31, a constant: half of the
 * instructions of fixed_multiply(). */
ALWAYS_INLINE int32_t fixed_multiply_shift(int32_t a, int32_t b, unsigned shift) {
    return fixed_shift_saturate(fixed_accumulate((int64_t)1 << (shift - 1), a, b), shift);
}

#endif
