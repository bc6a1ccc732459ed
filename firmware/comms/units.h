/* Conversions between the drive's internal formats and the LSBs of drive.dbc.
 *
 *   quantity   inside the drive               on the bus                     conversion
 *   speed      Q9.22 rad/s                    0.001 r/min (1/4 in snapshots) units_milli_rpm, units_speed_q22
 *   angle      2^-32 turn, unsigned           2^-16 turn (DBC: degrees)      units_angle_u16
 *   deviation  2^-32 turn, signed             2^-20 turn (DBC: degrees)      units_deviation_q20
 *   torque     Q7.24 N m                      2^-8 N m                       units_torque_q8
 *   torque     Q7.24 N m                      2^-16 N m (command)            units_torque_q24
 *   current    unsigned Q7.9 A                2^-9 A                         none
 *   voltage    unsigned Q9.6 V                2^-6 V                         none
 *   position   2^-32 turn, 64 bits           2^-18 turn (DBC: degrees)      units_position, units_position_q18
 *   gains      unsigned Q1.15 1/(N m)         2^-15 1/(N m)                  none
 *   duty       Q1.15                          2^-15                          none
 *
 * All conversions round to nearest, halves towards plus infinity.
 */
#ifndef COMMS_UNITS_H
#define COMMS_UNITS_H

#include <stdint.h>

/* 0.001 r/min from rad/s in Q9.22; never saturates (+-4889240), within 0.501 LSB. 64-bit accumulator. */
int32_t units_milli_rpm(int32_t speed_q22);

/* rad/s in Q9.22 from 0.001 r/min; saturates beyond +-4889239 (the ends of Q9.22), otherwise within 0.61 LSB. 64-bit
 * accumulator, no overflow for any argument. */
int32_t units_speed_q22(int32_t milli_rpm);

/* 1/4 r/min from 0.001 r/min; never saturates. */
int32_t units_quarter_rpm(int32_t milli_rpm);

/* 2^-16 turn from 2^-32 turn; the last half LSB of a turn rounds to 0. */
uint16_t units_angle_u16(uint32_t angle);

/* 2^-20 turn from a small angle in 2^-32 turn: +-2^19 (drive_telemetry_pack saturates). */
int32_t units_deviation_q20(int32_t angle);

/* N m in 2^-8 from Q7.24: -32768..32768; the upper end exceeds 16 bits by one (the drive_telemetry_pack functions
 * saturate). */
int32_t units_torque_q8(int32_t torque_q24);

/* N m in Q7.24 from 2^-16, 24 bits: exact. */
static inline int32_t units_torque_q24(int32_t torque_q16) {
    return torque_q16 * (1 << 8);
}

/* 2^-32 turn from 2^-18 turn: exact. */
static inline int64_t units_position(int32_t position_q18) {
    return (int64_t)position_q18 * (1 << 14);
}

/* 2^-18 turn from 2^-32 turn, below 2^62; saturates. */
int32_t units_position_q18(int64_t position);

#endif
