/* The first cause is the first one, by its number, of the checks that failed in its tick. [SR-40] */
#include "campaign/checkers/checker.h"

static void on_interrupt(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)memory;
    const uint32_t cause = seen->drive.fault < 32 ? UINT32_C(1) << seen->drive.fault : 0, up_to = (cause << 1) - 1;
    if (seen->drive.state == STATE_FAULT && seen->before != STATE_FAULT && seen->drive.checks != 0 &&
        (seen->drive.checks & up_to) != cause && !facts_state_changed(seen)) {
        checker_violated(report, seen->drive.fault, seen->drive.checks);
    }
}

const checker_t not_first_checker = {.name = "not_first", .on_interrupt = on_interrupt};
