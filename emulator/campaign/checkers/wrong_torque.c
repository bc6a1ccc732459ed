/* In torque mode, undisturbed and below half of the base speed, above which the voltage limits the torque, the mean
 * torque of electrical periods is the commanded one within 10 %, by the hysteresis controllers within 25 %. */
#include "campaign/checkers/checker.h"

#include <math.h>

#include "campaign/checkers/mean_torque.h"

#define SETTLED_NS (50 * MS_NS) /* after another command */
#define MIN_NS (5 * MS_NS)
#define SPEED_MAX 0.5  /* of the base speed */
#define ERROR_MAX 0.10 /* of the torque: flux linkages of a machine scatter by 5 %, */
#define ERROR_MAX_RATED 0.02
#define ERROR_MAX_HYSTERESIS 0.25
#define ERROR_MAX_RATED_HYSTERESIS 0.1 /* of a light winding, whose current changes by much in a period */

static bool follows(const observation_t *seen) {
    const observation_client_t *client = &seen->client;
    return seen->drive.state == STATE_RUN && client->meant.request == SENDER_RUN && client->meant.torque &&
           seen->time_ns > client->constant_ns + SETTLED_NS && seen->time_ns > seen->state_ns + SETTLED_NS &&
           facts_heard(seen) && facts_speed_rpm(seen) < SPEED_MAX * seen->world->machine->speed_base_rpm &&
           /* One quadrant brakes a rotor that turns back. */
           (facts_four_quadrants(seen) || seen->plant->speed_rad_s > 0.0) && facts_undisturbed(seen) &&
           !facts_derated(seen);
}

static void on_interrupt(const observation_t *seen, void *memory, checker_report_t *report) {
    mean_torque_t *torque = memory;
    double mean_Nm;
    if (!follows(seen)) {
        torque->samples = 0;
        return;
    }
    const bool shares = facts_four_quadrants(seen);
    const double reference_Nm = seen->client.meant.reference;
    const double commanded_Nm = shares ? reference_Nm : fmax(reference_Nm, 0.0);
    if (!mean_torque_step(torque, seen, MIN_NS, &mean_Nm) || fabs(commanded_Nm) > facts_torque_max_Nm(seen)) {
        return;
    }
    const double part = shares ? ERROR_MAX : ERROR_MAX_HYSTERESIS;
    const double part_rated = shares ? ERROR_MAX_RATED : ERROR_MAX_RATED_HYSTERESIS;
    if (fabs(mean_Nm - commanded_Nm) > part * fabs(commanded_Nm) + part_rated * seen->world->machine->torque_rated_Nm) {
        checker_violated(report, seen->world->controller, mean_Nm / commanded_Nm);
    }
}

const checker_t wrong_torque_checker = {
    .name = "wrong_torque", .state_size = sizeof(mean_torque_t), .on_interrupt = on_interrupt};
