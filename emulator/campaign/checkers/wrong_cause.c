/* With a fault of the bench, the bus or a client, the drive's first cause is one that this fault may have, or that is
 * true of the plant. [SR-29] [SR-40] */
#include "campaign/checkers/checker.h"
#include "campaign/checkers/explanation.h"

static void on_interrupt(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)memory;
    if (seen->drive.state != STATE_FAULT || seen->before == STATE_FAULT) {
        return;
    }
    const explanation_t explanation = explanation_of_fault(seen);
    if (explanation.any && !explanation.explained) {
        checker_violated(report, seen->drive.fault, seen->drive.checks);
    }
}

const checker_t wrong_cause_checker = {.name = "wrong_cause", .on_interrupt = on_interrupt};
