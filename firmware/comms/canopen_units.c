#include "comms/canopen_units.h"

#include "control/machine_tables.h"
#include "fixed/compiler.h"
#include "fixed/divide.h"
#include "fixed/fixed.h"

/* Limits of the factors in objects.toml. */
#define GROUP_MAX 4095
#define GEAR_MAX 1023
#define ACCELERATION_MAX (INT32_C(1) << 30)

/* value * numerator / divisor, to nearest, away from zero; |numerator * value| < 2^62. */
static int64_t scaled(int64_t value, int64_t numerator, int64_t divisor) {
    const int64_t product = value * numerator;
    const int64_t half = divisor / 2;
    return fixed_divide(product < 0 ? product - half : product + half, divisor);
}

/* Factor of a group, 1..4095 * 1023 < 2^22, whatever its variables have become in memory. */
static int64_t factor(const canopen_t *canopen, unsigned of_group, unsigned of_gear) {
    return (int64_t)fixed_clamp(canopen->values[of_group], 1, GROUP_MAX) *
           fixed_clamp(canopen->values[of_gear], 1, GEAR_MAX);
}

static bool reversed(const canopen_t *canopen) {
    return canopen->values[CANOPEN_VALUE_POLARITY] != 0;
}

COLD int32_t canopen_velocity_milli(const canopen_t *canopen, int32_t velocity) {
    const int64_t numerator = factor(canopen, CANOPEN_VALUE_VELOCITY_NUMERATOR, CANOPEN_VALUE_GEAR_MOTOR);
    const int64_t below = factor(canopen, CANOPEN_VALUE_VELOCITY_DIVISOR, CANOPEN_VALUE_GEAR_SHAFT);
    const int32_t milli = fixed_saturate(scaled((int64_t)velocity * 1000, numerator, below));
    return reversed(canopen) ? fixed_subtract(0, milli) : milli;
}

COLD int32_t canopen_velocity(const canopen_t *canopen, int32_t milli_rpm) {
    const int64_t numerator = factor(canopen, CANOPEN_VALUE_VELOCITY_NUMERATOR, CANOPEN_VALUE_GEAR_MOTOR);
    const int64_t below = factor(canopen, CANOPEN_VALUE_VELOCITY_DIVISOR, CANOPEN_VALUE_GEAR_SHAFT);
    const int32_t velocity = fixed_saturate(scaled(milli_rpm, below, numerator * 1000));
    return reversed(canopen) ? fixed_subtract(0, velocity) : velocity;
}

COLD int32_t canopen_acceleration_milli(const canopen_t *canopen, int32_t acceleration) {
    const int64_t numerator = factor(canopen, CANOPEN_VALUE_ACCELERATION_NUMERATOR, CANOPEN_VALUE_GEAR_MOTOR);
    const int64_t below = factor(canopen, CANOPEN_VALUE_ACCELERATION_DIVISOR, CANOPEN_VALUE_GEAR_SHAFT);
    return (int32_t)fixed_clamp_64(scaled((int64_t)acceleration * 1000, numerator, below), 1, ACCELERATION_MAX);
}

COLD int32_t canopen_machine_speed(int32_t milli_rpm) {
    return machine_tables.speed_exponent == 0 ? milli_rpm
                                              : (int32_t)fixed_shift(milli_rpm, machine_tables.speed_exponent);
}

COLD int32_t canopen_speed_of_machine(int32_t machine) {
    return fixed_saturate((int64_t)machine * (INT64_C(1) << machine_tables.speed_exponent));
}

static int32_t rated_q24(void) {
    const int32_t rated = machine_tables.parameter_default[PARAMETER_TORQUE_MAX_NM];
    return rated < 1 ? 1 : rated;
}

/* 2^30 / 10^6, Q10. */
#define PART_Q30_PER_MILLI_Q10 INT64_C(1099512)
#define MILLI_MAX 10000000

COLD int32_t canopen_torque_q24(int32_t milli) {
    const int64_t part_q30 =
        fixed_shift((int64_t)fixed_clamp(milli, -MILLI_MAX, MILLI_MAX) * PART_Q30_PER_MILLI_Q10, 10);
    return fixed_saturate(fixed_shift(part_q30 / 16 * rated_q24(), 26));
}

COLD int32_t canopen_torque(int32_t torque_q24) {
    return fixed_saturate(scaled(torque_q24, 1000, rated_q24()));
}

COLD int32_t canopen_torque_of_q8(int32_t torque_q8) {
    return fixed_saturate(scaled((int64_t)torque_q8 * (1 << 16), 1000, rated_q24()));
}

/* value * 1000 * 2^-bits. */
static uint32_t milli_of(uint32_t value, int bits) {
    const uint64_t milli = (uint64_t)value * 1000u;
    return (uint32_t)(bits > 0 ? (milli + (UINT64_C(1) << (bits - 1))) >> bits : milli << -bits);
}

COLD uint32_t canopen_rated_torque(void) {
    return milli_of((uint32_t)rated_q24(), machine_tables.parameter_fraction_bits[PARAMETER_TORQUE_MAX_NM]);
}

COLD uint32_t canopen_milli_volts(uint32_t voltage_q6) {
    return milli_of(voltage_q6, machine_tables.parameter_fraction_bits[PARAMETER_OVER_VOLTAGE_V]);
}
