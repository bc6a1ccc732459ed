/* Random numbers that are a function of (seed, stream, index): leaving a draw out does not move the others. */
#ifndef CAMPAIGN_SEEDED_H
#define CAMPAIGN_SEEDED_H

#include <math.h>
#include <stdint.h>

/* The finaliser of splitmix64 (random.h) over the three numbers in turn. */
static inline uint64_t seeded_bits(uint64_t seed, uint64_t stream, uint64_t index) {
    uint64_t z = seed;
    const uint64_t words[2] = {stream, index};
    for (unsigned i = 0; i < 2; i++) {
        z += UINT64_C(0x9E3779B97F4A7C15) * (words[i] + 1);
        z = (z ^ (z >> 30)) * UINT64_C(0xBF58476D1CE4E5B9);
        z = (z ^ (z >> 27)) * UINT64_C(0x94D049BB133111EB);
        z ^= z >> 31;
    }
    return z;
}

/* 0 <= number < 1. */
static inline double seeded_unit(uint64_t seed, uint64_t stream, uint64_t index) {
    return (double)(seeded_bits(seed, stream, index) >> 11) * 0x1p-53;
}

/* low <= number < high. */
static inline double seeded_between(uint64_t seed, uint64_t stream, uint64_t index, double low, double high) {
    return low + (high - low) * seeded_unit(seed, stream, index);
}

/* low <= number < high, of which the logarithm is uniform. */
static inline double seeded_logarithmic(uint64_t seed, uint64_t stream, uint64_t index, double low, double high) {
    return exp(seeded_between(seed, stream, index, log(low), log(high)));
}

/* 0 .. count - 1. */
static inline unsigned seeded_below(uint64_t seed, uint64_t stream, uint64_t index, unsigned count) {
    return (unsigned)(seeded_bits(seed, stream, index) % count);
}

#endif
