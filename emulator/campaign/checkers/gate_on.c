/* A gate is on in state run only, with both lines of safe torque off energised, and while control interrupts come.
 * [SR-01] [SR-39] [SR-45] */
#include "campaign/checkers/checker.h"

#include "fault_kinds.h"

enum { OUTSIDE_OF_RUN = 1, WITHOUT_STO_LINES, WITHOUT_INTERRUPT };

#define SILENT_PERIODS 2.5   /* without an interrupt: one that is late by a period, and its last pattern */
#define LONGER_PERIODS_MAX 4 /* by a changed register of the period */

static void on_interrupt(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)memory;
    const plant_t *plant = seen->plant;
    unsigned gates = 0;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        const half_bridge_pattern_t *pattern = &plant->pattern[phase];
        gates |= plant->switches[phase];
        for (unsigned edge = plant->edge_next[phase]; edge < pattern->count; edge++) {
            gates |= pattern->switches[edge];
        }
    }
    if (gates && seen->drive.state != STATE_RUN) {
        checker_violated(report, OUTSIDE_OF_RUN, seen->drive.state);
    }
}

static void on_look(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)memory;
    if (!seen->gates) {
        return;
    }
    if (facts_sto_demanded(seen, (seen->time_ns - 1) / 1000)) { /* a change of this instant comes after the look */
        checker_violated(report, WITHOUT_STO_LINES, 0.0);
    }
    const uint64_t longer = seen->injected[FAULT_PERIOD_REGISTER_FLIPPED] ? LONGER_PERIODS_MAX : 1;
    if (seen->time_ns > seen->interrupt_ns + (uint64_t)(SILENT_PERIODS * (double)(longer * seen->period_ns))) {
        checker_violated(report, WITHOUT_INTERRUPT, (double)(seen->time_ns - seen->interrupt_ns) * 1e-3);
    }
}

const checker_t gate_on_checker = {.name = "gate_on", .on_interrupt = on_interrupt, .on_look = on_look};
