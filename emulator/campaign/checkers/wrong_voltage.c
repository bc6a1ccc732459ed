/* The measured link voltage is off the true one by no more than 0.8 % of the sensor's full scale. */
#include "campaign/checkers/checker.h"

#include <math.h>

#define ERROR_MAX 0.008

static void on_interrupt(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)memory;
    const double range_V = seen->plant->machine->ranges.dc_link_V, measured = seen->drive.link_voltage;
    const double truth = fmin(fmax(seen->plant->bus_voltage_V / range_V, 0.0), 1.0);
    if (seen->fault_ns != seen->time_ns && /* a fault may have come between the samples and this instant */
        fabs(measured - truth) > ERROR_MAX && !facts_disturbed(seen, DISTURBS_DC_LINK_SENSOR) &&
        !facts_drive_disturbed(seen)) {
        checker_violated(report, 0, measured * range_V);
    }
}

const checker_t wrong_voltage_checker = {.name = "wrong_voltage", .on_interrupt = on_interrupt};
