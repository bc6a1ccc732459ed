#include "fixed/divide.h"

int64_t fixed_divide(int64_t numerator, int64_t denominator) {
    const uint64_t divisor = (uint64_t)denominator;
    /* Long division, one bit per step: the numerator is shifted out at the top of `quotient` into the remainder, the
     * quotient is shifted in at its bottom. */
    uint64_t quotient = numerator < 0 ? 0 - (uint64_t)numerator : (uint64_t)numerator;
    uint64_t remainder = 0; /* below the divisor, hence below 2^63: one more bit fits */
    for (unsigned bit = 0; bit < 64; bit++) {
        remainder = remainder << 1 | quotient >> 63;
        quotient <<= 1;
        if (remainder >= divisor) {
            remainder -= divisor;
            quotient |= 1;
        }
    }
    return (int64_t)(numerator < 0 ? 0 - quotient : quotient);
}
