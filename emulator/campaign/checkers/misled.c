/* A drive does not run for 200 ms by a measured angle that is off by more than a sixth of a rotor pitch, at which a
 * phase makes torque in the other direction. [SR-20] [SR-22] */
#include "campaign/checkers/checker.h"

#include <math.h>

#define ERROR_PITCHES (1.0 / 6.0)
#define SPEED_MIN 0.2   /* of the base speed, above which a wrong angle shows soon, */
#define CURRENT_MIN 0.1 /* of the trip */
#define TIME_NS (200 * MS_NS)

typedef struct {
    uint64_t since_ns;
} state_t;

static void on_millisecond(const observation_t *seen, void *memory, checker_report_t *report) {
    state_t *state = memory;
    const world_machine_t *machine = seen->world->machine;
    const double error_rev =
        ldexp((double)seen->drive.angle, -32) - seen->plant->rotor_angle_rad / TWO_PI - seen->encoder_offset_rev;
    const double pitches = error_rev * seen->plant->machine->rotor_poles;
    const double error_pitches = pitches - floor(pitches + 0.5);
    const bool misled = seen->drive.state == STATE_RUN && facts_speed_rpm(seen) > SPEED_MIN * machine->speed_base_rpm &&
                        facts_largest_current_A(seen) > CURRENT_MIN * machine->trip_current_A &&
                        fabs(error_pitches) > ERROR_PITCHES;
    observation_since(&state->since_ns, misled, seen->time_ns);
    if (state->since_ns && seen->time_ns > state->since_ns + TIME_NS && !facts_checks_late(seen)) {
        checker_violated(report, 0, error_pitches);
    }
}

const checker_t misled_checker = {.name = "misled", .state_size = sizeof(state_t), .on_millisecond = on_millisecond};
