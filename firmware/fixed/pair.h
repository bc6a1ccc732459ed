/* Two products of 16 bits at once, which is one instruction where the processor has it. */
#ifndef FIXED_PAIR_H
#define FIXED_PAIR_H

#include <stdint.h>

#include "fixed/arm_dsp.h"

/* Two factors, each -32768..32767, for fixed_pair_multiply_add(). */
static inline uint32_t fixed_pair(int32_t first, int32_t second) {
    return ((uint32_t)first & 0xFFFFu) | (uint32_t)second << 16;
}

/* sum + value[0] first + value[1] second. It must not overflow. The values need no alignment of their own. */
static inline int32_t fixed_pair_multiply_add(const int16_t value[2], uint32_t pair, int32_t sum) {
#ifdef __ARM_FEATURE_DSP
    int16x2_t both;
    __builtin_memcpy(&both, value, sizeof both);
    if (__builtin_constant_p(sum) && sum == 0) {
        return __smuad(both, (int16x2_t)pair);
    }
    return __smlad(both, (int16x2_t)pair, sum);
#else
    return sum + value[0] * (int16_t)(pair & 0xFFFFu) + value[1] * (int16_t)(pair >> 16);
#endif
}

#endif
