/* Dual 16-bit multiply-accumulate: two products in one instruction (SMUAD, SMLAD) on a processor with DSP extension. */
#ifndef FIXED_DUAL16_H
#define FIXED_DUAL16_H

#include <stdint.h>

#include "fixed/arm_dsp.h"

/* Two factors, each -32768..32767, packed for dual16_multiply_add(): `low` in bits 0..15, `high` in bits 16..31. */
static inline uint32_t dual16_pack(int32_t low, int32_t high) {
    return ((uint32_t)low & 0xFFFFu) | (uint32_t)high << 16;
}

/* Upper halves of two words: the half of `low` in bits 0..15, the half of `high` in bits 16..31. */
static inline uint32_t dual16_pack_upper(int32_t low, int32_t high) {
#ifdef __ARM_FEATURE_DSP
    return arm_pkhtb(high, low);
#else
    return ((uint32_t)high & 0xFFFF0000u) | (uint32_t)low >> 16;
#endif
}

/* sum + value[0] low + value[1] high, exact; the caller ensures that it fits. `value` needs no 32-bit alignment. */
static inline int32_t dual16_multiply_add(const int16_t value[2], uint32_t packed, int32_t sum) {
#ifdef __ARM_FEATURE_DSP
    int16x2_t both;
    __builtin_memcpy(&both, value, sizeof both);
    if (__builtin_constant_p(sum) && sum == 0) {
        return __smuad(both, (int16x2_t)packed);
    }
    return __smlad(both, (int16x2_t)packed, sum);
#else
    return sum + value[0] * (int16_t)(packed & 0xFFFFu) + value[1] * (int16_t)(packed >> 16);
#endif
}

#endif
