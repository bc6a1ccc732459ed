/* Phases and encoder by their flux linkage: one residual (control/flux_residual.h), the evidence of each sample
 * (flux_evidence.h), and one table of verdicts (flux_verdict.def). */
#ifndef MONITORS_FLUX_MONITOR_H
#define MONITORS_FLUX_MONITOR_H

#include <stdbool.h>
#include <stdint.h>

#include "control/flux_residual.h"
#include "monitors/angle_evidence.h"
#include "monitors/encoder_monitor.h"
#include "monitors/flux_evidence.h"
#include "monitors/phase_balance.h"
#include "monitors/phase_evidence.h"
#include "storage/fault.h"

typedef struct {
    angle_evidence_parameters_t angle;
    encoder_monitor_parameters_t encoder;
    uint32_t least_q8; /* of phase_balance_step() */
} flux_monitor_parameters_t;

typedef struct {
    flux_residual_t residual;
    phase_evidence_t phases_by_current;
    angle_evidence_t angle;
    phase_balance_t balance;
    encoder_monitor_t encoder;
    bool suspicious; /* a condition begins or nearly holds in the last sample: samples without delay decide */
    uint32_t failed; /* FAULT_BITs of the verdicts, of a run until its end */
    uint32_t phases; /* bit of each phase with evidence of a fault since the last run began */
} flux_monitor_t;

/* The fault that the evidence shows, FAULT_NONE without one. phases: bit of each phase with evidence of a fault in this
 * run. */
fault_t flux_monitor_verdict(const flux_evidence_t *evidence, uint32_t phases);

/* Checks a sample: failed checks, FAULT_BITs. A sample of the period of the previous one changes nothing. The residual
 * then is of this sample, and flux_residual_follow() ends it. [background] */
uint32_t flux_monitor_step(const flux_monitor_parameters_t *parameters, flux_monitor_t *monitor,
                           const flux_sample_t *sample);

/* Forgets failed checks and what has begun, when a phase is lost or given back (monitors/degraded.h). [background] */
void flux_monitor_forget(flux_monitor_t *monitor);

#endif
