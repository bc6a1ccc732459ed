/* Base-2 exponential of a negative exponent: 2^-y for y >= 0. e^-x = 2^(-x / ln 2). */
#ifndef FIXED_EXP2_H
#define FIXED_EXP2_H

#include <stdint.h>

/* 2^-y in unsigned Q1.31 (2^31 is 1) for y in unsigned Q15.17, the whole range; 0 from y = 32. Relative error below
 * 1.6e-5 plus 1 LSB: the integer part of y is a shift, the fraction is interpolated linearly between 64 table entries,
 * whose error is at most h^2/8 = (ln 2 / 64)^2 / 8 of the value. Rounded down. */
uint32_t exp2_negative_q31(uint32_t exponent_q17);

#endif
