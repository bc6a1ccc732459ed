/* After bus-off a request to run has to be withdrawn before it starts the drive again. [SR-38] */
#include "campaign/checkers/checker.h"

#include "bench_variables.h"

#define BUS_OFF_NS MS_NS /* until the drive knows it */

static void on_interrupt(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)memory;
    const uint64_t now_ns = seen->time_ns;
    if (seen->drive.state != STATE_RUN || seen->before == STATE_RUN) {
        return;
    }
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = world_begun(seen->world, i, now_ns / 1000);
        if (event == NULL || event->kind != WORLD_SET || event->what != BENCH_VARIABLE_TRANSMIT_ERROR_COUNTER) {
            continue;
        }
        const uint64_t off_ns = event->begin_us * 1000, begin_ns = off_ns + BUS_OFF_NS;
        /* A reset ends bus-off, and the arming with it. */
        if (seen->client.withdrawn_ns < begin_ns && seen->reset_ns < off_ns && now_ns > begin_ns + BUS_OFF_NS) {
            checker_violated(report, 0, (double)(now_ns - begin_ns) * 1e-6);
        }
    }
}

const checker_t resumed_checker = {.name = "resumed", .on_interrupt = on_interrupt};
