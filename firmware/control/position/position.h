/* Set points of the position control, and what it reports: the interface of every protocol to it.
 *
 * A position is absolute over any number of turns, from the zero that the homing has set, or until then from the zero
 * of the encoder in the turn of the start. Forward rotation counts up. It has 2^-32 revolutions in 64 bits;
 * POSITION_MAX bounds set points to +-8192 revolutions, of which every difference fits. A rotor that turns further, by
 * more than a revolution, begins a new range at 0 and is no longer homed.
 */
#ifndef CONTROL_POSITION_POSITION_H
#define CONTROL_POSITION_POSITION_H

#include <stdbool.h>
#include <stdint.h>

#define POSITION_ONE_REV (INT64_C(1) << 32)
#define POSITION_MAX (POSITION_ONE_REV << 13)

/* Use of a set point while the drive runs in position mode. */
typedef enum {
    POSITION_ORDER_PROFILE, /* moves to the target by the profile; another target or limit re-plans the move */
    POSITION_ORDER_CYCLIC,  /* follows targets that come every 1 to 10 ms, interpolated */
    POSITION_ORDER_HOME,    /* homes by the method, once for each time that the order begins */
    POSITION_ORDER_HALT,    /* stops by the deceleration of the profile and holds */
} position_order_t;

typedef enum {
    POSITION_HOMING_HERE,           /* the present place becomes the target of the set point */
    POSITION_HOMING_INDEX_FORWARD,  /* the next zero of the encoder forwards, likewise */
    POSITION_HOMING_INDEX_BACKWARD, /* backwards */
    POSITION_HOMING_STOP_FORWARD,   /* a mechanical stop, found by its torque, forwards */
    POSITION_HOMING_STOP_BACKWARD,  /* backwards */
    POSITION_HOMING_METHODS         /* of a set point: as the parameter homing_method has it */
} position_homing_t;

/* Written by the background with the interrupts masked. Values beyond their range are limited to it; a limit of 0 is
 * the one of the parameters, and none exceeds theirs. */
typedef struct {
    position_order_t order;
    position_homing_t homing;   /* of POSITION_ORDER_HOME */
    uint32_t sequence;          /* changes with each set point: two equal cyclic targets are two */
    bool bounded;               /* by lowest and highest */
    bool acknowledges;          /* of POSITION_ORDER_HALT: each new sequence does, not its start alone */
    int64_t target;             /* 2^-32 rev; of POSITION_ORDER_HOME: what the place found is called */
    int32_t speed_q22;          /* of the profile, rad/s times the unit of the machine's speeds, Q9.22, >= 0 */
    int32_t acceleration_rpm_s; /* r/min/s, >= 0 */
    int32_t deceleration_rpm_s; /* r/min/s, >= 0 */
    int32_t jerk_rpm_s2;        /* r/min/s^2, >= 0 */
    int32_t speed_offset_q22;   /* cyclic: added to the speed reference, likewise Q9.22 */
    int32_t torque_offset_q24;  /* cyclic: added to the torque reference, N m, Q7.24 */
    uint32_t cycle_ms;          /* cyclic: period of the targets; 0: position_cycle_ms */
    int64_t lowest, highest;    /* software end stops within the parameters', 2^-32 rev, lowest <= highest */
} position_set_point_t;

/* Written by the deferred interrupt; the background reads it with the interrupts masked, or by an unmasked read. */
typedef struct {
    bool active;                 /* the drive runs in position mode */
    bool homed;                  /* a homing since the start has set the zero */
    bool homing;                 /* under way */
    bool homing_failed;          /* the last one found nothing, or was interrupted */
    bool in_position;            /* at the target of a profile that has ended, within position_window_deg */
    bool reference_ended;        /* the profile has arrived, CiA 402: the reference no longer moves */
    bool following_error;        /* it was beyond following_error_deg: stopped until a halt */
    bool limited;                /* the target is beyond a software end stop, and is the stop instead */
    uint32_t sequence;           /* of the set point that the reference follows */
    uint32_t arrived;            /* of the one that in_position and reference_ended are of */
    int64_t position;            /* 2^-32 rev, in every state and mode */
    int64_t reference;           /* 2^-32 rev; position while not active */
    int32_t error;               /* reference - position, 2^-32 rev, saturated */
    int32_t speed_reference_q22; /* of the reference, rad/s, Q9.22 */
} position_status_t;

#endif
