/* 64-bit division for configuration. The compiler's library has a faster one, which would be the largest function in
 * the image. The control interrupt divides 32-bit numbers only, in one instruction. */
#ifndef FIXED_DIVIDE_H
#define FIXED_DIVIDE_H

#include <stdint.h>

/* numerator / denominator, rounded towards zero as in C; denominator > 0. Exact over the whole range. */
int64_t fixed_divide(int64_t numerator, int64_t denominator);

#endif
