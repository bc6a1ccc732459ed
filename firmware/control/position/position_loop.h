/* Position loop: the reference of an order, and the speed and torque with which the speed loop follows it.
 *
 *   w* = w_r + K (x_r - x),   T += J a_r
 *
 * with x_r, w_r, a_r the reference, K position_gain_1_s. The speed loop adds the estimated load and friction. With its
 * reaching law J k (w* - w) this is the full-state law a = a_r + k (w_r - w) + k K (x_r - x), its poles at
 * (k +- sqrt(k^2 - 4 k K)) / 2: a cascade that is no less stiff (derived here).
 *
 * The position is the sum of the counts since the start, over any number of turns, and the observer's angle within
 * them, less the zero of the homing. It is followed in every state.
 *
 * Orders, decided in each tick of profile.h:
 *
 *   profile   the profile goes to the target
 *   cyclic    each target is reached position_cycle_ms after it has come, by a cubic in time, with the speed of the
 * last three targets at its end; what asks for more speed or acceleration than the limits is approached by the profile.
 * Without a new target for two cycles more the reference stops by the profile halt      the profile stops home      the
 * profile moves at homing_speed_rpm until the place is found, which then is called the target; to the zero of the
 * encoder it returns
 *
 * Between slow counts (slow_counts.h) a reference at rest is reached by a rotor within its count: what the model says
 * of the angle in it would move the rotor from edge to edge.
 *
 * An error beyond following_error_deg for a tick is a controlled stop: the reference continues from where the rotor is,
 * and stops. Orders have no effect until a halt, or the end of the run, has acknowledged it. The drive itself is not in
 * doubt: what blocks or drives the rotor beyond its torque is the affair of the monitors of shaft, encoder and speed.
 */
#ifndef CONTROL_POSITION_POSITION_LOOP_H
#define CONTROL_POSITION_POSITION_LOOP_H

#include <stdbool.h>
#include <stdint.h>

#include "control/position/position.h"
#include "control/position/profile.h"

#define POSITION_CYCLE_TICKS_MAX 100

/* Period of cyclic targets. */
typedef struct {
    uint32_t ticks;                  /* 1..POSITION_CYCLE_TICKS_MAX */
    profile_scale_t half_per_ticks;  /* 1 / 2n */
    profile_scale_t half_per_ticks2; /* 1 / 2n^2 */
    profile_scale_t half_per_ticks3; /* 1 / 2n^3 */
} position_cycle_t;

/* Read by the interrupts. Positions in 2^-48 rev. */
typedef struct {
    uint32_t periods_per_tick;
    uint32_t part_per_period_q32; /* of a tick */
    int64_t per_speed_q16;        /* LSB of Q9.22 in 2^-48 rev per tick, Q16 */
    profile_scale_t speed_of;     /* speed of a profile to Q9.22 */
    profile_scale_t gain;         /* K: position to speed, Q9.22 */
    profile_scale_t torque_of;    /* acceleration to torque, N m, Q7.24 */
    int64_t window;
    int64_t following_error;
    int64_t homing_speed; /* 2^-48 rev per tick */
    int32_t homing_torque_q24;
} position_law_t;

/* Limits of set points, read by the background alone: it makes a command of a set point (position_command). Positions
 * in 2^-48 rev. */
typedef struct {
    uint32_t speed_exponent;
    int64_t lowest, highest;  /* software end stops */
    int64_t acceleration_max; /* of the inertia of the parameter by 3/4 of the largest torque */
    position_cycle_t cycle;   /* of a set point without its own */
    profile_limits_t limits;  /* likewise */
} position_plan_t;

typedef struct {
    position_law_t law;
    position_plan_t plan;
} position_parameters_t;

/* Set point with what follows from it; written by the background with the interrupts masked. */
typedef struct {
    position_set_point_t set_point;
    profile_limits_t limits;
    position_cycle_t cycle;
    int64_t lowest, highest;   /* software end stops, 2^-48 rev */
    int32_t inertia_ratio_q14; /* identified inertia by the parameter's, of which the limits are, at most 8 */
} position_command_t;

typedef enum { POSITION_HOMING_IDLE, POSITION_HOMING_SEEKS, POSITION_HOMING_RETURNS } position_homing_step_t;

/* All zero at the start. */
typedef struct {
    bool started;
    uint32_t encoder_angle; /* of the last step, 2^-32 rev */
    int64_t counted;        /* 2^-32 rev since the start, and the angle then */
    int64_t zero;           /* counted at position 0 */
    profile_t profile;
    uint32_t phase; /* periods since the start of the tick */
    int64_t target; /* of the profile, 2^-48 rev */
    bool stops;     /* target is where a stop ends */
    bool chases;    /* target is where cyclic targets, as they move on, would stop */
    position_order_t order;
    uint32_t sequence;     /* of the last set point */
    int64_t past[2];       /* cyclic targets before the last one, 2^-48 rev */
    uint32_t targets;      /* cyclic targets in succession, up to 3 */
    uint32_t silent_ticks; /* since the last one */
    uint32_t cubic_ticks;  /* left of the cubic */
    position_homing_step_t homing;
    uint32_t blocked_ticks;
    int64_t turn;              /* of the encoder, when the homing began to seek */
    int32_t inertia_ratio_q14; /* of the command in the last tick */
    position_status_t status;
} position_t;

/* One period. */
typedef struct {
    uint32_t encoder_angle; /* start of the count, 2^-32 rev */
    uint32_t angle;         /* observer, 2^-32 rev */
    int64_t speed;          /* 2^-48 rev per tick */
    bool at_torque_limit;
    uint32_t count;   /* 2^-32 rev, while the angle within it is one of the model alone; else 0 */
    uint32_t periods; /* since the last step */
} position_sample_t;

typedef struct {
    int32_t speed_q22;  /* reference, Q9.22, saturated */
    int32_t torque_q24; /* to accelerate the inertia of the parameter, N m, Q7.24, saturated */
} position_output_t;

/* Follows the position while the drive is not in position mode. The rotor has turned by less than half a revolution
 * since the last call of this or the next function. [deferred interrupt] */
void position_follow(position_t *position, uint32_t encoder_angle, uint32_t angle);

/* One step of position mode. [deferred interrupt] */
position_output_t position_step(const position_law_t *parameters, position_t *position,
                                const position_command_t *command, const position_sample_t *sample);

/* True while a torque above homing_torque_q24 must not act. */
static inline bool position_seeks_stop(const position_t *position) {
    return position->status.active && position->homing == POSITION_HOMING_SEEKS;
}

#endif
