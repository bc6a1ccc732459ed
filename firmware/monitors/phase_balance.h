/* Balance of the phases: the flux linkage that the voltage alone has built up over the tables' at the measured
 * current and angle (control/flux_residual.h), as the mean of each phase while it conducts in eight electrical
 * revolutions.
 *
 * What the machine, the DC link and all sensors have in common changes this ratio in all phases alike. So the ratio of
 * one phase to the others' shows an error of its current sensor which is within the tolerances of a single
 * sample (monitors/phase_evidence.h), and a ratio that is small in all of them an encoder that is ahead of the rotor:
 * drops of the devices and a warm winding make it larger only, and what a cold one makes it smaller is added. Where
 * drift may be most of the integral the ratio shows nothing: such samples do not count.
 *
 *   unbalanced  the ratio of a phase is more than 4/3 of all others', or less than 3/4
 *   all_small   the ratio of every phase is below a limit, twice in succession
 *
 * Revolutions that last longer than 100 ms do not count, nor those in which a phase has hardly conducted, unless it is
 * lost: then the others are judged without it. Of two that are left either may be the wrong one, and what they have
 * besides is the angle only. Derived here.
 */
#ifndef MONITORS_PHASE_BALANCE_H
#define MONITORS_PHASE_BALANCE_H

#include <stdbool.h>
#include <stdint.h>

#include "control/flux_residual.h"
#include "hal.h"
#include "monitors/flux_evidence.h"

/* Smallest common ratio, Q8: by the tolerances of currents, flux linkage and resistance together it is 0.87, and 2
 * degrees of angle take an eighth of it. With learned misalignment, of which 4 degrees take a quarter. */
#define PHASE_BALANCE_LEAST_Q8 194
#define PHASE_BALANCE_LEAST_LEARNED_Q8 166

typedef struct {
    uint64_t flux_sum_q21, cold_sum_q21, table_sum_q21; /* over the periods of a window, Wb, Q21 */
    uint32_t conducting;                                /* these periods */
} phase_balance_phase_t;

typedef struct {
    uint64_t turned;        /* in the window, 2^-32 electrical rev */
    uint32_t periods;       /* of the window */
    uint32_t small_windows; /* in succession in which all ratios are small */
    uint32_t unbalanced;    /* bit of each phase whose ratio has differed in this run */
    bool all_small;         /* in this run */
    phase_balance_phase_t phase[HAL_PHASES_MAX];
} phase_balance_t;

/* Adds the evidence of a sample. least_q8: limit of the common ratio. [background] */
void phase_balance_step(phase_balance_t *balance, const flux_residual_t *residual, uint32_t least_q8,
                        flux_evidence_t *evidence);

#endif
