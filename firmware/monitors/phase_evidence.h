/* Plausibility of the phase currents: flux linkage psi that the voltage has built up against the tables' at the
 * measured current and angle (control/flux_residual.h).
 *
 *   too_little        psi above the tables' at 1.1 i + offset, at any angle, in two samples
 *   excess            psi below the tables' at (i - offset) / 1.1, at any angle; a current in a phase which the voltage
 *                     has left without flux linkage; or one that remains when both switches are open and the voltage
 *                     has removed a quarter of psi, of which the tables saw less than a quarter disappear: freewheeling
 *                     by a shorted switch. After 1/4 ms it moves, by more than the offset, or is still: at once when
 *                     not even its last bit changes, after 8 ms, or when it ends after 1/2 ms
 *   ..._at_angle      the same two at the measured angle, for 1/32 electrical revolution by the encoder, and again in
 *                     the next stroke, in one phase alone while all others agree; a second phase within an electrical
 *                     revolution and 20 ms makes it the encoder's, or what all sensors have in common
 *   missing           voltage without current, or a current that has ended within the last 2 ms before the voltage had
 *                     removed it
 *
 * Tolerances: current 10 % and 1/128 of its range, flux linkage 15 %, angle 10 degrees electrical, and the ones
 * in flux_residual.h. At a current of up to 4/128 of its range, a small one, too_little counts only what more than this
 * tolerance of voltage and resistance has built up since the current was larger. An error of the angle explains any psi
 * between the unaligned and the aligned position's.
 *
 * What a phase without current cannot tell apart: an open winding, an open switch, the gate supply, a dead sensor. What
 * shows nothing at all: a negative offset in a phase that stands without current, because the converter reads 0; an
 * error within the tolerances; a fault of a phase without voltage.
 */
#ifndef MONITORS_PHASE_EVIDENCE_H
#define MONITORS_PHASE_EVIDENCE_H

#include <stdbool.h>
#include <stdint.h>

#include "control/flux_residual.h"
#include "hal.h"
#include "monitors/flux_evidence.h"

typedef struct {
    int32_t base_q29;          /* flux linkage when the current was last seen, or less, Wb, Q2.29 */
    uint32_t excess_periods;   /* with a current that should not be */
    int32_t least_q9, most_q9; /* its range, A, Q7.9 */
    int32_t turned;            /* rotation since a difference at the measured angle began, 2^-32 electrical rev */
    int8_t side;               /* of that difference: 1 less current than by the voltage, -1 more, 0 none */
    uint8_t open_samples;      /* in succession with less current than at any angle */
    int32_t off_flux_q29;      /* flux linkage by the voltage when the switches opened, Wb, Q2.29 */
    int32_t off_all_q29;       /* the same with what the tables had taken away from it */
    int32_t off_table_q29;     /* by the tables */
    bool was_off;              /* in the last sample */
    bool vanished;             /* a current ended before the voltage had removed it, last in the period */
    uint32_t vanished_at;
} phase_evidence_phase_t;

typedef struct {
    uint32_t doubted;         /* bit of each phase with a difference that an angle may explain */
    int doubted_side;         /* of the last one */
    uint32_t agreed;          /* bit of each phase that has conducted without a difference since */
    uint32_t doubted_at;      /* period of the first one */
    int32_t doubt_turned_q24; /* rotation since the first one, electrical rev, Q7.24 */
    int32_t quiet_turned_q24; /* since the last one, likewise */
    phase_evidence_phase_t phase[HAL_PHASES_MAX];
} phase_evidence_t;

/* Adds the evidence of a sample. Of a phase that stays off (monitors/degraded.h) only a current in it counts.
 * [background] */
void phase_evidence_step(phase_evidence_t *state, const flux_residual_t *residual, flux_evidence_t *evidence);

/* Forgets differences that have begun. [background] */
void phase_evidence_forget(phase_evidence_t *state);

#endif
