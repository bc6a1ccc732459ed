/* Checks of every control period. All are evaluated, whatever the others say; the caller latches. Those of speed and
 * encoder are the same in both directions. */
#ifndef DRIVE_PROTECTION_H
#define DRIVE_PROTECTION_H

#include <stdint.h>

typedef struct {
    int32_t current_trip_q9;     /* A, Q7.9 */
    int32_t bus_over_voltage_q6; /* V, Q9.6 */
    int32_t bus_under_voltage_q6;
    int32_t over_speed_q22;    /* rad/s, Q9.22, of the magnitude */
    int32_t angle_step_max;    /* 2^-32 turn a period: further is no rotation but a jump */
    int32_t angle_unmoved_max; /* 2^-32 turn that the rotor should have moved while the encoder stood still; < 2^30 */
    int32_t angle_step_q32;    /* period: 2^-32 turn per rad/s Q9.22, in Q32 */
    uint32_t command_timeout_us;
    int32_t slowing_q22; /* that torque can take off the speed in a period, rad/s, Q9.22 */
} protection_parameters_t;

typedef struct {
    uint32_t angle;     /* of the last period, 2^-32 turn */
    int32_t moving_q22; /* least speed that the rotor can have by now, rad/s, Q9.22 */
    int32_t unmoved;    /* expected movement since the encoder last moved, 2^-32 turn; held above 2^30 */
    int32_t overruns;   /* control interrupts lost in a row: what ran between them was late as well */
} protection_t;

typedef struct {
    int32_t current_max_q9; /* of all phases */
    int32_t bus_voltage_q6;
    int32_t speed_q22;          /* negative backwards */
    uint32_t angle;             /* of the encoder's count, 2^-32 turn */
    uint32_t missed_interrupts; /* since the last period */
    uint32_t command_age_us;    /* of the last accepted command */
} protection_sample_t;

/* Lost control interrupts in a row that are a fault. An interrupt that is late, ending after the next trigger, loses
 * that trigger and every other one before its end: three late ones in a row are a fault, or one that is three periods
 * late, noticed by the interrupt after them. One that was in time ends the row. */
#define PROTECTION_OVERRUNS_MAX 3

/* Starts at a measured angle. */
void protection_reset(protection_t *protection, uint32_t angle);

/* Mask of the failed checks, FAULT_BIT. The caller decides which of them count in its state. */
uint16_t protection_check(const protection_parameters_t *parameters, protection_t *protection,
                          const protection_sample_t *sample);

#endif
