/* Fault detection: checks of every control period. All of them are evaluated in every period; the state machine decides
 * which ones count and latches the first fault. Speed and encoder are checked alike in both directions. */
#ifndef DRIVE_PROTECTION_H
#define DRIVE_PROTECTION_H

#include <stdint.h>

typedef struct {
    int32_t current_trip_q9;          /* A, Q7.9 */
    int32_t dc_link_over_voltage_q6;  /* V, Q9.6 */
    int32_t dc_link_under_voltage_q6; /* V, Q9.6 */
    int32_t over_speed_q22;           /* limit of the speed's magnitude, rad/s, Q9.22 */
    int32_t angle_step_max;           /* largest plausible rotation per period, 2^-32 rev */
    int32_t undetected_travel_max;    /* expected rotation without an encoder count, 2^-32 rev, < 2^30 */
    int32_t angle_step_q32;           /* control period: 2^-32 rev per rad/s Q9.22, in Q32 */
    int32_t deceleration_max_q22;     /* largest speed drop per period, rad/s, Q9.22 */
    uint32_t command_timeout_us;
} protection_parameters_t;

typedef struct {
    uint32_t encoder_angle;        /* of the previous period, 2^-32 rev */
    int32_t speed_lower_bound_q22; /* lowest speed that the rotor can have, rad/s, Q9.22 */
    int32_t undetected_travel;     /* expected rotation since the last encoder count, 2^-32 rev; stops above 2^30 */
    int32_t overruns;              /* triggers lost in consecutive control periods; saturates */
} protection_t;

typedef struct {
    int32_t current_max_q9;     /* largest phase current, A, Q7.9 */
    int32_t dc_link_voltage_q6; /* V, Q9.6 */
    int32_t speed_q22;          /* observer, rad/s, Q9.22 */
    uint32_t encoder_angle;     /* start of the encoder count, 2^-32 rev */
    uint32_t missed_interrupts; /* triggers lost since the previous period */
    uint32_t command_age_us;    /* time since the last accepted command */
} protection_input_t;

/* Lost triggers in consecutive periods that are a fault. A control interrupt that ends after the next trigger loses
 * that trigger and every further one before its end: three such interrupts in succession are a fault, or one that lasts
 * three periods too long; the interrupt after them detects it. An interrupt that ends in time resets the count. */
#define PROTECTION_OVERRUNS_MAX 3

/* Starts at a measured encoder angle. */
void protection_reset(protection_t *protection, uint32_t encoder_angle);

/* One control period: fault mask of the failed checks. */
uint64_t protection_check(const protection_parameters_t *parameters, protection_t *protection,
                          const protection_input_t *input);

#endif
