/* Division of 64 bits, for configuration: the compiler's library has a fast one, which would be the largest function of
 * the image. The control interrupt divides 32 bits at most, in one instruction. */
#ifndef FIXED_DIVIDE_H
#define FIXED_DIVIDE_H

#include <stdint.h>

/* numerator / denominator, towards zero as in C; denominator > 0. A few hundred instructions. */
int64_t fixed_divide(int64_t numerator, int64_t denominator);

#endif
