// Integer arithmetic of 128 bits, in which no product of the firmware overflows: references for results whose rounding
// is promised.
#ifndef TESTS_UNIT_WIDE_INTEGER_H
#define TESTS_UNIT_WIDE_INTEGER_H

#include <cstdint>
#include <random>

namespace wide_integer {

__extension__ typedef __int128 wide_t;

// value / divisor, rounded down; divisor > 0.
inline wide_t rounded_down(wide_t value, wide_t divisor) {
    const wide_t quotient = value / divisor;
    return value % divisor < 0 ? quotient - 1 : quotient;
}

// value / divisor, rounded to nearest, halves towards plus infinity; divisor even.
inline wide_t nearest(wide_t value, wide_t divisor) {
    return rounded_down(value + divisor / 2, divisor);
}

inline wide_t power_of_2(unsigned exponent) {
    return wide_t(1) << exponent;
}

inline bool fits(wide_t value) {
    return value >= INT32_MIN && value <= INT32_MAX;
}

inline int32_t saturated(wide_t value) {
    return value > INT32_MAX ? INT32_MAX : value < INT32_MIN ? INT32_MIN : int32_t(value);
}

// Any number of 32 bits: the ends of the range, 0 and its neighbours, and numbers of every magnitude.
inline int32_t any(std::mt19937 &random) {
    constexpr int32_t ENDS[] = {INT32_MIN, INT32_MIN + 1, -1, 0, 1, INT32_MAX};
    return random() % 8 == 0 ? ENDS[random() % 6] : int32_t(uint32_t(random())) >> (random() % 31);
}

// The same within 0..most.
inline int32_t any_up_to(std::mt19937 &random, int32_t most) {
    const auto range = uint32_t(most) + 1u;
    return random() % 8 == 0 ? (random() % 2 ? most : 0) : int32_t(uint32_t(random()) % range >> (random() % 31));
}

} // namespace wide_integer

#endif
