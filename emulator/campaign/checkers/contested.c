/* A drive does not run for 150 ms while another client sends commands, or forged ones, or frames that are the drive's.
 * Where the drive may receive no command, or late, or after a bus-off follows none, it has nothing to judge by.
 * [SR-36] [SR-37] */
#include "campaign/checkers/checker.h"

#define TIME_NS (150 * MS_NS)

static bool is_foreign(const world_event_t *event) {
    return event->kind == WORLD_SECOND || (event->kind == WORLD_HOSTILE && (event->what == WORLD_HOSTILE_FORGED ||
                                                                            event->what == WORLD_HOSTILE_IDENTITY));
}

static void on_millisecond(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)memory;
    const uint64_t now_us = seen->time_ns / 1000;
    if (seen->drive.state != STATE_RUN || facts_state_changed(seen) || seen->client.succeeded ||
        facts_variable(seen, VARIABLE_LOSES_COMMANDS) || facts_may_be_unarmed(seen)) {
        return;
    }
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = &seen->world->event[i];
        const uint64_t begin_ns = event->begin_us * 1000;
        const uint64_t since_ns = begin_ns > seen->state_ns ? begin_ns : seen->state_ns;
        if (is_foreign(event) && world_active(seen->world, i, now_us) && seen->time_ns > since_ns + TIME_NS) {
            checker_violated(report, event->what, (double)(seen->time_ns - since_ns) * 1e-6);
        }
    }
}

const checker_t contested_checker = {.name = "contested", .on_millisecond = on_millisecond};
