/* Periodic load: a load torque that repeats with every turn of the rotor, as a piston compressor's does, learned over
 * the rotor angle.
 *
 * The load observer follows a moving load with the delay of its bandwidth. A load that depends on the angle is known
 * before it comes: the profile p, 64 values over a turn, is fed forward and given to the observer, which then estimates
 * the rest y only. Iterative learning, one iteration per turn (D. A. Bristow, M. Tharayil, A. G. Alleyne, "A survey of
 * iterative learning control", IEEE Control Syst. Mag. 26(3), 2006):
 *
 *   p += 1/4 (Q z - m - p),   z = p + y,   m the mean of y,   Q z = z + a (z of both neighbours - 2 z)
 *
 * The estimate of a load sine of frequency w is (1 + jw / w0)^-3 of it at the observer's bandwidth w0. y belongs to the
 * angle of 2.2 / w0 before, with which the phase error is below 20 degrees up to w = w0 and the learning converges up
 * to 2.4 w0, whatever the amplitudes. The low-pass Q acts beyond: a = L / 64, where the delay of 2.2 / w0 is L values
 * of the profile; from L = 8 on nothing is learned. Without Q, or with the same one at any speed, the profile of a
 * compressor would grow at high speeds, or at low ones miss the corner where a valve opens.
 *
 * A load that does not repeat must not be learned: between the harmonics of the turn, learning amplifies. So each turn
 * is judged by means of magnitudes over it:
 *
 *   load      mean |z - m|        below the threshold, or a quarter of the residual: the profile is cleared
 *   change    mean |z - z before| below half of the residual: the load repeats better than the profile tells, learn
 *   residual  mean |y - m|        above the load: the profile makes it worse, forget half of it
 *
 * The ripple of the machine itself, of an encoder that is displaced, repeats with every pole pitch. It is not for this
 * law, which would hide it from what learns the misalignment: without a quarter of it in means over a pole pitch, slow
 * below, a profile is cleared as well.
 *
 *   slow      mean |z over a pole pitch - m|
 *
 * else the profile stays. A sine whose phase moves by x per turn changes by 2 sin(x / 2) of itself, so that it is
 * learned up to x = 29 degrees, where learning with 1/4 makes it neither smaller nor larger. A load step changes more
 * than it leaves as a residual, and a constant load has no residual. Values are learned a quarter of a turn before the
 * angle comes, from the last turn's estimate, so that a turn has one profile.
 *
 * A profile whose load has stopped is all of the residual. It is cleared within the turn: when y has changed by as much
 * as z did in the mean of the last turn, and z by less than a quarter of that. */
#ifndef CONTROL_PERIODIC_LOAD_H
#define CONTROL_PERIODIC_LOAD_H

#include <stdbool.h>
#include <stdint.h>

#define PERIODIC_LOAD_VALUES 64

typedef struct {
    int32_t lag_periods;     /* 2.2 / w0, control periods; 0: no learning */
    int32_t angle_step_max;  /* rotation per period up to which L is below 8, 2^-32 rev */
    uint32_t threshold_q8;   /* sum of magnitudes over a turn from which a load is learned, N m, Q23.8 */
    int32_t torque_limit_q8; /* of the profile, N m, Q7.8 */
    uint32_t pitch;          /* values of a pole pitch */
} periodic_load_parameters_t;

/* Effect of this turn on the profile. */
typedef enum {
    PERIODIC_LOAD_CLEAR, /* all values become 0; the torque is 0 from the start */
    PERIODIC_LOAD_KEEP,
    PERIODIC_LOAD_LEARN,
    PERIODIC_LOAD_FORGET
} periodic_load_mode_t;

/* N m, Q23.8. */
typedef struct {
    int32_t least_q8, most_q8;
} periodic_load_range_t;

/* All zero at the start. */
typedef struct {
    int16_t profile_q8[PERIODIC_LOAD_VALUES];  /* p, N m, Q7.8; of the middle of its interval of angles */
    int16_t estimate_q8[PERIODIC_LOAD_VALUES]; /* z of the last turn, N m, Q7.8 */
    int32_t torque_q24;                        /* p at the angle of the last step, N m, Q7.24 */
    int32_t mean_q8;                           /* m of the last turn */
    uint8_t mode;                              /* periodic_load_mode_t */
    bool engaged;                              /* a profile has been learned and not been cleared since */
    uint16_t updates;                          /* of the present value; 0: none has begun */
    bool moved;                                /* the load moved in this turn */
    uint32_t index;                            /* of the present value */
    int32_t sum_q8;                            /* of y, over its updates */
    /* Sums over the values of this turn, N m, Q23.8: */
    uint32_t count;
    int32_t total_q8; /* of y */
    uint32_t load_q8, change_q8, residual_q8, slow_q8;
    uint32_t window;   /* values in the mean over a pole pitch, up to all */
    int32_t window_q8; /* their sum */
    /* Since the ranges began anew: */
    uint32_t reviewed_index;
    bool reviewed;                            /* they have a value */
    periodic_load_range_t estimate, residual; /* of z and y */
    int32_t swing_q8;                         /* from which y is judged: mean |z - m| of the last turn */
} periodic_load_t;

typedef struct {
    uint32_t angle;          /* of the rotor, 2^-32 rev */
    int32_t angle_step;      /* rotation per control period, 2^-32 rev */
    int32_t load_torque_q24; /* y: estimate of the observer to which the profile is given, N m, Q7.24 */
    bool moving;             /* the load moves, and the observer has the bandwidth w0 */
} periodic_load_sample_t;

/* Rate of the control in Hz, w0 in rad/s (0: no learning), largest torque in N m, Q7.24; rotor poles 1..64. */
periodic_load_parameters_t periodic_load_configure(uint32_t control_rate_hz, uint32_t bandwidth_rad_s,
                                                   int32_t torque_max_q24, unsigned rotor_poles);

/* Forgets the profile. */
void periodic_load_reset(periodic_load_t *load);

/* One sample; sets load->torque_q24, of the angle four control periods later. Steps of the angle by more than a value
 * of the profile, or against the direction of rotation, begin another turn. Values are means over their interval,
 * rounded towards zero, other terms down, between which the torque is interpolated; the profile is clamped to the
 * limit. */
void periodic_load_step(const periodic_load_parameters_t *parameters, periodic_load_t *load,
                        const periodic_load_sample_t *sample);

/* Between steps, at least once for most of the values: clears a profile whose load has stopped. */
void periodic_load_review(periodic_load_t *load);

#endif
