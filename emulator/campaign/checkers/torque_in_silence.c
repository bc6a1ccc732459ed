/* A client that is silent has no torque made for it: from 65 ms after its last request on no larger one than before,
 * after 170 ms none. [SR-04] [SR-05] */
#include "campaign/checkers/checker.h"

#include <math.h>

enum { TORQUE = 4, GROWN = 7 };

#define KNOWN_NS (55 * MS_NS) /* the torque until then is the run's */
#define FRESH_NS (10 * MS_NS)
#define GROWTH_NS (65 * MS_NS)
#define RAMP_NS (170 * MS_NS)
#define RUN_MAX_NS (502 * MS_NS)
#define TORQUE_MAX 0.2 /* of the largest torque: ripple of a current that decays */
#define GROWTH_MAX 1.5
#define LOAD_ANSWERED_NS (200 * MS_NS)

typedef struct {
    double torque_Nm; /* largest until the client had been silent for KNOWN_NS */
} state_t;

/* Tolerance: the speed controller answers a load that has begun shortly before the last request, or since, or that
 * moves, until the ramp of its limit has ended. */
static bool answers_load(const observation_t *seen) {
    bool answers = false;
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = world_begun(seen->world, i, seen->time_ns / 1000);
        if (event == NULL) {
            continue;
        }
        const bool begins = facts_is_load(event) && event->begin_us * 1000 + LOAD_ANSWERED_NS > seen->client.run_ns;
        answers = answers || begins || facts_is_load_sine(event);
    }
    return answers;
}

/* With one quadrant a rotor that is turned backwards generates while it freewheels. */
static bool has_grown(const observation_t *seen, const state_t *state, double torque_Nm) {
    return facts_undisturbed(seen) && !answers_load(seen) &&
           (facts_four_quadrants(seen) || seen->plant->speed_rad_s > 0.0) &&
           torque_Nm > GROWTH_MAX * state->torque_Nm + TORQUE_MAX * seen->world->machine->torque_max_Nm;
}

static void on_look(const observation_t *seen, void *memory, checker_report_t *report) {
    state_t *state = memory;
    const uint64_t now_ns = seen->time_ns, run_ns = seen->client.run_ns;
    const uint64_t age_ns = now_ns > run_ns ? now_ns - run_ns : 0;
    if (!seen->gates || !seen->client.commanded || age_ns > facts_request_max_ns(seen, RUN_MAX_NS)) {
        return; /* the latter is no_command */
    }
    const double torque_Nm = fabs(plant_torque_Nm(seen->plant));
    if (age_ns < KNOWN_NS) {
        state->torque_Nm = fmax(torque_Nm, age_ns < FRESH_NS ? 0.0 : state->torque_Nm);
    } else if (age_ns > facts_request_max_ns(seen, GROWTH_NS) && has_grown(seen, state, torque_Nm)) {
        checker_violated(report, GROWN, plant_torque_Nm(seen->plant));
    } else if (age_ns > facts_request_max_ns(seen, RAMP_NS) && !facts_phases_at_fault(seen, now_ns / 1000) &&
               !facts_disturbed(seen, DISTURBS_ENCODER) &&
               torque_Nm > TORQUE_MAX * seen->world->machine->torque_max_Nm) {
        checker_violated(report, TORQUE, plant_torque_Nm(seen->plant));
    }
}

const checker_t torque_in_silence_checker = {
    .name = "torque_in_silence", .state_size = sizeof(state_t), .on_look = on_look};
