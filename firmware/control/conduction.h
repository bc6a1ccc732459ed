/* Conduction angles of the phases: torque sharing and single pulse operation.
 *
 * Windows of torque sharing are the machine's with the least copper loss, from tables over the torque and the
 * speed / voltage (tools/src/salient/machine/sharing_window.py), up to the base speed
 *
 *   on, off = (1 - w) still(T) + w base(T),   w = speed / voltage over its value at base speed, at most 1
 *
 * with straight lines over the torque T between quarters of the largest one that a window makes at every angle. The
 * angle in which a voltage builds up a flux linkage is proportional to speed / voltage: that is how far they begin and
 * end earlier. A current limit or an angle without torque moves none.
 *
 * Window advance, of constant windows that parameters set: a torque shortfall moves them to earlier angles
 * (torque_sharing.h), fully within 100 ms; without shortfall they return within 1 s, above base speed within 8 s. The
 * state is the same with windows from the tables, which it does not move: a shortfall that lasts. From base speed on
 * windows begin at the angles of the tables for parts of the largest torque.
 *
 * Single pulse: above base speed the voltage has no time to build up the flux linkage of the torque after the unaligned
 * position. Turn-on then leads the half in which the phase makes the wanted torque, and turn-off is early enough that
 * the flux linkage ends with the half. The angles of the largest torque over speed / voltage come from the generator
 * (tools/src/salient/machine/single_pulse.py). A level from 0, torque sharing, to 1 blends them in:
 *
 *   on = on_sharing + level * (-lead_max - on_sharing),   end = end_sharing + level * (end_max - end_sharing)
 *   level = (T - T_smooth) / (T_mean - T_smooth) + trim,   clamped to 0..1
 *
 * with angles past the start of that half, and T the mean of the reference over about a stroke. T_smooth is the largest
 * torque without lead and without ripple, T_mean the largest mean torque. The trim is the integral over the angle of
 * the missing torque, reference less estimate, half of it in an electrical revolution: it makes the mean torque equal
 * the reference. It begins where a shortfall has lasted, above base speed at once: the way by the advance is longer and
 * leaves up to 5 % of the torque missing. With single pulses the torque
 * pulsates, and the reference of the instantaneous torque is raised by level^2 (T_peak - T_mean): at low levels phases
 * still follow any reference, and one that is raised in proportion would be exceeded by the mean torque.
 *
 * From base speed on, fully at 1.125 of it, the angles are instead those for the part of the largest mean torque,
 *
 *   part = T / T_mean + trim,   reference += ripple(part) + trim T_mean
 *
 * from tables over part and speed / voltage (tools/src/salient/machine/partial_pulse.py): torque sharing, a single
 * pulse or what lies between, the smoothest that takes hardly more RMS current than the best pulse. Their windows may
 * be narrower than a stroke. There the trim is at most T / T_mean, so that it ends with the reference: with a phase
 * lost the others make up for half of the torque at most.
 *
 * Braking: with full -Vdc from an angle theta on, the current stays within its limit while the flux linkage is below
 * psi_t + Vdc / omega (theta_t - theta), the tangent to the flux linkage of the current limit. With torque sharing the
 * flux linkage ends at the unaligned position instead.
 *
 * The torque is limited to T_mean. Braking torque, whose energy goes into the DC link, is reduced linearly where the
 * voltage approaches the over-voltage threshold: a chopper that cannot take more, or none, does not end in a fault. The
 * range has room for the fields of the phases, which return to the link as the torque is taken away
 * (tools/src/salient/machine/fold_back.py). The integral of the voltage's excess over the start of that range, or over
 * the chopper's where that is higher, reduces it, too, until the voltage stays there.
 *
 * Of the room k, 0..1, that both leave for the braking torque, from base speed on a link takes less from longer pulses:
 *
 *   on -= (1 - k^2) part (end_max - lead_max),   |T| <= min(1, (1 + 3 part) k) T_mean
 *
 * At k = 0 a pulse of the largest torque would begin as far before the aligned position as it ends after it, without a
 * torque. Its current stays as large as at the largest torque: the windings dissipate what a chopper does not take.
 * Where the fields of a phase would fill the link at the voltage that it is held at, |T| <= k T_mean instead, as below
 * base speed.
 *
 * The torque follows the reference once in a stroke. A speed law with a gain k of the order of the stroke rate f makes
 * every second pulse larger: the error is multiplied by 1 - k / f from stroke to stroke. From base speed on its gain is
 * reduced, at an eighth above it to f / 4.
 *
 * J. M. Stephenson, S. R. MacMinn, J. R. Hendershot, "Switched reluctance drives", tutorial, IEEE IAS 1990; the blend
 * and the trim derived here.
 */
#ifndef CONTROL_CONDUCTION_H
#define CONTROL_CONDUCTION_H

#include <stdbool.h>
#include <stdint.h>

#include "control/machine_tables.h"
#include "control/torque_sharing.h"

/* Halves of the electrical revolution: phases that move towards the aligned position, and phases that move away from
 * it. */
enum { CONDUCTION_MOTORING, CONDUCTION_BRAKING, CONDUCTION_HALVES };

/* Angles in 2^-32 electrical rev, of a phase mirrored into 2^31 unaligned .. 2^32 aligned. */
typedef struct {
    torque_sharing_window_t window;
    uint32_t width; /* from turn-on to where a phase makes up for no shortfall any more; UINT32_MAX: it always does */
    uint32_t lead;  /* before the end of the half, of the turn-on for the half that follows; 0: no pulse */
    /* A phase past the angle `end` carries at most the flux linkage of which -Vdc leaves `flux` there, in units of the
     * tables. */
    uint32_t end;
    int32_t flux;
} conduction_half_t;

typedef struct {
    conduction_half_t half[CONDUCTION_HALVES];
    int32_t ripple_q24; /* to add to the torque reference, N m, Q7.24, with its sign */
} conduction_t;

typedef struct {
    torque_sharing_parameters_t sharing;
    conduction_t initial;   /* torque sharing without advance */
    bool own_windows;       /* of the machine, from its tables; false: constant, and advanced */
    bool single_pulse;      /* false: torque sharing only */
    uint8_t longer_pulses;  /* 3: where the DC link limits the braking torque, from base speed on; 0: never */
    int32_t torque_min_q24; /* limits of the torque reference, N m, Q7.24 */
    int32_t torque_max_q24;
    int32_t advance_step_q30; /* per update with torque shortfall, Q1.30 */
    int32_t retract_step_q30; /* per update without, Q1.30 */
    int32_t braking_end_q6;   /* DC-link voltage from which there is no braking torque, V, Q9.6 */
    uint32_t
        gain_per_step_q16; /* a quarter of the strokes per update over the gain of the speed law in an update, Q16.16 */
    int32_t fold_back_range_q6;  /* voltage range below, in which it decreases to 0, V, Q9.6, >= 1 */
    int32_t full_link_q6;        /* voltage of conduction_braking_q24 without braking torque, V, Q9.6 */
    int32_t full_link_range_q6;  /* below it, V, Q9.6 */
    int32_t full_link_slope_q18; /* N m per V up to there, Q7.18 */
} conduction_parameters_t;

/* Point of the tables: index of the lower one, and fraction of the way to the next. */
typedef struct {
    uint32_t k;
    int32_t fraction_q8;
} conduction_place_t;

/* Between two points of the tables. */
typedef struct {
    uint32_t lead, end; /* of machine_pulse_t, 2^-32 electrical rev */
    int32_t smooth_q24, mean_q24, peak_q24;
} conduction_pulse_t;

/* Positions of a phase past its entry into a half, against which it moves, 2^-32 electrical rev; before it: from 2^31.
 */
typedef struct {
    uint32_t enter, leave; /* of the window */
    uint32_t on;           /* turn-on */
} conduction_interval_t;

/* Pulse for a part of the largest mean torque. */
typedef struct {
    uint32_t on, end;   /* past the start of the half, 2^-32 electrical rev */
    int32_t ripple_q24; /* to add to the torque reference, N m, Q7.24 */
} conduction_partial_pulse_t;

/* Window of torque sharing, past the start of the half, 2^-32 electrical rev. */
typedef struct {
    uint32_t on, off;
} conduction_sharing_t;

/* Steps of an update, in turn, one in each call: an update at once would exceed the instructions that a period has left
 * for the deferred interrupt. */
typedef enum {
    CONDUCTION_LOOK_UP,    /* tables at the present speed and voltage; mean of the torque */
    CONDUCTION_MOVE,       /* level or part by the law in effect; gain of the speed law */
    CONDUCTION_CHOOSE_LAW, /* by the present speed; above base speed the pulse for the part */
    CONDUCTION_POSITIONS,  /* limits of the torque; turn-on, window and ripple by both laws */
    CONDUCTION_ANGLES,     /* angles of the update, which are then the latest */
} conduction_step_t;

#define CONDUCTION_STEPS 5

/* The update in progress: what a step leaves for the later ones. Nothing of it outlasts the update. */
typedef struct {
    unsigned step; /* the next one, conduction_step_t */
    conduction_place_t place;
    conduction_pulse_t pulse;
    int32_t motoring_max_q24; /* largest mean torque, by magnitude, N m, Q7.24 */
    int32_t braking_max_q24;
    uint32_t extension; /* by which a braking pulse begins earlier, 2^-32 electrical rev */
    conduction_partial_pulse_t partial;
    conduction_interval_t interval; /* of the half with the torque */
    int32_t ripple_q24;             /* to add to the magnitude of the torque reference, N m, Q7.24 */
} conduction_update_t;

#define CONDUCTION_INITIAL 2 /* index of no update yet */

typedef struct {
    /* Results. */
    conduction_t angles[2]; /* of the last two updates */
    unsigned latest;        /* index of the last, or CONDUCTION_INITIAL */
    bool single_pulse;      /* the torque pulsates, or a phase turns on before its half */
    int32_t torque_min_q24; /* limits of the torque reference, N m, Q7.24 */
    int32_t torque_max_q24;
    int32_t gain_excess_q31; /* reduction of the speed law's gain, part of it, Q0.31, >= 0 */
    /* Both laws. */
    uint8_t braking;         /* torque against the rotation, when it is not 0 */
    int32_t torque_q24;      /* reference by magnitude, above base speed smoothed, N m, Q7.24 */
    int32_t missing_sum_q21; /* reference less estimated torque, of all steps of an update, N m, Q10.21 */
    int32_t trim_q30;        /* of the level or the part, Q1.30, -1..1 */
    int32_t advance_q30;     /* of the windows, Q1.30, 0..1 */
    int32_t level_q15;       /* Q1.15, 0..1 */
    int32_t part_q15;        /* of the largest mean torque, below base speed the level, Q1.15, 0..1 */
    int32_t above_base_q15;  /* from the base speed to 1.125 of it, Q1.15, 0..1 */
    int32_t partial_q15;     /* the same with single pulses, else 0: weight of the law above base speed */
    /* Braking torque. */
    uint16_t room_q15; /* of the DC link for it, part of the largest, Q1.15, 0..1 */
    int32_t link_q30;  /* slow part of its limit, Q1.30, 0..1 */
} conduction_state_t;

typedef struct {
    int32_t torque_q24;           /* reference, N m, Q7.24 */
    int32_t torque_sum_q24;       /* estimated, N m, Q7.24 */
    int32_t torque_shortfall_q24; /* of the reference with its ripple, N m, Q7.24 */
    int32_t speed_q22;            /* rad/s, Q9.22 */
    uint32_t angle_step;          /* magnitude of the rotation during an update, 2^-32 electrical rev */
    int32_t dc_link_voltage_q6;   /* V, Q9.6 */
} conduction_sample_t;

/* A rotor that returns no energy, whatever the torque: below 2 rad/s, or that times the unit of speed, the windings
 * dissipate more. A full DC link leaves it the torque to start in either direction. */
static inline bool conduction_at_rest(int32_t speed_q22) {
    return (uint32_t)speed_q22 + (2u << 22) < 4u << 22;
}

/* Limit of the braking torque's magnitude by what the DC link can take, from the voltage of the present period: N m,
 * Q7.24, INT32_MAX where there is none. Faster than the limits of an update, in which the fields of the phases alone
 * could fill the link. */
static inline int32_t conduction_braking_q24(const conduction_parameters_t *parameters, int32_t dc_link_voltage_q6) {
    const int32_t room_q6 = parameters->full_link_q6 - dc_link_voltage_q6;
    return room_q6 > parameters->full_link_range_q6 ? INT32_MAX
           : room_q6 <= 0                           ? 0
                                                    : room_q6 * parameters->full_link_slope_q18;
}

/* Angles of torque sharing without advance. */
conduction_t conduction_initial(const torque_sharing_window_t *window);

/* State without an update; the angles of earlier ones are left as they are. An update in progress begins again. */
static inline void conduction_reset(const conduction_parameters_t *parameters, conduction_state_t *state,
                                    conduction_update_t *update) {
    update->step = CONDUCTION_LOOK_UP;
    state->torque_min_q24 = parameters->torque_min_q24;
    state->torque_max_q24 = parameters->torque_max_q24;
    state->link_q30 = 1 << 30;
    state->room_q15 = 1 << 15;
    state->advance_q30 = 0;
    state->trim_q30 = 0;
    state->level_q15 = 0;
    state->partial_q15 = 0;
    state->missing_sum_q21 = 0;
    state->single_pulse = false;
    state->gain_excess_q31 = 0;
    state->latest = CONDUCTION_INITIAL;
}

/* The next step of the update in progress. Rounded down are the place in the tables, to 2^-8 of the distance of two
 * points, the level and the part, to 2^-15, of torques to 2^-8 N m, and angles of the tables, to 2^-24 rev; what lies
 * between two angles, and the limit of the braking torque, is rounded to 4 LSB. */
void conduction_step(const conduction_parameters_t *parameters, conduction_state_t *state, conduction_update_t *update,
                     const machine_tables_t *tables, const conduction_sample_t *sample);

/* CONDUCTION_MOTORING or CONDUCTION_BRAKING, whatever has changed in memory. */
static inline unsigned conduction_half_of(const conduction_state_t *state) {
    return state->braking != 0 ? CONDUCTION_BRAKING : CONDUCTION_MOTORING;
}

/* Angles of the update with an index. */
static inline const conduction_t *conduction_angles(const conduction_parameters_t *parameters,
                                                    const conduction_state_t *state, unsigned index) {
    return index >= CONDUCTION_INITIAL ? &parameters->initial : &state->angles[index];
}

#endif
