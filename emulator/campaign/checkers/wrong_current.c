/* A measured phase current is off the true one by no more than 0.8 % of the sensor's full scale, sixteen times the
 * largest noise. */
#include "campaign/checkers/checker.h"

#include <math.h>

#define ERROR_MAX 0.008

static void on_interrupt(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)memory;
    const double range_A = seen->plant->machine->ranges.current_A;
    if (seen->fault_ns == seen->time_ns || /* a fault may have come between the samples and this instant */
        facts_disturbed(seen, DISTURBS_CURRENT_SHOWN) || facts_drive_disturbed(seen)) {
        return;
    }
    for (unsigned phase = 0; phase < seen->plant->machine->phases; phase++) {
        const double measured = seen->drive.current[phase];
        const double truth = fmin(fmax(plant_current_A(seen->plant, phase) / range_A, 0.0), 1.0);
        if (fabs(measured - truth) > ERROR_MAX) {
            checker_violated(report, phase, measured * range_A);
        }
    }
}

const checker_t wrong_current_checker = {.name = "wrong_current", .on_interrupt = on_interrupt};
