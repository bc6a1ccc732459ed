/* State and first cause on the bus are the drive's, which has had its state for 30 ms. */
#include "campaign/checkers/checker.h"

#define AGE_MAX_NS (30 * MS_NS)

static void on_frame(const observation_t *seen, void *memory, checker_report_t *report, const checker_frame_t *frame) {
    (void)memory;
    if (frame->identifier != DRIVE_STATUS_FRAME_ID) {
        return;
    }
    struct drive_status_t status;
    drive_status_unpack(&status, frame->data, 8);
    const bool differs = status.state != seen->drive.state || status.fault != seen->drive.fault;
    if (differs && seen->time_ns > seen->state_ns + AGE_MAX_NS && !facts_state_changed(seen) &&
        !facts_bus_disturbed(seen)) {
        checker_violated(report, status.state, status.fault);
    }
}

const checker_t wrong_status_checker = {.name = "wrong_status", .on_frame = on_frame};
