/* Units of the profile, by its factor groups, and the drive's.
 *
 *   position      revolutions of the motor = value * shaft revolutions 0x6092:2 / feed 0x6092:1 * motor / shaft
 *                 revolutions, object 0x6091
 *   velocity      r/min of the motor = value * numerator / divisor * motor / shaft revolutions, objects 0x6096, 0x6091
 *   acceleration  likewise with 0x6097, a second
 *   jerk          r/min/s^2 likewise with 0x6097
 *   torque        per mille of the rated torque, the machine's default of torque_max_Nm
 *
 * Inside, velocities are 0.001 r/min and torques 0.001 per mille. Conversions round to nearest, away from zero.
 */
#ifndef COMMS_CANOPEN_UNITS_H
#define COMMS_CANOPEN_UNITS_H

#include "comms/canopen_types.h"

/* 2^-32 rev from position units, and the reverse: within 2^-32 rev, beyond +-2^20 rev limited; to nearest within 2^-4
 * of a unit, |position| < 2^50, saturates. */
int64_t canopen_position_q32(const canopen_t *canopen, int32_t position);
int32_t canopen_position_units(const canopen_t *canopen, int64_t position);

/* A distance of a parameter, 1/per_rev rev, from position units, and the reverse: magnitudes, saturate. */
int32_t canopen_distance(const canopen_t *canopen, int32_t units, int32_t per_rev);
int32_t canopen_distance_units(const canopen_t *canopen, int32_t distance, int32_t per_rev);

/* Acceleration, or jerk, of a set point, r/min/s or r/min/s^2 of the machine's unit, from units >= 0; at least 1,
 * saturates. */
int32_t canopen_rate(const canopen_t *canopen, int32_t value);

/* 0.001 r/min from velocity units; saturates at +-INT32_MAX. */
int32_t canopen_velocity_milli(const canopen_t *canopen, int32_t velocity);

/* Velocity units from 0.001 r/min; saturates. */
int32_t canopen_velocity(const canopen_t *canopen, int32_t milli_rpm);

/* r/min of the machine's unit from velocity units, and the reverse: magnitudes; saturate. */
int32_t canopen_rpm(const canopen_t *canopen, int32_t velocity);
int32_t canopen_rpm_units(const canopen_t *canopen, int32_t rpm);

/* 0.001 r/min/s from acceleration units, 1..1000000; at least 1, saturates at 2^30. */
int32_t canopen_acceleration_milli(const canopen_t *canopen, int32_t acceleration);

/* 0.001 r/min of a machine's unit of speed (machine_tables.speed_exponent) from 0.001 r/min, and the reverse. */
int32_t canopen_machine_speed(int32_t milli_rpm);
int32_t canopen_speed_of_machine(int32_t machine);

/* Torque reference, Q7.24 of the machine's unit, from 0.001 per mille within +-10^7: 64-bit product, within 2^-20 of
 * the rated torque; saturates. */
int32_t canopen_torque_q24(int32_t milli);

/* Per mille of the rated torque from the machine's unit in Q7.24, and in Q8. */
int32_t canopen_torque(int32_t torque_q24);
int32_t canopen_torque_of_q8(int32_t torque_q8);

/* Rated torque, mN m. */
uint32_t canopen_rated_torque(void);

/* Volts in 0.001 from a voltage of the machine's unit, Q6. */
uint32_t canopen_milli_volts(uint32_t voltage_q6);

#endif
