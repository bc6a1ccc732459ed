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
        for (unsigned event = 1; event < EVENT_COUNT; ++event) {
            if (scheduler->due_ns[event] < scheduler->due_ns[next]) {
                next = event;
            }
        }
        if (scheduler->due_ns[next] > until_ns) {
            break;
        }
        const uint64_t now_ns = *scheduler->clock_ns = scheduler->due_ns[next];
        scheduler->handlers[next](scheduler->context, now_ns);
    }
    *scheduler->clock_ns = until_ns;
}
