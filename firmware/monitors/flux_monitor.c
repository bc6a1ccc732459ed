#include "monitors/flux_monitor.h"

#include "fixed/compiler.h"

static uint32_t open_phases(const flux_evidence_t *evidence) {
    return evidence->too_little | evidence->too_little_at_angle;
}

static uint32_t shorted_phases(const flux_evidence_t *evidence) {
    return evidence->excess_moves | evidence->too_much_at_angle;
}

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

void flux_monitor_lose(flux_monitor_t *monitor, uint32_t phases) {
    monitor->lost = phases;
    monitor->failed = 0;
    monitor->balance = (phase_balance_t){0};
    phase_evidence_forget(&monitor->phases_by_current);
}

COLD uint32_t flux_monitor_step(const flux_monitor_parameters_t *parameters, flux_monitor_t *monitor,
                                const flux_sample_t *sample, const flux_monitor_motion_t *motion) {
    flux_residual_t *residual = &monitor->residual;
    flux_evidence_t *evidence = &monitor->evidence;
    const bool was_run = residual->run;
    if (!flux_residual_step(residual, sample)) {
        return monitor->failed;
    }
    const encoder_monitor_input_t counts = {
        .period = residual->periods,
        .lost = residual->lost,
        .encoder_angle = motion->encoder_angle,
        .speed_q22 = motion->speed_q22,
    };
    const angle_evidence_input_t angle = {
        .encoder_angle = motion->encoder_angle,
        .torque_q24 = motion->torque_q24,
        .lost_phases = monitor->lost,
    };
    *evidence = (flux_evidence_t){0};
    encoder_monitor_step(&parameters->encoder, &monitor->encoder, &counts);
    evidence->turned_round = monitor->encoder.turned_round;
    angle_evidence_step(&parameters->angle, &monitor->angle, residual, &angle, evidence);
    phase_evidence_step(&monitor->phases_by_current, residual, monitor->lost, evidence);
    phase_balance_step(&monitor->balance, residual, parameters->least_q8, monitor->lost, evidence);
    if (residual->run && !was_run) {
        monitor->phases = 0;
    }
    monitor->phases |= failed_phases(evidence);
    const uint32_t failed = (uint32_t)FAULT_BIT(flux_monitor_verdict(evidence, monitor->phases)) & ~1u;
    monitor->failed = residual->run ? monitor->failed | failed : failed;
    return monitor->failed;
}
