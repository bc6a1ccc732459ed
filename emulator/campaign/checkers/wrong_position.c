/* Without a homing, and while nothing disturbs the drive, the position on the bus is the true one within two counts of
 * the encoder and the motion in 6 ms. */
#include "campaign/checkers/checker.h"

#include <math.h>

#define COUNTS 2.0
#define AGE_S 6e-3
#define UNIT_REV 0x1p-17
#define BEGINS_NS (20 * MS_NS) /* by then the drive has booted */

static void on_frame(const observation_t *seen, void *memory, checker_report_t *report, const checker_frame_t *frame) {
    (void)memory;
    double position_rev;
    if (seen->world->client == WORLD_CLIENT_POSITION && frame->identifier == DRIVE_POSITION_FRAME_ID) {
        struct drive_position_t position;
        drive_position_unpack(&position, frame->data, 8);
        position_rev = position.position_deg / SENDER_POSITIONS_PER_REV;
    } else if (seen->world->client == WORLD_CLIENT_CANOPEN && frame->identifier == CHECKER_PLACED) {
        position_rev = seen->master->drive.position / MASTER_UNITS;
    } else {
        return;
    }
    const double error_rev = position_rev - facts_position_rev(seen);
    const double most_rev = COUNTS * facts_count_rev(seen) + 2.0 * UNIT_REV +
                            AGE_S * (fabs(seen->plant->speed_rad_s) / TWO_PI + seen->recent.speed_rad_s / TWO_PI);
    if (fabs(error_rev) > most_rev && seen->time_ns > BEGINS_NS && facts_untouched(seen) &&
        !facts_chooses_mode(seen, MODE_HM)) {
        checker_violated(report, 0, error_rev);
    }
}

const checker_t wrong_position_checker = {.name = "wrong_position", .on_frame = on_frame};
