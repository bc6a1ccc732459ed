/* The smaller and the larger of two numbers. Unlike fmin and fmax they are a comparison, without a call, and give `b`
 * when one is not a number. */
#ifndef PLANT_MIN_MAX_H
#define PLANT_MIN_MAX_H

#include <stdint.h>

static inline double min_double(double a, double b) {
    return a < b ? a : b;
}

static inline double max_double(double a, double b) {
    return a > b ? a : b;
}

static inline uint64_t min_u64(uint64_t a, uint64_t b) {
    return a < b ? a : b;
}

static inline uint64_t max_u64(uint64_t a, uint64_t b) {
    return a > b ? a : b;
}

#endif
