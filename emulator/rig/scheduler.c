#include "rig/scheduler.h"

void scheduler_init(scheduler_t *scheduler, uint64_t *clock_ns, const scheduler_handler_t *handlers, void *context) {
    *scheduler = (scheduler_t){.clock_ns = clock_ns, .handlers = handlers, .context = context};
    for (unsigned event = 0; event < EVENT_COUNT; ++event) {
        scheduler->due_ns[event] = SCHEDULER_NEVER;
    }
}

void scheduler_run(scheduler_t *scheduler, uint64_t until_ns) {
    for (;;) {
        unsigned next = 0;
        uint64_t due_ns = scheduler->due_ns[0];
        for (unsigned event = 1; event < EVENT_COUNT; ++event) {
            if (scheduler->due_ns[event] < due_ns) {
                due_ns = scheduler->due_ns[event];
                next = event;
            }
        }
        if (due_ns > until_ns) {
            break;
        }
        *scheduler->clock_ns = due_ns;
        scheduler->handlers[next](scheduler->context, due_ns);
    }
    *scheduler->clock_ns = until_ns;
}
