/* Stalled rotor: in speed mode, no change of the speed with the torque at its limit, or no progress of a rotor that
 * swings.
 *
 * The rotor turns slower than at half of the reference, in either direction, or has begun so and turned backwards
 * within STALL_TIME_US, the torque reference is within a sixteenth of its limit in the direction of the speed
 * reference, and in STALL_TIME_US the speed has become neither higher nor lower than before by a 128th of the
 * reference: a rotor that swings about a point is stalled, one that a larger load drives backwards faster and faster
 * leads to over-speed instead. A start that takes up to 12 s from standstill to the reference is no stall. A reference
 * of 0 is held as long as the currents can be. A reference that changes its sign begins anew.
 *
 * Or, whatever the torque: for STALL_SWING_US and the time in which the reference turns by three strokes, at most 12 of
 * them a STALL_SWING_US, the rotor has come no further than it had been, by half a stroke in either direction, nor has
 * it since turned backwards more slowly than before, by a 128th of the reference, and it has turned backwards within
 * STALL_TIME_US. With a phase lost it may swing between two angles for ever, at times faster than the reference. A
 * heavy rotor that comes to its reference from the other side takes longer for the last half stroke before its
 * standstill.
 */
#ifndef MONITORS_STALL_MONITOR_H
#define MONITORS_STALL_MONITOR_H

#include <stdbool.h>
#include <stdint.h>

#define STALL_TIME_US 100000u
#define STALL_SWING_US 225000u

typedef struct {
    bool speed_mode;              /* state RUN, speed mode */
    int32_t speed_reference_q22;  /* after the ramp, rad/s, Q9.22 */
    int32_t speed_q22;            /* rad/s, Q9.22 */
    int32_t torque_reference_q24; /* N m, Q7.24 */
    int32_t torque_min_q24;       /* limits of the torque reference, N m, Q7.24 */
    int32_t torque_max_q24;
    uint32_t electrical; /* 2^-32 electrical rev */
} stall_input_t;

typedef struct {
    uint32_t changed_us;             /* when the speed last left its range, or there was none */
    int32_t lowest_q22, highest_q22; /* range of the speed in the direction of its reference, rad/s, Q9.22 */
    uint32_t backwards_us;           /* when the rotor last turned against the reference, or longer ago than counts */
    bool forward;                    /* the speed reference at the last call */
    bool vain;                       /* torque and speed of a stall at the last call */
    uint32_t electrical;             /* at the last call, 2^-32 electrical rev */
    uint32_t looked_us;              /* of the last call */
    int32_t ahead_q24;               /* of the highest angle so far, electrical rev, Q8.24 */
    int32_t lowest_ahead_q24;        /* the lowest one, -1 at least */
    int32_t slowest_q22; /* backwards, a negative speed, since the rotor was last at a higher or lower one */
    uint64_t travel;     /* of the reference since then, or since it last became slower */
} stall_monitor_t;

/* True when the rotor has been stalled for STALL_TIME_US at time_us. [background] */
bool stall_monitor_failed(stall_monitor_t *monitor, const stall_input_t *input, uint32_t time_us);

#endif
