/* Without any fault of the bench, the bus or a client the drive latches none, unless it is true of the plant and not
 * the drive's own work. [SR-30] */
#include "campaign/checkers/checker.h"
#include "campaign/checkers/explanation.h"

static void on_interrupt(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)memory;
    if (seen->drive.state != STATE_FAULT || seen->before == STATE_FAULT) {
        return;
    }
    const explanation_t explanation = explanation_of_fault(seen);
    if (!explanation.any && !explanation.explained) {
        checker_violated(report, seen->drive.fault, seen->drive.checks);
    }
}

const checker_t false_alarm_checker = {.name = "false_alarm", .on_interrupt = on_interrupt};
