/* e^-x for x >= 0. */
#ifndef FIXED_EXPONENTIAL_H
#define FIXED_EXPONENTIAL_H

#include <stdint.h>

/* e^-x in unsigned Q1.31 (2^31 is 1) for x in unsigned Q16.16, the whole range.
 * Relative error below 1.6e-5 plus 1 LSB: 64 linear steps an octave, h^2/8 of the second derivative. */
uint32_t exponential_negative_q31(uint32_t x_q16);

#endif
