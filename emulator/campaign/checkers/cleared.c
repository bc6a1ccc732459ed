/* A fault ends, and a start-up passes, only when its cause has gone: not less than 8 ms after the plant's last reason
 * for one, not before both lines of safe torque off that had differed have been off together, nor before a frozen
 * encoder counts; and not by a request to clear that was there before the fault. [SR-41] */
#include "campaign/checkers/checker.h"

enum { CLEARED_BEFORE = 4, CLEARED_UNCOUNTED, CLEARED_LINES }; /* besides STATE_INITIALISE and STATE_FAULT */

#define STO_DIFFERED_US 215000 /* lines of safe torque off: then both have to be off once */
#define EARLIER_NS (5 * MS_NS) /* for certain before the fault */
#define GONE_NS (8 * MS_NS)
#define GONE_AT_START_NS (MS_NS / 2)
#define UNSEEN_PERIODS 3 /* from a cause to the state that follows the sample which shows it */

/* Lines of safe torque off that have differed for long, and have not been off together since. */
static bool lines_differed(const observation_t *seen) {
    const uint64_t now_us = seen->time_ns / 1000;
    uint64_t begin_us = 0, end_us = 0;
    unsigned changes = 0;
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = world_begun(seen->world, i, now_us);
        if (event != NULL && event->kind == WORLD_SET && (variable_effect(event->what).disturbs & VARIABLE_STO) != 0) {
            begin_us = event->begin_us;
            end_us = event->end_us != 0 && event->end_us < now_us ? event->end_us : now_us;
            changes++;
        }
    }
    return changes == 1 && end_us > begin_us + STO_DIFFERED_US && seen->reset_ns < begin_us * 1000;
}

static void judge_fault(const observation_t *seen, checker_report_t *report) {
    const uint64_t clear_ns = seen->client.clear_ns;
    const bool reset_since = seen->reset_ns >= seen->latched_ns;
    if (lines_differed(seen)) {
        checker_violated(report, CLEARED_LINES, 0.0);
    }
    const bool known = seen->causes > 0 && seen->causes < OBSERVATION_CAUSES_MAX;
    if (known && seen->cause[seen->causes - 1] == CAUSE(ENCODER) && !seen->counted && !reset_since) {
        checker_violated(report, CLEARED_UNCOUNTED, 0.0);
    }
    if (clear_ns != 0 && clear_ns + EARLIER_NS < seen->latched_ns && !reset_since && !facts_may_be_deaf(seen) &&
        !facts_impersonated(seen)) {
        checker_violated(report, CLEARED_BEFORE, (double)(seen->latched_ns - clear_ns) * 1e-6);
    }
}

static void on_interrupt(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)memory;
    if (seen->drive.state != STATE_READY || seen->before == STATE_READY || seen->before == STATE_RUN ||
        facts_state_changed(seen)) {
        return;
    }
    if (seen->before == STATE_FAULT) {
        judge_fault(seen, report);
    }
    const uint64_t gone_ns = seen->before == STATE_FAULT ? GONE_NS : GONE_AT_START_NS;
    const bool begins = seen->time_ns < seen->reason_begin_ns + UNSEEN_PERIODS * seen->period_ns;
    if (seen->reason_ns && seen->time_ns < seen->reason_ns + gone_ns && !begins &&
        !facts_disturbed(seen, DISTURBS_MEMORY | DISTURBS_CLOCK)) {
        checker_violated(report, seen->before, (double)(seen->time_ns - seen->reason_ns) * 1e-6);
    }
}

const checker_t cleared_checker = {.name = "cleared", .on_interrupt = on_interrupt};
