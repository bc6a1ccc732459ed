// Numbers 1 of the firmware's formats as doubles, conversion to them, and the units that every test uses.
#ifndef TESTS_UNIT_FIXED_POINT_H
#define TESTS_UNIT_FIXED_POINT_H

#include <algorithm>
#include <cmath>
#include <cstdint>

namespace fixed_point {

constexpr double PI = 3.14159265358979323846;
constexpr double REV = 4294967296.0; // 2^-32 rev, mechanical or electrical
constexpr uint32_t HALF_REV_Q32 = 0x80000000u;
constexpr uint32_t TIMER_CLOCK_HZ = 200000000; // of the board, as the emulator's

constexpr double one(int fraction_bits) {
    return double(int64_t(1) << fraction_bits);
}

constexpr double Q6 = one(6), Q8 = one(8), Q9 = one(9), Q12 = one(12), Q15 = one(15), Q16 = one(16), Q17 = one(17);
constexpr double Q20 = one(20), Q22 = one(22), Q23 = one(23), Q24 = one(24), Q27 = one(27), Q28 = one(28);
constexpr double Q29 = one(29), Q30 = one(30), Q31 = one(31), Q32 = one(32), Q40 = one(40);

// Nearest number of a format, saturated to int32_t.
inline int32_t to_fixed(double value, double one) {
    return int32_t(std::clamp(std::floor(value * one + 0.5), -2147483648.0, 2147483647.0));
}

inline double rad_s(double rpm) {
    return rpm * 2.0 * PI / 60.0;
}

// Electrical angle of a phase, 2^-32 rev, rounded down.
inline uint32_t electrical_angle(double degrees) {
    return uint32_t(std::floor(degrees / 360.0 * REV));
}

// Angle of any number of revolutions, 2^-32 rev, rounded down.
inline uint32_t angle_from_rev(double rev) {
    return uint32_t(int64_t(std::floor((rev - std::floor(rev)) * REV)));
}

} // namespace fixed_point

#endif
