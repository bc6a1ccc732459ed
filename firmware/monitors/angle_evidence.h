/* Encoder against the machine: the flux linkage of a phase that conducts (control/flux_residual.h) shows where the
 * rotor is.
 *
 *   parted            while the encoder stays at one count, the ratio of psi(v) to the tables at that count and the
 *                     measured current is constant, whatever the gains of sensors and machine are. A rotor that turns
 *                     changes it; for 1/2048 s it is evidence, until the encoder counts
 *   contradicts       psi(v) is outside what the tables allow around the encoder's angle, for three periods: offset,
 *                     slip, wrong direction, a constant reading of another angle
 *   contradicts_alone one phase has for 1/256 s, unless all others have agreed a short time ago: then the phase has a
 *                     fault of its own. Nor for 1/64 s while the rotor advances with the torque: it brings the next
 *                     phase, which decides
 *
 * They count when no resistance that a winding may have explains the difference. What no angle explains, or parts
 * faster than a rotor can turn, is a fault of the phase. A rotor that does not move, stalled or held by friction,
 * contradicts nothing. Derived here.
 */
#ifndef MONITORS_ANGLE_EVIDENCE_H
#define MONITORS_ANGLE_EVIDENCE_H

#include <stdbool.h>
#include <stdint.h>

#include "control/commutation.h"
#include "control/flux_residual.h"
#include "hal.h"
#include "monitors/flux_evidence.h"

/* Tolerated error of the encoder's angle, mechanical degrees: eccentricity and alignment; where the misalignment is
 * learned, what the learning takes. */
#define ANGLE_EVIDENCE_DEG 2u
#define ANGLE_EVIDENCE_LEARNED_DEG 4u

/* Part of a stroke that the rotor advances within 1/256 s when it brings the next phase within 1/4 s; and counts of the
 * encoder that show it. */
#define ANGLE_EVIDENCE_ADVANCE_STROKES 64u
#define ANGLE_EVIDENCE_ADVANCE_COUNTS 2u

typedef struct {
    commutation_parameters_t commutation;
    uint32_t half_count;    /* of the encoder, 2^-32 electrical rev */
    uint32_t middle;        /* of a count, 2^-32 rev */
    int32_t advance_min;    /* of a rotor that soon brings the next phase, 2^-32 rev */
    uint32_t angle_max;     /* tolerated error of the angle, 2^-32 electrical rev */
    int32_t flux_error_q29; /* of the integral in a period, angle_evidence_flux_error_q29() */
    uint32_t rate_hz;       /* of the control periods */
    int32_t current_min_q9; /* of a phase that is checked, A, Q7.9 */
} angle_evidence_parameters_t;

/* Evidence of a phase. */
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
} angle_evidence_phase_t;

typedef struct {
    bool started;           /* the next is set */
    uint32_t encoder_angle; /* of the last sample */
    bool counted;           /* in this run */
    bool parted;
    bool advanced; /* the rotor, in this run, last in the period advanced_at */
    uint32_t advanced_at;
    uint32_t waypoint; /* angle from which it advances, 2^-32 rev */
    angle_evidence_phase_t phase[HAL_PHASES_MAX];
} angle_evidence_t;

/* Tolerated error of the integral, per control period, Wb, Q2.29: half of the mean back-EMF of a phase, at a current
 * in A, Q7.9, when a free rotor has turned by 2 degrees at an acceleration, in the unit of speed per s. A rotor that
 * accelerates more slowly is found later, but after the same angle. angle_step_q32: as in load_observer_model_t.
 * [background] */
int32_t angle_evidence_flux_error_q29(int64_t acceleration, int32_t current_q9, int32_t angle_step_q32,
                                      uint32_t rotor_poles);

/* Adds the evidence of a sample. `parted` remains until the encoder counts; the others are of a run. [background] */
void angle_evidence_step(const angle_evidence_parameters_t *parameters, angle_evidence_t *state,
                         const flux_residual_t *residual, flux_evidence_t *evidence);

#endif
