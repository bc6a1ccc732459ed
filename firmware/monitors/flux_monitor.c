#include "monitors/flux_monitor.h"

#include "fixed/compiler.h"

static uint32_t open_phases(const flux_evidence_t *evidence) {
    return evidence->too_little | evidence->too_little_at_angle;
}

static uint32_t shorted_phases(const flux_evidence_t *evidence) {
    return evidence->excess_moves | evidence->too_much_at_angle;
}

/* [SR-29] */
fault_t flux_monitor_verdict(const flux_evidence_t *e, uint32_t phases) {
    const uint32_t open = open_phases(e), shorted = shorted_phases(e);
    const uint32_t phase = open | shorted | e->excess_still | e->unbalanced;
    const uint32_t others = e->contradicts & ~phases;
#define FLUX_VERDICT(fault, condition, text)                                                                           \
    if (condition) {                                                                                                   \
        return FAULT_##fault;                                                                                          \
    }
#include "monitors/flux_verdict.def"
#undef FLUX_VERDICT
    return FAULT_NONE;
}

/* Phases with evidence of a fault. Of currents that are read in another phase both are; which one lacks it shows when
 * only one does. */
static uint32_t failed_phases(const flux_evidence_t *evidence) {
    const uint32_t open = open_phases(evidence), shorted = shorted_phases(evidence), missing = evidence->missing;
    uint32_t failed = open | shorted | evidence->excess_still | evidence->excess_by_tables | evidence->unbalanced;
    if ((open != 0 && evidence->excess != 0) || (shorted != 0 && (missing & ~evidence->excess) != 0)) {
        failed |= evidence->excess | ((missing & (missing - 1u)) == 0 ? missing : 0);
    }
    return failed;
}

/* [SR-29] [SR-31] */
void flux_monitor_forget(flux_monitor_t *monitor) {
    monitor->failed = 0;
    monitor->balance = (phase_balance_t){0};
    phase_evidence_forget(&monitor->phases_by_current);
}

/* [SR-29] */
COLD uint32_t flux_monitor_step(const flux_monitor_parameters_t *parameters, flux_monitor_t *monitor,
                                const flux_sample_t *sample) {
    flux_residual_t *residual = &monitor->residual;
    const bool begins = sample->run && !residual->sample.run;
    if (!flux_residual_step(residual, sample)) {
        return monitor->failed;
    }
    encoder_monitor_step(&parameters->encoder, &monitor->encoder, residual);
    flux_evidence_t evidence = {.turned_round = monitor->encoder.turned_round};
    angle_evidence_step(&parameters->angle, &monitor->angle, residual, &evidence);
    phase_evidence_step(&monitor->phases_by_current, residual, &evidence);
    phase_balance_step(&monitor->balance, residual, parameters->least_q8, &evidence);
    monitor->suspicious = evidence.suspicious;
    monitor->phases = (begins ? 0 : monitor->phases) | failed_phases(&evidence);
    const uint32_t failed = (uint32_t)FAULT_BIT(flux_monitor_verdict(&evidence, monitor->phases)) & ~1u;
    monitor->failed = sample->run ? monitor->failed | failed : failed;
    return monitor->failed;
}
