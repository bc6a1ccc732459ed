/* 60 ms after the last control interrupt the watchdog has reset the drive. [SR-47] */
#include "campaign/checkers/checker.h"

#define TIME_NS (60 * MS_NS)

static void on_millisecond(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)memory;
    const uint64_t alive_ns = seen->interrupt_ns > seen->reset_ns ? seen->interrupt_ns : seen->reset_ns;
    if (seen->time_ns > alive_ns + TIME_NS) {
        checker_violated(report, 0, (double)(seen->time_ns - alive_ns) * 1e-6);
    }
}

const checker_t not_reset_checker = {.name = "not_reset", .on_millisecond = on_millisecond};
