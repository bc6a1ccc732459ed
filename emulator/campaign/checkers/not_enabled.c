/* With CANopen a gate is on only after shutdown and, by a later frame, enable operation, in state operational of the
 * NMT, and not after they have been withdrawn. */
#include "campaign/checkers/checker.h"

#define WITHDRAWN_NS                                                                                                   \
    (6 * MS_NS)              /* until a frame has opened the gates: a cycle of the telemetry, and of the interrupts */
#define SYNC_NS (11 * MS_NS) /* a frame that waits for the next SYNC */

static void on_look(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)memory;
    const master_wish_t *wish = &seen->master->wish;
    const uint64_t delay_ns = WITHDRAWN_NS + (seen->world->master.synchronous ? SYNC_NS : 0);
    if (!seen->gates || wish->enabled || wish->unsure || facts_may_be_deaf(seen) || facts_drive_disturbed(seen)) {
        return;
    }
    if (wish->withdrawn_ns == 0 || seen->time_ns > wish->withdrawn_ns + facts_request_max_ns(seen, delay_ns)) {
        checker_violated(report, 0, (double)(seen->time_ns - wish->withdrawn_ns) * 1e-6);
    }
}

const checker_t not_enabled_checker = {.name = "not_enabled", .on_look = on_look};
