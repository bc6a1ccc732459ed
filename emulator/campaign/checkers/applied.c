/* A set of parameters with a wrong check is not applied. [SR-56] */
#include "campaign/checkers/checker.h"

static void on_frame(const observation_t *seen, void *memory, checker_report_t *report, const checker_frame_t *frame) {
    (void)memory;
    /* The response for the limit, which comes first, is right. */
    const bool of_limit = seen->limit.limited != NULL && seen->limit.applied == 1;
    if (frame->identifier != DRIVE_PARAMETER_RESPONSE_FRAME_ID || seen->limit.applied_ns != seen->time_ns || of_limit) {
        return;
    }
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = world_begun(seen->world, i, UINT64_MAX);
        if (event != NULL && event->kind == WORLD_DEGRADED && event->what == WORLD_DEGRADED_WRONG_CHECK) {
            checker_violated(report, 0, 0.0);
        }
    }
}

const checker_t applied_checker = {.name = "applied", .on_frame = on_frame};
