/* The limit of the torque in telemetry is not above what the loads and temperatures in the same frame leave.
 * [SR-16] [SR-17] */
#include "campaign/checkers/checker.h"

#include <math.h>

#define ERROR_MAX 0.12 /* of the largest torque: heat changes between two readings of it */
#define FULL_PERCENT 100.0
#define DERATING_PERCENT 10.0
#define LOAD_LSB_PERCENT 0.01

static void on_frame(const observation_t *seen, void *memory, checker_report_t *report, const checker_frame_t *frame) {
    (void)memory;
    if (frame->identifier != DRIVE_THERMAL_FRAME_ID || !facts_frames_are_current(seen) ||
        facts_disturbed(seen, DISTURBS_MEMORY | DISTURBS_CLOCK)) {
        return;
    }
    struct drive_thermal_t thermal;
    drive_thermal_unpack(&thermal, frame->data, 8);
    const double most_Nm = seen->world->machine->torque_max_Nm, limit_Nm = facts_limit_Nm(seen, frame->data);
    const double load_percent = LOAD_LSB_PERCENT * fmax(thermal.winding_load, thermal.switch_load);
    const double of_load = fmax((FULL_PERCENT - load_percent) / DERATING_PERCENT, 0.0);
    const double room = fmin(of_load, facts_cool_part(thermal.winding_temperature_c, thermal.inverter_temperature_c));
    if (limit_Nm > most_Nm * (room + ERROR_MAX)) {
        checker_violated(report, 0, limit_Nm / most_Nm);
    }
}

const checker_t not_derated_checker = {.name = "not_derated", .on_frame = on_frame};
