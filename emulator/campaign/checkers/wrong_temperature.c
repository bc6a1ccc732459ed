/* At the end the hottest winding and the hottest switch are measured within 5 K. [SR-17] */
#include "campaign/checkers/checker.h"

#include <math.h>

enum { WINDING, SWITCH };

#define ERROR_MAX_K 5.0
#define RANGE_C 120.0 /* of every sensor */

static void judge(checker_report_t *report, unsigned number, double measured_C, double true_C) {
    if (true_C < RANGE_C && fabs(measured_C - true_C) > ERROR_MAX_K) {
        checker_violated(report, number, measured_C - true_C);
    }
}

static void at_end(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)memory;
    if (facts_drive_disturbed(seen) || facts_disturbed(seen, DISTURBS_TEMPERATURE_SENSOR)) {
        return;
    }
    judge(report, WINDING, seen->drive.heat.winding_C, seen->true_heat.winding_C);
    judge(report, SWITCH, seen->drive.heat.switch_C, seen->true_heat.switch_C);
}

const checker_t wrong_temperature_checker = {.name = "wrong_temperature", .at_end = at_end};
