#include "rig/scheduler.h"

void scheduler_init(scheduler_t *scheduler, uint64_t *clock_ns, const scheduler_handler_t *handlers, void *context) {
    *scheduler = (scheduler_t){.clock_ns = clock_ns, .handlers = handlers, .context = context};
    for (unsigned event = 0; event < EVENT_COUNT; ++event) {
        scheduler->due_ns[event] = SCHEDULER_NEVER;
    }
}

static unsigned earliest(const scheduler_t *scheduler) {
    unsigned next = 0;
    for (unsigned event = 1; event < EVENT_COUNT; ++event) {
        if (scheduler->due_ns[event] < scheduler->due_ns[next]) {
            next = event;
        }
    }
    return next;
}

static void set_clocks(scheduler_t *first, uint64_t time_ns) {
    for (scheduler_t *scheduler = first; scheduler; scheduler = scheduler->next) {
        *scheduler->clock_ns = time_ns;
    }
}

void scheduler_run(scheduler_t *first, uint64_t until_ns) {
    for (;;) {
        scheduler_t *scheduler = first;
        unsigned next = earliest(first);
        uint64_t due_ns = first->due_ns[next];
        for (scheduler_t *other = first->next; other; other = other->next) {
            const unsigned event = earliest(other);
            if (other->due_ns[event] < due_ns || (other->due_ns[event] == due_ns && event < next)) {
                scheduler = other;
                next = event;
                due_ns = other->due_ns[event];
            }
        }
        if (due_ns > until_ns) {
            break;
        }
        set_clocks(first, due_ns);
        scheduler->handlers[next](scheduler->context, due_ns);
    }
    set_clocks(first, until_ns);
}
