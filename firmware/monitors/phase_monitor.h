/* Plausibility of the phase currents: the flux linkage psi that the applied voltage has built up in a phase
 * (control/applied_flux.h) against that of the machine's tables at the measured current and angle.
 *
 *   phase_open      less current than the voltage must have caused: psi above the tables' at 1.1 i + offset
 *   phase_shorted   more current than the voltage can have caused, and it moves: psi below the tables' at
 *                   (i - offset) / 1.1, or a current in a phase which the voltage has left without flux linkage
 *   current_sensor  such a current that does not move, offset included; or one that is read in another phase than in
 *                   the one that lacks it
 *   encoder_angle   a current that is only too large because the tables, at a wrong angle, have emptied the integral
 *
 * Tolerances: current 10 % and 1/128 of its range, flux linkage 15 %, angle 10 degrees electrical; any resistance that
 * a winding may have, of the integral of R i (control/applied_flux.h); voltage 1/64, or the thresholds of the devices
 * or the converter's shortest pulse if that is more, since the phase was at rest, at most over 10 ms, twice that at
 * small currents; a quarter of psi that has been removed since; and psi of a period and 20 us at the DC-link voltage,
 * for the delays of sensor and switches. psi is affine in the resistance: what differs at both of its limits, the same
 * way, differs at every resistance. At a current of up to 4/128 of its range, a small one, phase_open counts only what
 * more than this tolerance of voltage and resistance has built up since the current was larger.
 *
 * A current also is one that should not be when both switches are open and the voltage has removed a quarter of psi of
 * which the tables saw less than a quarter disappear: freewheeling by a shorted switch.
 *
 * An error of the angle explains any psi between those of the unaligned and of the aligned position. Beyond these a
 * difference is phase_open in its second sample, or an excess of current. Between them it counts once the rotor has
 * turned by 1/32 electrical revolution, by its encoder, and is a fault when it comes again, unless a second phase has
 * one within an electrical revolution and 20 ms: then it is the encoder's, or what all sensors have in common.
 *
 * What a phase without current cannot tell apart: an open winding, an open switch, the gate supply, a dead sensor. What
 * shows nothing at all: a negative offset in a phase that stands without current, because the converter reads 0; an
 * error within the tolerances; a fault of a phase without voltage.
 *
 * The integral follows the tables with a time constant of 10 ms, is set to them after a lost trigger, and to 0 in a
 * phase that is off and reads no current.
 */
#ifndef MONITORS_PHASE_MONITOR_H
#define MONITORS_PHASE_MONITOR_H

#include <stdbool.h>
#include <stdint.h>

#include "control/applied_flux.h"
#include "control/machine_tables.h"
#include "hal.h"

typedef struct {
    bool run;                             /* state RUN */
    uint32_t late_interrupts;             /* since the start: triggers were lost when it changes */
    uint32_t periods;                     /* control periods, modulo 2^32 */
    uint32_t periods_per_ms;              /* from 20 */
    uint32_t electrical;                  /* angle of phase 0 at the sample, 2^-32 electrical rev */
    uint32_t stroke;                      /* 2^32 / phases */
    int32_t period_q40;                   /* Ts, s, Q-9.40 */
    int32_t period_flux_q29;              /* Vdc Ts, Wb, Q2.29 */
    int32_t resistance_period_q40;        /* R Ts, ohm s, Q-9.40 */
    int32_t misalignment[HAL_PHASES_MAX]; /* to subtract from the angle of each phase, 2^-32 electrical rev */
    int32_t current_q9[HAL_PHASES_MAX];   /* at the sample, A, Q7.9 */
    int32_t flux_q29[HAL_PHASES_MAX];     /* by the applied voltage, at the sample, Wb, Q2.29 */
    int32_t next_q29[HAL_PHASES_MAX];     /* at the next sample, by the duties that act until then */
    bool off[HAL_PHASES_MAX];             /* both switches, in the period that begins with the sample and the next */
} phase_monitor_input_t;

typedef struct {
    int32_t peak_q29;          /* largest flux linkage since the phase was at rest, Wb, Q2.29 */
    int32_t rest_q29;          /* what the opposite voltage would have removed since it has been 0, Wb, Q2.29 */
    int32_t base_q29;          /* flux linkage when the current was last seen, or less, Wb, Q2.29 */
    uint32_t conducting;       /* periods since the phase was at rest, up to the time constant of the integral */
    uint32_t excess_periods;   /* with a current that should not be */
    int32_t least_q9, most_q9; /* its range, A, Q7.9 */
    int32_t turned;            /* rotation since a difference at the measured angle began, 2^-32 electrical rev */
    int8_t side;               /* of that difference: 1 less current than by the voltage, -1 more, 0 none */
    uint8_t open_samples;      /* in succession with less current than at any angle */
    uint32_t zero_at;          /* period in which the phase was last without current */
    int32_t followed_q29;      /* sum of the corrections since, Wb, Q2.29 */
    int32_t drop_q29;          /* integral of R i since the phase was without current, Wb, Q2.29, >= 0 */
    int32_t followed_drop_q29; /* the same with the corrections that the flux linkage has had, likewise */
    int32_t table_q29;         /* flux linkage by the tables at the last input, Wb, Q2.29; 0 without current */
    int32_t off_flux_q29;      /* flux linkage by the voltage when the switches opened, Wb, Q2.29 */
    int32_t off_all_q29;       /* the same with what the tables had taken away from it */
    int32_t off_table_q29;     /* by the tables */
    bool was_off;              /* in the last input */
    bool vanished;             /* a current ended before the voltage had removed it, last in the period */
    uint32_t vanished_at;
} phase_monitor_phase_t;

typedef struct {
    bool suspicious; /* a phase differs, or nearly, or has a current that should not be: samples without delay decide */
    bool run;        /* in the last input; so are the next three */
    uint32_t late_interrupts;
    uint32_t periods;
    uint32_t electrical;
    uint32_t lost_at;         /* period of the last input with lost triggers */
    uint32_t failed;          /* FAULT_BITs, of a run until its end */
    uint32_t phases;          /* bit of each phase of which a check has failed since the last run began */
    uint32_t doubted;         /* bit of each phase with a difference that an angle may explain */
    int doubted_side;         /* of the last one */
    uint32_t agreed;          /* bit of each phase that has conducted without a difference since */
    uint32_t nearly;          /* of each phase that was beyond half of the tolerances since */
    uint32_t doubted_at;      /* period of the first one */
    int32_t doubt_turned_q24; /* rotation since the first one, electrical rev, Q7.24 */
    int32_t quiet_turned_q24; /* since the last one, likewise */
    uint32_t lost;            /* bit of each phase that stays off, phase_monitor_lose() */
    phase_monitor_phase_t phase[HAL_PHASES_MAX];
} phase_monitor_t;

/* Failed checks, FAULT_BITs. An input with the period of the previous one changes nothing. correction_q29: to add to
 * each phase's integral. [background] */
uint32_t phase_monitor_step(phase_monitor_t *monitor, const machine_tables_t *tables,
                            const phase_monitor_input_t *input, int32_t correction_q29[HAL_PHASES_MAX]);

/* Integral of R i since a phase was without current, at the sample of an input that has not been checked yet, Wb,
 * Q2.29. [background] */
int32_t phase_monitor_drop_q29(const phase_monitor_t *monitor, const phase_monitor_input_t *input, unsigned phase);

/* Forgets the failed checks of a run that goes on without these phases, a bit each: their switches stay open, and from
 * now on only a current in them fails, once the voltage has removed their flux linkage. 0: none are lost.
 * [background] */
void phase_monitor_lose(phase_monitor_t *monitor, uint32_t phases);

#endif
