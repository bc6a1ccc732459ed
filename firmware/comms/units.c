#include "comms/units.h"

#include "fixed/fixed.h"

/* 60000 / (2 pi) * 2^18: a speed in Q22 times this is 0.001 r/min with 40 fraction bits, below 2^63. */
#define MILLI_RPM_PER_RAD_S_Q18 INT64_C(2503290804)
/* 2 pi / 60000 * 2^22 * 2^23: 0.001 r/min times this is Q22 with 23 fraction bits, below 2^63 for every argument. */
#define SPEED_Q22_PER_MILLI_RPM_Q23 INT64_C(3684498829)

int32_t units_milli_rpm(int32_t speed_q22) {
    return (int32_t)fixed_shift(speed_q22 * MILLI_RPM_PER_RAD_S_Q18, 40);
}

int32_t units_speed_q22(int32_t milli_rpm) {
    return fixed_saturate(fixed_shift(milli_rpm * SPEED_Q22_PER_MILLI_RPM_Q23, 23));
}

int32_t units_quarter_rpm(int32_t milli_rpm) {
    /* floor((x + 125) / 250): C divides towards zero. */
    const int32_t quarters = milli_rpm / 250;
    const int32_t rest = milli_rpm % 250;
    return quarters + (rest >= 125 ? 1 : rest < -125 ? -1 : 0);
}

uint16_t units_angle_u16(uint32_t angle) {
    return (uint16_t)((angle + 0x8000u) >> 16);
}

int32_t units_deviation_q20(int32_t angle) {
    return (int32_t)fixed_shift(angle, 12);
}

int32_t units_torque_q8(int32_t torque_q24) {
    return (int32_t)fixed_shift(torque_q24, 16);
}

int32_t units_position_q18(int64_t position) {
    return fixed_saturate(fixed_shift(position, 14));
}
