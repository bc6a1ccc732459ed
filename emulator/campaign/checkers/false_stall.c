/* A drive that nothing disturbs takes no rotor for stalled that it holds at its place, or that it moves against less
 * than half of the torque. */
#include "campaign/checkers/checker.h"

static void on_interrupt(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)memory;
    const bool torque = facts_chooses_mode(seen, MODE_TQ) || facts_chooses_mode(seen, MODE_CST);
    if (seen->drive.state == STATE_FAULT && seen->before != STATE_FAULT && seen->drive.fault == CAUSE(STALL) &&
        facts_untouched(seen) && !torque) {
        checker_violated(report, 0, seen->plant->speed_rad_s);
    }
}

const checker_t false_stall_checker = {.name = "false_stall", .on_interrupt = on_interrupt};
