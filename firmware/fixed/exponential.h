/* 2^-y for y >= 0: an exponential that counts in octaves. e^-x is that of x / ln 2 octaves. */
#ifndef FIXED_EXPONENTIAL_H
#define FIXED_EXPONENTIAL_H

#include <stdint.h>

/* 2^-y in unsigned Q1.31 (2^31 is 1) for y in unsigned Q15.17, the whole range.
 * Relative error below 1.6e-5 plus 1 LSB: 64 linear steps an octave, h^2/8 of the second derivative. */
uint32_t exponential_octaves_q31(uint32_t octaves_q17);

#endif
