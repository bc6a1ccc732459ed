/* Fault detection, in every control period and state; the state machine decides which failed checks count and latches
 * the first fault. Speed and encoder are checked alike in both directions.
 *
 *   immediate checks    in the control interrupt: over-current, over-voltage, encoder jump, overruns, break of the PWM
 *   deferred checks     in the deferred interrupt: under-voltage, frozen encoder, command timeout
 *
 * The latter act one period later, or later still when the deferred interrupt is late; a condition that has gone by
 * then is not seen. Over-speed is a check of the background (encoder_monitor.h).
 */
#ifndef MONITORS_PROTECTION_H
#define MONITORS_PROTECTION_H

#include <stdbool.h>
#include <stdint.h>

typedef struct {
    int32_t current_trip_q9;          /* A, Q7.9 */
    int32_t dc_link_over_voltage_q6;  /* V, Q9.6 */
    int32_t dc_link_under_voltage_q6; /* V, Q9.6 */
    int32_t angle_step_max;           /* largest plausible rotation per period, 2^-32 rev */
    int32_t undetected_travel_max;    /* expected rotation without an encoder count, 2^-32 rev, at most 2^28 */
    int32_t angle_step_q32;           /* control period: 2^-32 rev per rad/s Q9.22, in Q32 */
    int32_t deceleration_max_q22;     /* largest speed drop per period, at most as below, rad/s, Q9.22 */
    uint32_t command_timeout_us;      /* age of the last valid command that ends a run */
} protection_parameters_t;

/* 64 rad/s, within a period, which no load nor torque comes near to. */
#define PROTECTION_DECELERATION_MAX_Q22 ((1 << 28) - 1)

/* State of the immediate checks. */
typedef struct {
    uint32_t encoder_angle;   /* of the previous period, 2^-32 rev */
    uint32_t overruns;        /* triggers lost in consecutive control periods; saturates to 2^31 - 1 */
    uint32_t late_interrupts; /* control interrupts that ended after the next trigger, since start */
} protection_t;

/* State of the deferred checks. */
typedef struct {
    uint32_t encoder_angle;        /* of the previous check, 2^-32 rev */
    int32_t speed_counted_q22;     /* by the observer at the last encoder count, rad/s, Q9.22 */
    int32_t speed_lower_bound_q22; /* lowest speed that the rotor can have, rad/s, Q9.22 */
    int32_t undetected_travel;     /* expected rotation since the last encoder count, 2^-32 rev, until frozen */
    bool frozen;                   /* found, and not counted since */
} protection_deferred_t;

typedef struct {
    int32_t current_max_q9;     /* largest phase current, A, Q7.9 */
    int32_t dc_link_voltage_q6; /* V, Q9.6 */
    uint32_t encoder_angle;     /* start of the encoder count, 2^-32 rev */
    uint32_t missed_interrupts; /* triggers lost since the previous period */
    uint32_t break_causes;      /* of a break of the PWM, HAL_PWM_BREAK_* */
    uint32_t skipped_deferred;  /* periods in succession without a deferred step, before this one */
} protection_input_t;

typedef struct {
    int32_t dc_link_voltage_q6; /* V, Q9.6 */
    int32_t speed_q22;          /* observer, rad/s, Q9.22 */
    uint32_t encoder_angle;     /* start of the encoder count, 2^-32 rev */
    uint32_t command_age_us;    /* time since the last accepted command */
    uint32_t periods;           /* control periods since the previous check, from 1 */
} protection_deferred_input_t;

/* Lost triggers in consecutive periods that are a fault. A control interrupt that ends after the next trigger loses
 * that trigger and every further one before its end: three such interrupts in succession are a fault, or one that lasts
 * three periods too long; the interrupt after them detects it. An interrupt that ends in time resets the count. */
#define PROTECTION_OVERRUNS_MAX 3

/* Two lost triggers in succession have already opened the switches (HAL_PWM_BREAK_NOT_RENEWED), which is the same
 * fault; the count detects interrupts that are each a little too long. */

/* Successive periods without a deferred step that are the same fault, because the deferred checks then do not run: 0.4
 * ms at 20 kHz, so that every deferred check acts within 1 ms or the drive is off. A few are no fault: the deferred
 * interrupt may extend into the next periods when control interrupts of more than the usual length follow each other.
 */
#define PROTECTION_SKIPPED_DEFERRED_MAX 8

/* Start at a measured encoder angle. */
void protection_reset(protection_t *protection, uint32_t encoder_angle);
void protection_deferred_reset(protection_deferred_t *protection, uint32_t encoder_angle);

/* Immediate checks of one control period: fault mask of those that failed. */
uint64_t protection_check(const protection_parameters_t *parameters, protection_t *protection,
                          const protection_input_t *input);

/* Deferred checks: fault mask of those that failed. The frozen encoder is detected over every period since the previous
 * check, but no more than PROTECTION_SKIPPED_DEFERRED_MAX of them. */
uint64_t protection_check_deferred(const protection_parameters_t *parameters, protection_deferred_t *protection,
                                   const protection_deferred_input_t *input);

#endif
