/* On an undisturbed bus the drive's status comes within 100 ms, bus-off for the second time included. [SR-38] */
#include "campaign/checkers/checker.h"

#define TIME_NS (100 * MS_NS)

typedef struct {
    uint64_t status_ns;
} state_t;

static void on_frame(const observation_t *seen, void *memory, checker_report_t *report, const checker_frame_t *frame) {
    (void)report;
    state_t *state = memory;
    state->status_ns = frame->identifier == DRIVE_STATUS_FRAME_ID ? seen->time_ns : state->status_ns;
}

static void on_millisecond(const observation_t *seen, void *memory, checker_report_t *report) {
    const state_t *state = memory;
    const uint64_t heard_ns = state->status_ns > seen->reset_ns ? state->status_ns : seen->reset_ns;
    if (seen->time_ns > heard_ns + TIME_NS && !facts_variable(seen, VARIABLE_LOSES_STATUS) &&
        !facts_checks_late(seen) && !seen->second_sender && !seen->hostile_sender) {
        checker_violated(report, 0, (double)(seen->time_ns - heard_ns) * 1e-6);
    }
}

const checker_t mute_checker = {
    .name = "mute", .state_size = sizeof(state_t), .on_millisecond = on_millisecond, .on_frame = on_frame};
