/* In an undisturbed run the mean torque in telemetry, over 25 frames and two electrical periods, is the true one within
 * 30 % and 15 % of the rated one; by the hysteresis controllers, whose ripple all frames may meet alike, it is between
 * the least and the largest. */
#include "campaign/checkers/checker.h"

#include <math.h>

#define SETTLED_NS (100 * MS_NS)
#define FRAMES 25
#define PERIODS 2.0
#define SPEED_MAX 0.5 /* of the base speed */
#define ERROR_MAX 0.3
#define ERROR_MAX_RATED 0.15
#define TORQUE_LSBS 256.0 /* of a command, in one of telemetry */

typedef struct {
    unsigned frames, samples;
    double estimate_sum_Nm, true_sum_Nm, least_Nm, most_Nm, begin_angle_rad;
    double angle_rad; /* of the rotor, at the last control interrupt */
} state_t;

static void on_interrupt(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)report;
    state_t *state = memory;
    const double torque_Nm = plant_torque_Nm(seen->plant), angle_rad = seen->plant->rotor_angle_rad;
    const bool known = seen->drive.state == STATE_RUN && seen->time_ns > seen->state_ns + SETTLED_NS &&
                       facts_undisturbed(seen) && facts_frames_are_current(seen) &&
                       facts_speed_rpm(seen) < SPEED_MAX * seen->world->machine->speed_base_rpm;
    if (!known || state->frames == 0) {
        *state = (state_t){.begin_angle_rad = angle_rad};
    }
    state->angle_rad = angle_rad;
    if (known) {
        state->least_Nm = state->samples ? fmin(state->least_Nm, torque_Nm) : torque_Nm;
        state->most_Nm = state->samples ? fmax(state->most_Nm, torque_Nm) : torque_Nm;
        state->true_sum_Nm += torque_Nm;
        state->samples++;
    }
}

static void on_frame(const observation_t *seen, void *memory, checker_report_t *report, const checker_frame_t *frame) {
    state_t *state = memory;
    if (frame->identifier != DRIVE_TORQUE_FRAME_ID || !facts_frames_are_current(seen)) {
        return;
    }
    struct drive_torque_t torque;
    drive_torque_unpack(&torque, frame->data, 8);
    state->estimate_sum_Nm += torque.torque_estimate_nm * TORQUE_LSBS * seen->world->machine->command_lsb_Nm;
    state->frames++;
    const double turned_rad = fabs(state->angle_rad - state->begin_angle_rad);
    const double pitch_rad = TWO_PI / seen->world->machine->image.machine.rotor_poles;
    if (state->frames < FRAMES || state->samples == 0 || turned_rad < PERIODS * pitch_rad) {
        return;
    }
    const double mean_Nm = state->estimate_sum_Nm / state->frames, true_Nm = state->true_sum_Nm / state->samples;
    const double error_Nm = ERROR_MAX * fabs(true_Nm) + ERROR_MAX_RATED * seen->world->machine->torque_rated_Nm;
    const bool shares = facts_four_quadrants(seen);
    const double least_Nm = shares ? true_Nm : state->least_Nm, most_Nm = shares ? true_Nm : state->most_Nm;
    if (mean_Nm < least_Nm - error_Nm || mean_Nm > most_Nm + error_Nm) {
        checker_violated(report, 0, mean_Nm / true_Nm);
    }
    state->frames = 0;
}

const checker_t wrong_torque_telemetry_checker = {.name = "wrong_torque_telemetry",
                                                  .state_size = sizeof(state_t),
                                                  .on_interrupt = on_interrupt,
                                                  .on_frame = on_frame};
