/* Encoder against the machine: the flux linkage of a phase that conducts shows where the rotor is.
 *
 *   frozen      while the encoder stays at one count, the ratio of the flux linkage integrated from the voltage
 *               (control/applied_flux.h) to that of the tables at that count and the measured current is constant,
 *               whatever the gains of sensors and machine are. A rotor that turns changes it.
 *   angle       the integrated flux linkage of two phases is outside what the tables allow around the encoder's angle:
 *               offset, slip, wrong direction, a constant reading of another angle. Of one alone unless all
 *               others have agreed a short time ago: then the phase has a fault of its own (monitors/phase_monitor.h).
 *               Nor for 1/64 s while the rotor advances with the torque: it brings the next phase, which decides.
 *   over-speed  by the encoder's counts over half a millisecond: a sixteenth above the limit; or from a thirty-second
 *               below it when the observer's speed, which is finer, is above. Of the observer alone it is none: after
 *               an edge that came too early, or with a rotor on which it has just begun, its speed is not the rotor's.
 *
 * Frozen and angle compare two ways to the flux linkage, voltage and time on the one side, current and angle on the
 * other, and count when no resistance that a winding may have explains the difference (control/applied_flux.h). A rotor
 * that does not move, stalled or held by friction, contradicts nothing. Derived here.
 */
#ifndef MONITORS_ENCODER_MONITOR_H
#define MONITORS_ENCODER_MONITOR_H

#include <stdbool.h>
#include <stdint.h>

#include "control/commutation.h"
#include "hal.h"

/* Error of the encoder's angle that is none, mechanical degrees: eccentricity and alignment; where the misalignment is
 * learned, what the learning takes. */
#define ENCODER_MONITOR_ANGLE_DEG 2u
#define ENCODER_MONITOR_LEARNED_DEG 4u

/* Part of a stroke that the rotor advances within 1/256 s when it brings the next phase within 1/4 s; and counts of the
 * encoder that show it. */
#define ENCODER_MONITOR_ADVANCE_STROKES 64u
#define ENCODER_MONITOR_ADVANCE_COUNTS 2u

typedef struct {
    commutation_parameters_t commutation;
    uint32_t half_count;           /* of the encoder, 2^-32 electrical rev */
    uint32_t middle;               /* of a count, 2^-32 rev */
    int32_t advance_min;           /* of a rotor that soon brings the next phase, 2^-32 rev */
    uint32_t angle_max;            /* error of the angle that is none, 2^-32 electrical rev */
    int32_t flux_error_q29;        /* of the integral in a period, encoder_monitor_flux_error_q29() */
    int32_t resistance_period_q40; /* R Ts, ohm s, Q-9.40 */
    int32_t period_q40;            /* Ts, s, Q-9.40 */
    uint32_t rate_hz;              /* of the control periods */
    int32_t current_min_q9;        /* of a phase that is checked, A, Q7.9 */
    int32_t over_speed_q22;        /* limit of the speed's magnitude, rad/s, Q9.22 */
    int32_t travel;                /* of a period at that speed, 2^-32 rev */
    int32_t travel_change;         /* from period to period, the largest of a rotor, 2^-32 rev */
} encoder_monitor_parameters_t;

typedef struct {
    bool run;
    uint32_t encoder_angle;    /* start of the encoder count, 2^-32 rev */
    int32_t speed_q22;         /* of the observer, rad/s, Q9.22 */
    int32_t torque_q24;        /* of the speed law, N m, Q7.24 */
    int32_t flux_step_max_q29; /* DC-link voltage times the control period, Wb, Q2.29 */
    int32_t current_q9[HAL_PHASES_MAX];
    uint32_t period;                  /* of the sample, modulo 2^32 */
    int32_t flux_q29[HAL_PHASES_MAX]; /* by the applied voltage since the phase was last without current, Wb, Q2.29 */
    int32_t drop_q29[HAL_PHASES_MAX]; /* what the resistive drop has taken from it, Wb, Q2.29, >= 0 */
    uint32_t zero_at[HAL_PHASES_MAX]; /* period in which it was */
    bool known[HAL_PHASES_MAX];       /* no trigger was lost since */
    bool lost;                        /* triggers were lost since the previous input */
    uint32_t lost_phases;             /* bit of each phase that stays off (monitors/degraded.h) */
} encoder_monitor_input_t;

/* Of a phase. */
typedef struct {
    bool referred;           /* current to zero_at are set */
    bool shown;              /* the angle was contradicted for long enough, last in the period shown_at */
    int32_t current_q9;      /* at the reference, the largest since the count, A, Q7.9 */
    int32_t excess_q29;      /* of the integral over the tables at the reference, with a leak, Wb, Q2.29 */
    int32_t table_q29;       /* flux linkage by the tables, likewise */
    int32_t drop_q29;        /* what the resistive drop has taken from the integral since, likewise, >= 0 */
    int32_t last_excess_q29; /* of the last sample, Wb, Q2.29 */
    int32_t last_table_q29;
    uint32_t referred_at; /* period of the reference */
    uint32_t zero_at;     /* of the integral then */
    uint32_t moved;       /* periods for which they have parted */
    bool conducts;        /* in the last call; then: */
    int32_t last_current_q9, last_flux_q29;
    bool interrupted; /* by a current that moved without a voltage, when this zero was the last one: */
    uint32_t interrupted_zero_at;
    uint32_t contradicted; /* periods for which the angle has been contradicted */
    uint32_t shown_at;
    uint32_t shown_from; /* period since which it has been shown */
    uint32_t agrees;     /* periods in succession in which the angle was not contradicted */
    bool agreed;         /* for long enough, last in the period */
    uint32_t agreed_at;
} encoder_monitor_phase_t;

typedef struct {
    bool started;
    bool counted;                   /* in this run */
    bool suspicious;                /* a phase contradicted the angle, or nearly: samples without delay decide */
    bool frozen, angle, over_speed; /* failed checks */
    uint32_t period;                /* of the last call */
    uint32_t encoder_angle;         /* then */
    uint32_t window_period;         /* of the start of the window for the speed */
    uint32_t window_angle;
    bool turned;    /* a window had a clear travel */
    bool backwards; /* direction of the last one, which ended in the period turned_at */
    uint32_t turned_at;
    bool reversed; /* faster than a rotor, last in the period reversed_at */
    uint32_t reversed_at;
    bool advanced; /* the rotor, in this run, last in the period advanced_at */
    uint32_t advanced_at;
    uint32_t waypoint; /* angle from which it advances, 2^-32 rev */
    encoder_monitor_phase_t phase[HAL_PHASES_MAX];
} encoder_monitor_t;

/* Error of the integral that is none, per control period, Wb, Q2.29: half of the mean back-EMF of a phase, at a current
 * in A, Q7.9, when a free rotor has turned by 2 degrees at an acceleration, in the unit of speed per s. A rotor that
 * accelerates more slowly is found later, but after the same angle. angle_step_q32: as in load_observer_model_t.
 * [background] */
int32_t encoder_monitor_flux_error_q29(int64_t acceleration, int32_t current_q9, int32_t angle_step_q32,
                                       uint32_t rotor_poles);

/* Checks the sample. `frozen` remains until the encoder counts, `angle` until the state RUN ends: it needs current.
 * [background] */
void encoder_monitor_step(const encoder_monitor_parameters_t *parameters, encoder_monitor_t *monitor,
                          const encoder_monitor_input_t *input);

/* True when in the last quarter of a second a phase other than those whose bits are set has contradicted the angle, or
 * the encoder has turned round faster than a rotor: what has failed in these phases is the angle's, too. [background]
 */
bool encoder_monitor_suspects(const encoder_monitor_parameters_t *parameters, const encoder_monitor_t *monitor,
                              uint32_t phases);

#endif
