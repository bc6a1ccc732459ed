/* No gate is on for 2 ms at a speed above the limit by 2 %. [SR-07] */
#include "campaign/checkers/checker.h"

#include <math.h>

#include "fault_kinds.h"

#define MARGIN 1.02
#define TIME_NS (2 * MS_NS)

typedef struct {
    uint64_t since_ns;
} state_t;

/* Fraction of the speed that an encoder shows which loses counts in each revolution, at least. */
static double shown_speed(const world_t *world) {
    double shown = 1.0;
    for (unsigned i = 0; i < world->events; i++) {
        const world_event_t *event = world_begun(world, i, UINT64_MAX);
        if (event != NULL && event->kind == WORLD_FAULT && event->what == FAULT_ENCODER_LOST_COUNTS) {
            shown = fmin(shown, 1.0 - ldexp(event->value, -(int)world->encoder_bits));
        }
    }
    return shown;
}

/* Tolerance: an encoder that is frozen, or does not answer from a start on, shows nothing while the load turns a rotor
 * without current. No drive has another sign of it. */
static bool turns_unseen(const observation_t *seen) {
    return (seen->present[FAULT_ENCODER_STUCK] || seen->injected[FAULT_ENCODER_NO_ANSWER]) &&
           facts_overhauled(seen, seen->plant->speed_rad_s);
}

static void on_look(const observation_t *seen, void *memory, checker_report_t *report) {
    state_t *state = memory;
    const double speed_rpm = facts_speed_rpm(seen), limit_rpm = MARGIN * seen->world->machine->over_speed_rpm;
    const bool above =
        seen->gates && speed_rpm > limit_rpm && speed_rpm * shown_speed(seen->world) > limit_rpm && !turns_unseen(seen);
    observation_since(&state->since_ns, above, seen->time_ns);
    if (state->since_ns && seen->time_ns > state->since_ns + TIME_NS) {
        checker_violated(report, 0, speed_rpm / seen->world->machine->over_speed_rpm);
    }
}

const checker_t over_speed_checker = {.name = "over_speed", .state_size = sizeof(state_t), .on_look = on_look};
