/* Residual of the flux linkage: what the voltage has built up in a phase against what the machine's tables have at the
 * measured current and angle.
 *
 *   psi(v)         integral of the voltage since the phase was last without current (applied_flux.h)
 *   psi(f)         the same integral, drawn to psi(i, theta) with a time constant of 10 ms, so that its errors do not
 *                  add up; set to psi(i, theta) after a lost trigger, and to 0 in a phase that is off without current
 *   psi(i, theta)  flux linkage of the tables
 *
 * Everything that judges phases and encoder by flux linkage reads these three of the same sample: the evidence of
 * monitors/flux_evidence.h and the misalignment of flux_angle.h.
 *
 * Tolerance of psi(f): the error of the voltage since the phase was at rest, at most over 10 ms, twice that at small
 * currents; any resistance that a winding may have, of the integral of R i; a quarter of psi that has been removed
 * since; and psi of a period and 20 us at the DC-link voltage, for the delays of sensor and switches. The error of the
 * voltage is 1/64, or the converter's shortest pulse if that is more, or the threshold of the devices. psi is affine in
 * the resistance: what differs at both of its limits, the same way, differs at every resistance. Derived here.
 */
#ifndef CONTROL_FLUX_RESIDUAL_H
#define CONTROL_FLUX_RESIDUAL_H

#include <stdbool.h>
#include <stdint.h>

#include "control/applied_flux.h"
#include "control/machine_tables.h"
#include "hal.h"

/* Time constant with which psi(f) follows the tables, ms. */
#define FLUX_RESIDUAL_FOLLOW_MS 10u

/* Sample of a control period and what acts in it. */
typedef struct {
    bool run;                             /* state RUN */
    uint32_t lost_phases;                 /* bit of each phase that stays off (monitors/degraded.h) */
    uint32_t late_interrupts;             /* since the start: triggers were lost when it changes */
    uint32_t periods;                     /* control periods, modulo 2^32 */
    uint32_t periods_per_ms;              /* from 20 */
    uint32_t encoder_angle;               /* start of the encoder count, 2^-32 rev */
    uint32_t electrical;                  /* angle of phase 0 at the sample, 2^-32 electrical rev */
    int32_t speed_q22;                    /* of the observer, rad/s, Q9.22 */
    int32_t torque_q24;                   /* of the speed law, N m, Q7.24 */
    uint32_t stroke;                      /* 2^32 / phases */
    int32_t period_q40;                   /* Ts, s, Q-9.40 */
    int32_t period_flux_q29;              /* Vdc Ts, Wb, Q2.29 */
    int32_t resistance_period_q40;        /* R Ts, ohm s, Q-9.40 */
    int32_t misalignment[HAL_PHASES_MAX]; /* to subtract from the angle of each phase, 2^-32 electrical rev */
    int32_t current_q9[HAL_PHASES_MAX];   /* at the sample, A, Q7.9 */
    int32_t flux_q29[HAL_PHASES_MAX];     /* psi(f) at the sample, Wb, Q2.29; below 0 counts as 0 */
    int32_t next_q29[HAL_PHASES_MAX];     /* at the next sample, by the duties that act until then, likewise */
    bool off[HAL_PHASES_MAX];             /* both switches, in the period that begins with the sample and the next */
} flux_sample_t;

/* Residual of a phase. */
typedef struct {
    /* At the sample: */
    uint32_t angle;        /* less the misalignment, 2^-32 electrical rev */
    int32_t misalignment;  /* likewise */
    int32_t current_q9;    /* A, Q7.9 */
    int32_t flux_q29;      /* psi(f), Wb, Q2.29, >= 0 */
    int32_t voltage_q29;   /* psi(v), Wb, Q2.29 */
    int32_t table_q29;     /* psi(i, theta), Wb, Q2.29; 0 when off without current */
    int32_t drop_q29;      /* integral of R i since the phase was without current, Wb, Q2.29, >= 0 */
    int32_t step_drop_q29; /* the same since the previous sample */
    bool off;              /* both switches */
    bool none;             /* and no current */
    bool small;            /* the current, up to 4/128 of its range */
    bool at_rest;          /* the opposite voltage has removed all flux linkage, errors of psi(f) included */
    bool known;            /* psi(v): no trigger was lost since the phase was without current */
    /* Over samples: */
    uint32_t zero_at;          /* period in which the phase was last without current, before this sample */
    int32_t peak_q29;          /* largest flux linkage since the phase was at rest, Wb, Q2.29 */
    uint32_t conducting;       /* periods since then, up to the time constant; of a small current twice */
    int32_t followed_q29;      /* sum of the corrections of psi(f) since it was without current, Wb, Q2.29 */
    int32_t followed_drop_q29; /* the integral of R i with the corrections that psi(f) has had, Wb, Q2.29, >= 0 */
    int32_t rest_q29;          /* what the opposite voltage would have removed since psi(f) has been 0, Wb, Q2.29 */
} flux_residual_phase_t;

typedef struct {
    unsigned phases;
    flux_sample_t sample;
    bool lost;         /* triggers were lost since the previous sample: the integrals are wrong */
    uint32_t lost_at;  /* period of the last sample with lost triggers */
    uint32_t elapsed;  /* control periods since the previous sample */
    int32_t step;      /* rotation since then, 2^-32 electrical rev */
    int32_t offset_q9; /* tolerance of a current, 1/128 of its range, A, Q7.9 */
    int32_t delay_q29; /* tolerance of a flux linkage for delays, Wb, Q2.29 */
    /* Errors in a period, Wb, Q2.29: */
    int32_t shortest_q29; /* the converter's shortest pulse */
    int32_t pulse_q29;    /* 1/64 of the voltage, or the shortest pulse if that is more */
    int32_t device_q29;   /* threshold of the devices */
    flux_residual_phase_t phase[HAL_PHASES_MAX];
} flux_residual_t;

/* Least and largest flux linkage of a range of angles and currents, Wb, Q2.29. */
typedef struct {
    int32_t least_q29, most_q29;
} flux_band_t;

/* Takes a sample in. False, and nothing else, when it is the sample of the period before. [background] */
bool flux_residual_step(flux_residual_t *residual, const flux_sample_t *sample);

/* Ends a sample: what psi(f) has to be corrected by, Wb, Q2.29, for each phase. [background] */
void flux_residual_follow(flux_residual_t *residual, int32_t correction_q29[HAL_PHASES_MAX]);

/* Least and largest psi(f) by its tolerance, Wb, Q2.29. */
int32_t flux_residual_least_q29(const flux_residual_t *residual, unsigned index);
int32_t flux_residual_most_q29(const flux_residual_t *residual, unsigned index);

/* Tables' range, up to `width` from a distance from the unaligned position (phase_map.h), 2^-32 electrical rev; with
 * the width HALF_REV at any angle. The least at one current, the largest at another, A, Q7.9. */
flux_band_t flux_residual_band(uint32_t distance, uint32_t width, int32_t least_q9, int32_t most_q9);

#endif
