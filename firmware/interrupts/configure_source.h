/* Sources of the derived parameters, and conversions of their units. */
#ifndef INTERRUPTS_CONFIGURE_SOURCE_H
#define INTERRUPTS_CONFIGURE_SOURCE_H

#include "fixed/divide.h"
#include "fixed/fixed.h"
#include "interrupts/control_step.h"

/* Laws and features of a controller. */
typedef struct {
    speed_law_t speed_law;
    torque_law_t torque_law;
    bool four_quadrant;         /* false: motors forwards only */
    bool schedules_bandwidth;   /* of the observer; false: fixed bandwidth */
    bool may_interleave_pulses; /* by the parameter `pulses_per_period` */
} configure_controller_t;

typedef struct {
    const int32_t *values; /* of the user's parameters */
    const machine_tables_t *tables;
    uint32_t control_rate_hz;
    unsigned encoder_bits, adc_bits;
    uint32_t timer_clock_hz;
    configure_controller_t controller;
    int32_t torque_min_q24; /* of the drive, N m, Q7.24; the maximum is a parameter */
} configure_source_t;

/* pi / 30: r/min to rad/s. */
#define PI_30_Q37 INT64_C(14392573551)

/* rad/s with 22 fraction bits from whole r/min, any value: Q9.22 up to 4889 r/min. */
static inline int64_t speed_q22_from_rpm(int32_t rpm) {
    return fixed_shift(rpm * PI_30_Q37, 15);
}

#endif
