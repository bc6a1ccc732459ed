#include "fixed/divide.h"

int64_t fixed_divide(int64_t numerator, int64_t denominator) {
    const uint64_t divisor = (uint64_t)denominator;
    /* Bit by bit: from the top they move from the numerator into the rest, and the quotient's follow from below. */
    uint64_t quotient = numerator < 0 ? 0 - (uint64_t)numerator : (uint64_t)numerator;
    uint64_t rest = 0; /* below the divisor, so that a bit more fits */
    for (unsigned bit = 0; bit < 64; bit++) {
        rest = rest << 1 | quotient >> 63;
        quotient <<= 1;
        if (rest >= divisor) {
            rest -= divisor;
            quotient |= 1;
        }
    }
    return (int64_t)(numerator < 0 ? 0 - quotient : quotient);
}
