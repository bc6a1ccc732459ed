/* A drive in a run notices within its time what it can see at any time: changed memory, sensors at a rail, a wrong
 * clock, a background that hangs (fault_effects.c). [SR-18] [SR-26] [SR-47] [SR-49] [SR-50] [SR-55] */
#include "campaign/checkers/checker.h"

#include <math.h>

#include "fault_kinds.h"

#define CLOCK_DRIFT_PERCENT 8.0 /* the drive allows less for certain */

static bool shows(const observation_t *seen, const world_event_t *event) {
    switch (event->what) {
    case FAULT_LIMIT_FLIPPED:
        return event->raw < (int32_t)seen->limit_bits;
    case FAULT_CONSTANT_FLIPPED:
        return event->raw < (int32_t)seen->constant_bits;
    case FAULT_CLOCK_DRIFT:
        return fabs(event->value) > CLOCK_DRIFT_PERCENT;
    default:
        return true;
    }
}

/* A reset writes what has changed in memory and registers, and a set of parameters the limits and constants. */
static bool written_since(const observation_t *seen, const world_event_t *event) {
    const uint64_t begin_ns = event->begin_us * 1000;
    const bool of_set = event->what == FAULT_LIMIT_FLIPPED || event->what == FAULT_CONSTANT_FLIPPED;
    return (fault_effect(event->what).disturbs & DISTURBS_MEMORY) != 0 &&
           (seen->reset_ns >= begin_ns || (of_set && seen->limit.applied_ns >= begin_ns));
}

static void on_millisecond(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)memory;
    const uint64_t now_us = seen->time_ns / 1000;
    if (seen->drive.state != STATE_RUN || facts_state_changed(seen)) {
        return;
    }
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = &seen->world->event[i];
        if (event->kind != WORLD_FAULT || !world_active(seen->world, i, now_us) || written_since(seen, event)) {
            continue;
        }
        const fault_effect_t effect = fault_effect(event->what);
        const uint64_t within_ns = shows(seen, event) ? effect.noticed_within_ms * MS_NS : 0;
        const uint64_t begin_ns = event->begin_us * 1000;
        const uint64_t since_ns = begin_ns > seen->state_ns ? begin_ns : seen->state_ns;
        const bool of_processor = (effect.disturbs & DISTURBS_PROCESSOR) != 0;
        if (within_ns && seen->time_ns > since_ns + within_ns && (of_processor || !facts_checks_late(seen))) {
            checker_violated(report, event->what, event->value);
        }
    }
}

const checker_t undetected_checker = {.name = "undetected", .on_millisecond = on_millisecond};
