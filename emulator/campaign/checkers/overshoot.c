/* Undisturbed, a speed that approaches its reference from below exceeds it by no more than 12 %, 5 % of the base speed
 * and what the torque limit adds to the speed of a rotor at rest until its encoder counts. */
#include "campaign/checkers/checker.h"

#include <math.h>

#define OVER_MAX 0.12
#define OVER_MAX_BASE 0.05 /* of the base speed; of one quadrant, which cannot brake: and what a light rotor gains */

static void on_interrupt(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)memory;
    const double reference_rad_s = seen->client.meant.reference / RPM_PER_RAD_S;
    const double speed_rad_s = seen->plant->speed_rad_s, base_rad_s = facts_base_rad_s(seen);
    const bool from_below = seen->client.begin_speed_rad_s * reference_rad_s < reference_rad_s * reference_rad_s;
    /* Then loads end with the faults. */
    const bool recovers = seen->world->recovery_us && seen->time_ns >= seen->world->recovery_us * 1000;
    if (!facts_runs_by_speed(seen) || !from_below || recovers || !facts_undisturbed(seen) ||
        facts_overhauled(seen, speed_rad_s)) {
        return;
    }
    const double over_rad_s = speed_rad_s * (reference_rad_s < 0.0 ? -1.0 : 1.0) - fabs(reference_rad_s);
    const double added_rad_s =
        facts_uncounted_rad_s(seen) + (facts_four_quadrants(seen) ? 0.0 : facts_added_rad_s(seen));
    if (over_rad_s > OVER_MAX * fabs(reference_rad_s) + OVER_MAX_BASE * base_rad_s + added_rad_s) {
        checker_violated(report, seen->world->controller, over_rad_s / base_rad_s);
    }
}

const checker_t overshoot_checker = {.name = "overshoot", .on_interrupt = on_interrupt};
