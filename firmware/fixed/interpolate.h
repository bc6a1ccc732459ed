/* Linear interpolation in tables of equidistant entries. */
#ifndef FIXED_INTERPOLATE_H
#define FIXED_INTERPOLATE_H

#include <stdint.h>

/* Value between table[index] and table[index + 1] at fraction / 2^fraction_bits of the interval, 0 <= fraction <
 * 2^fraction_bits, fraction_bits 1..16; rounded to nearest. The result lies between the two entries: no overflow. */
static inline int32_t interpolate_linear(const int16_t *table, uint32_t index, uint32_t fraction,
                                         unsigned fraction_bits) {
    const int32_t low = table[index];
    const int32_t high = table[index + 1];
    /* |high - low| < 2^16 and fraction < 2^16: the signed product needs 33 bits. */
    const int64_t product = (int64_t)(high - low) * (int64_t)fraction;
    return low + (int32_t)((product + ((int64_t)1 << (fraction_bits - 1))) >> fraction_bits);
}

#endif
