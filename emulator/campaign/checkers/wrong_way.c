/* A drive of one quadrant does not drive forwards because a speed backwards is commanded. */
#include "campaign/checkers/checker.h"

#define SPEED 0.05 /* of the base speed */
#define TORQUE 0.1 /* of the rated one */
#define TIME_NS (50 * MS_NS)
#define SETTLED_NS (50 * MS_NS) /* after another command */

typedef struct {
    uint64_t since_ns;
} state_t;

static void on_interrupt(const observation_t *seen, void *memory, checker_report_t *report) {
    state_t *state = memory;
    const sender_meaning_t *meant = &seen->client.meant;
    const bool forwards = seen->plant->speed_rad_s * RPM_PER_RAD_S > SPEED * seen->world->machine->speed_base_rpm &&
                          plant_torque_Nm(seen->plant) > TORQUE * seen->world->machine->torque_rated_Nm;
    const bool backwards = seen->drive.state == STATE_RUN && meant->request == SENDER_RUN && !meant->torque &&
                           !facts_can_turn(seen) && facts_undisturbed(seen) &&
                           seen->time_ns > seen->client.constant_ns + SETTLED_NS;
    observation_since(&state->since_ns, forwards && backwards, seen->time_ns);
    if (state->since_ns != 0 && seen->time_ns > state->since_ns + TIME_NS) {
        checker_violated(report, seen->world->controller, plant_torque_Nm(seen->plant));
    }
}

const checker_t wrong_way_checker = {.name = "wrong_way", .state_size = sizeof(state_t), .on_interrupt = on_interrupt};
