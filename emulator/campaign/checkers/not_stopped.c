/* A request to stop makes the rotor no faster, and brings the rotor of a four-quadrant drive to rest while it is heard:
 * 100 ms after the time that half of the torque limit needs. [SR-06] */
#include "campaign/checkers/checker.h"

#include <math.h>

enum { STILL_TURNING, FASTER };

#define FASTER_MAX_BASE 0.05 /* of the base speed; and what a light rotor gains before its speed is known */
#define REST_BASE 0.05       /* of the base speed, */
#define REST_RAD_S 2.0       /* at which a coarse encoder shows no speed */
#define SETTLED_S 0.1

static void on_interrupt(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)memory;
    const observation_client_t *client = &seen->client;
    const double speed_rad_s = seen->plant->speed_rad_s, base_rad_s = facts_base_rad_s(seen);
    if (client->meant.request != SENDER_STOP || seen->drive.state != STATE_RUN || !facts_undisturbed(seen) ||
        facts_overhauled(seen, speed_rad_s)) {
        return;
    }
    if (fabs(speed_rad_s) > fabs(client->stop_speed_rad_s) + FASTER_MAX_BASE * base_rad_s + facts_added_rad_s(seen)) {
        checker_violated(report, FASTER, speed_rad_s / client->stop_speed_rad_s);
    }
    const double needed_s = facts_needed_s(seen, fabs(client->stop_speed_rad_s));
    if (facts_four_quadrants(seen) && !facts_derated(seen) && fabs(speed_rad_s) > REST_BASE * base_rad_s + REST_RAD_S &&
        facts_heard(seen) && seen->time_ns > client->stop_ns + (uint64_t)((SETTLED_S + needed_s) * 1e9)) {
        checker_violated(report, STILL_TURNING, speed_rad_s / client->stop_speed_rad_s);
    }
}

const checker_t not_stopped_checker = {.name = "not_stopped", .on_interrupt = on_interrupt};
