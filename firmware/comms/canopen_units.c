#include "comms/canopen_units.h"

#include "control/machine_tables.h"
#include "fixed/compiler.h"
#include "fixed/divide.h"
#include "fixed/fixed.h"

/* Limits of the factors in objects.toml. */
#define GROUP_MAX 4095
#define GEAR_MAX 1023
#define MILLI 1000
#define FEED_MAX (INT32_C(1) << 24)
#define ACCELERATION_MAX (INT32_C(1) << 30)

#define VELOCITY_POLARITY 0x40
#define POSITION_POLARITY 0x80

/* Beyond every position and distance of the drive: 2^20 and 2^6 rev. */
#define REVOLUTIONS_MAX (INT64_C(1) << 20)
#define DISTANCE_MAX (INT64_C(1) << 38)

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

static bool reversed(const canopen_t *canopen, int32_t of) {
    return (canopen->values[CANOPEN_VALUE_POLARITY] & of) != 0;
}

/* Revolutions of the motor per position: shaft revolutions of the feed * motor revolutions < 2^20 / units < 2^34. */
static int64_t position_numerator(const canopen_t *canopen) {
    return (int64_t)fixed_clamp(canopen->values[CANOPEN_VALUE_FEED_SHAFT], 1, GEAR_MAX) *
           fixed_clamp(canopen->values[CANOPEN_VALUE_GEAR_MOTOR], 1, GEAR_MAX);
}

static int64_t position_divisor(const canopen_t *canopen) {
    return (int64_t)fixed_clamp(canopen->values[CANOPEN_VALUE_FEED], 1, FEED_MAX) *
           fixed_clamp(canopen->values[CANOPEN_VALUE_GEAR_SHAFT], 1, GEAR_MAX);
}

/* Without the polarity. The fraction of a revolution in two steps of 16 bits. */
static int64_t revolutions_q32(const canopen_t *canopen, int32_t position) {
    const int64_t divisor = position_divisor(canopen);
    int64_t rest = (int64_t)position * position_numerator(canopen); /* below 2^51 */
    int64_t quotient = fixed_divide(rest, divisor);
    rest -= quotient * divisor;
    if (quotient > REVOLUTIONS_MAX || quotient < -REVOLUTIONS_MAX) {
        return (quotient > 0 ? REVOLUTIONS_MAX : -REVOLUTIONS_MAX) * POSITION_ONE_REV;
    }
    for (int step = 0; step < 2; step++) {
        const int64_t digit = fixed_divide(rest * (1 << 16), divisor);
        rest = rest * (1 << 16) - digit * divisor;
        quotient = quotient * (1 << 16) + digit;
    }
    return quotient;
}

static int32_t units_of(const canopen_t *canopen, int64_t position) {
    const int64_t divisor = position_divisor(canopen);
    const int64_t whole = position >> 32, fraction_q28 = (position & (POSITION_ONE_REV - 1)) >> 4;
    const int64_t product_q8 = whole * divisor * (1 << 8) + (fraction_q28 * divisor >> 20); /* below 2^61 */
    return fixed_saturate(scaled(product_q8, 1, position_numerator(canopen) * (1 << 8)));
}

COLD int64_t canopen_position_q32(const canopen_t *canopen, int32_t position) {
    const int64_t forward = revolutions_q32(canopen, position);
    return reversed(canopen, POSITION_POLARITY) ? -forward : forward;
}

COLD int32_t canopen_position_units(const canopen_t *canopen, int64_t position) {
    return units_of(canopen, reversed(canopen, POSITION_POLARITY) ? -position : position);
}

COLD int32_t canopen_distance(const canopen_t *canopen, int32_t units, int32_t per_rev) {
    const int64_t distance = fixed_clamp_64(revolutions_q32(canopen, units), 0, DISTANCE_MAX);
    return fixed_saturate(fixed_shift(distance * per_rev, 32));
}

COLD int32_t canopen_distance_units(const canopen_t *canopen, int32_t distance, int32_t per_rev) {
    return units_of(canopen, scaled(distance, POSITION_ONE_REV, per_rev));
}

COLD int32_t canopen_rate(const canopen_t *canopen, int32_t value) {
    const int64_t numerator = factor(canopen, CANOPEN_VALUE_ACCELERATION_NUMERATOR, CANOPEN_VALUE_GEAR_MOTOR);
    const int64_t below = factor(canopen, CANOPEN_VALUE_ACCELERATION_DIVISOR, CANOPEN_VALUE_GEAR_SHAFT);
    return fixed_max(fixed_saturate(scaled(value, numerator, below << machine_tables.speed_exponent)), 1);
}

COLD int32_t canopen_velocity_milli(const canopen_t *canopen, int32_t velocity) {
    const int64_t numerator = factor(canopen, CANOPEN_VALUE_VELOCITY_NUMERATOR, CANOPEN_VALUE_GEAR_MOTOR);
    const int64_t below = factor(canopen, CANOPEN_VALUE_VELOCITY_DIVISOR, CANOPEN_VALUE_GEAR_SHAFT);
    const int32_t milli = fixed_saturate(scaled((int64_t)velocity * 1000, numerator, below));
    return reversed(canopen, VELOCITY_POLARITY) ? fixed_subtract(0, milli) : milli;
}

COLD int32_t canopen_velocity(const canopen_t *canopen, int32_t milli_rpm) {
    const int64_t numerator = factor(canopen, CANOPEN_VALUE_VELOCITY_NUMERATOR, CANOPEN_VALUE_GEAR_MOTOR);
    const int64_t below = factor(canopen, CANOPEN_VALUE_VELOCITY_DIVISOR, CANOPEN_VALUE_GEAR_SHAFT);
    const int32_t velocity = fixed_saturate(scaled(milli_rpm, below, numerator * 1000));
    return reversed(canopen, VELOCITY_POLARITY) ? fixed_subtract(0, velocity) : velocity;
}

COLD int32_t canopen_rpm(const canopen_t *canopen, int32_t velocity) {
    return (int32_t)scaled(canopen_machine_speed(fixed_abs(canopen_velocity_milli(canopen, velocity))), 1, MILLI);
}

COLD int32_t canopen_rpm_units(const canopen_t *canopen, int32_t rpm) {
    const int32_t milli = fixed_saturate((int64_t)rpm * MILLI);
    return fixed_abs(canopen_velocity(canopen, canopen_speed_of_machine(milli)));
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
