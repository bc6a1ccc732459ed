/* Instructions of the Cortex-M4's DSP extension that the compiler does not select from C. Each function has a C
 * equivalent of the same bits at its only caller in fixed.h, dual16.h or vec3.h. */
#ifndef FIXED_ARM_DSP_H
#define FIXED_ARM_DSP_H

#ifdef __ARM_FEATURE_DSP

#include <arm_acle.h>
#include <stdint.h>

/* a * b. The compiler would widen a factor of several products once and then multiply words of 64 bits. */
static inline int64_t arm_smull(int32_t a, int32_t b) {
    int64_t product;
    __asm__("smull %Q0, %R0, %1, %2" : "=r"(product) : "r"(a), "r"(b));
    return product;
}

/* a * b in words: the compiler would keep a product of which one word is altered in memory. */
static inline int32_t arm_smull_words(int32_t a, int32_t b, uint32_t *low) {
    int32_t high;
    __asm__("smull %0, %1, %2, %3" : "=&r"(*low), "=&r"(high) : "r"(a), "r"(b));
    return high;
}

/* sum + a * b; wraps. */
static inline int64_t arm_smlal(int64_t sum, int32_t a, int32_t b) {
    __asm__("smlal %Q0, %R0, %1, %2" : "+r"(sum) : "r"(a), "r"(b));
    return sum;
}

/* a * b / 2^32, rounded. */
static inline int32_t arm_smmulr(int32_t a, int32_t b) {
    int32_t high;
    __asm__("smmulr %0, %1, %2" : "=r"(high) : "r"(a), "r"(b));
    return high;
}

/* sum + a * b / 2^32, the product rounded. */
static inline int32_t arm_smmlar(int32_t sum, int32_t a, int32_t b) {
    int32_t result;
    __asm__("smmlar %0, %1, %2, %3" : "=r"(result) : "r"(a), "r"(b), "r"(sum));
    return result;
}

/* Upper half of `high`, and the upper half of `low` below it. */
static inline uint32_t arm_pkhtb(int32_t high, int32_t low) {
    uint32_t packed;
    __asm__("pkhtb %0, %1, %2, asr #16" : "=r"(packed) : "r"(high), "r"(low));
    return packed;
}

/* value, or 0 when it is negative. */
static inline int32_t arm_usat31(int32_t value) {
    int32_t saturated;
    __asm__("usat %0, #31, %1" : "=r"(saturated) : "r"(value));
    return saturated;
}

/* value saturated to 0..2^16 - 1. */
static inline int32_t arm_usat16(int32_t value) {
    int32_t saturated;
    __asm__("usat %0, #16, %1" : "=r"(saturated) : "r"(value));
    return saturated;
}

/* value saturated to `bits` bits with sign; bits is a constant. */
#define ARM_SSAT(value, bits)                                                                                          \
    __extension__({                                                                                                    \
        int32_t saturated;                                                                                             \
        __asm__("ssat %0, %1, %2" : "=r"(saturated) : "I"(bits), "r"(value));                                          \
        saturated;                                                                                                     \
    })

/* value * 2^shift saturated to `bits` bits with sign; both are constants. */
#define ARM_SSAT_SHIFTED(value, shift, bits)                                                                           \
    __extension__({                                                                                                    \
        int32_t saturated;                                                                                             \
        __asm__("ssat %0, %1, %2, lsl %3" : "=r"(saturated) : "I"(bits), "r"(value), "I"(shift));                      \
        saturated;                                                                                                     \
    })

#endif

/* The functions for three numbers name up to nine registers, which the compiler can spare only when it optimises. */
#if defined __ARM_FEATURE_DSP && defined __OPTIMIZE__
#define ARM_DSP_VEC3 1
#else
#define ARM_DSP_VEC3 0
#endif

#if ARM_DSP_VEC3

/* The direction is in r8 to r10, the values in r1 to r3, their increments in r4 to r6. */
#define ARM_VEC3_MOMENTUM_STEP(scale, momentum)                                                                        \
    "smmulr r4, r4, " momentum "\n\t"                                                                                  \
    "smmulr r5, r5, " momentum "\n\t"                                                                                  \
    "smmulr r6, r6, " momentum "\n\t"                                                                                  \
    "smmlar r4, r8, " scale ", r4\n\t"                                                                                 \
    "smmlar r5, r9, " scale ", r5\n\t"                                                                                 \
    "smmlar r6, r10, " scale ", r6\n\t"                                                                                \
    "qdadd r1, r1, r4\n\t"                                                                                             \
    "qdadd r2, r2, r5\n\t"                                                                                             \
    "qdadd r3, r3, r6\n\t"

/* vec3_dot(). */
static inline int32_t arm_vec3_dot(const int32_t a[3], int32_t b0, int32_t b1, int32_t b2) {
    int32_t sum;
    __asm__("ldm %1, {r1, r2, r3}\n\t"
            "smmulr %0, r1, %2\n\t"
            "smmlar %0, r2, %3, %0\n\t"
            "smmlar %0, r3, %4, %0"
            : "=&r"(sum)
            : "r"(a), "r"(b0), "r"(b1), "r"(b2), "m"(*(const int32_t(*)[3])a)
            : "r1", "r2", "r3");
    return sum;
}

/* vec3_add_scaled(). */
static inline void arm_vec3_add_scaled(int32_t sum[3], const int32_t a[3], int32_t scale) {
    __asm__("ldm %3, {r1, r2, r3}\n\t"
            "smmlar %0, r1, %4, %0\n\t"
            "smmlar %1, r2, %4, %1\n\t"
            "smmlar %2, r3, %4, %2"
            : "+r"(sum[0]), "+r"(sum[1]), "+r"(sum[2])
            : "r"(a), "r"(scale), "m"(*(const int32_t(*)[3])a)
            : "r1", "r2", "r3");
}

/* vec3_momentum_step(); vector: three values, then their three increments. Returns what follows it. */
static inline void *arm_vec3_momentum_step(void *vector, const int32_t direction[3], int32_t scale,
                                           int32_t momentum_q32) {
    register const int32_t *first __asm__("r8") = direction;
    __asm__ volatile(
        "ldm r8, {r8, r9, r10}\n\t"
        "ldm %1, {r1, r2, r3, r4, r5, r6}\n\t" ARM_VEC3_MOMENTUM_STEP("%2", "%3") "stm %1!, {r1, r2, r3, r4, r5, r6}"
        : "+r"(first), "+r"(vector)
        : "r"(scale), "r"(momentum_q32)
        : "r1", "r2", "r3", "r4", "r5", "r6", "r9", "r10", "memory");
    return vector;
}

/* vec3_dot_and_momentum_step(). */
static inline void *arm_vec3_dot_and_momentum_step(void *vector, const int32_t direction[3], int32_t scale,
                                                   int32_t momentum_q32, int32_t *dot) {
    int32_t sum;
    register const int32_t *first __asm__("r8") = direction;
    __asm__ volatile("ldm r8, {r8, r9, r10}\n\t"
                     "ldm %1, {r1, r2, r3, r4, r5, r6}\n\t"
                     "smmulr %0, r8, r1\n\t"
                     "smmlar %0, r9, r2, %0\n\t"
                     "smmlar %0, r10, r3, %0\n\t" ARM_VEC3_MOMENTUM_STEP("%3", "%4") "stm %1!, {r1, r2, r3, r4, r5, r6}"
                     : "=&r"(sum), "+r"(vector), "+r"(first)
                     : "r"(scale), "r"(momentum_q32)
                     : "r1", "r2", "r3", "r4", "r5", "r6", "r9", "r10", "memory");
    *dot = sum;
    return vector;
}

#endif

#endif
