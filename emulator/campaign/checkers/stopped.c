/* State run is left, without a fault, only by a request to switch off, after a silence, at rest after a request to
 * stop, or by a request to run that is off because a bus-off has disarmed the drive. [SR-39] */
#include "campaign/checkers/checker.h"

#include <math.h>

#define AGE_MAX_NS (30 * MS_NS)
#define CROSSED_NS (15 * MS_NS) /* a stop may end when the request to run is already on the bus */
#define REST_RPM 20.0
#define REST_BASE 0.05 /* of the base speed; and what a light rotor loses before its speed is known */

static bool rests(const observation_t *seen) {
    const bool stops =
        seen->client.meant.request == SENDER_STOP || seen->time_ns < seen->client.withdrawn_ns + CROSSED_NS;
    const double rest_rpm =
        REST_RPM + REST_BASE * seen->world->machine->speed_base_rpm + facts_added_rad_s(seen) * RPM_PER_RAD_S;
    return stops && (facts_disturbed(seen, DISTURBS_ENCODER) || facts_speed_rpm(seen) < rest_rpm);
}

static void on_interrupt(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)memory;
    if (seen->before != STATE_RUN || seen->drive.state != STATE_READY) {
        return;
    }
    const uint64_t now_ns = seen->time_ns, run_ns = seen->client.run_ns;
    const uint64_t age_ns = now_ns > run_ns ? now_ns - run_ns : 0;
    if (!seen->client.off_seen && !rests(seen) && age_ns < AGE_MAX_NS && !facts_state_changed(seen) &&
        !facts_may_be_deaf(seen) && !facts_may_be_unarmed(seen)) {
        checker_violated(report, seen->client.meant.request, seen->plant->speed_rad_s);
    }
}

const checker_t stopped_checker = {.name = "stopped", .on_interrupt = on_interrupt};
