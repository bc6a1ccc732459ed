/* Currents and link voltage on the bus have been measured by the drive in the last 4 ms; the speed on the bus is the
 * true one of that time within 10 %, 5 % of the base speed and half a count in a millisecond. */
#include "campaign/checkers/checker.h"

#include <math.h>

enum { LINK_VOLTAGE = 8, SPEED }; /* besides the phases */

#define WINDOW_NS (2 * MS_NS)    /* a frame is younger than that */
#define SETTLED_NS (100 * MS_NS) /* until the speed is observed */
#define ERROR_MAX 0.001          /* of the full scale */
#define SPEED_ERROR_MAX 0.1
#define SPEED_ERROR_MAX_BASE 0.05
#define COUNT_RATE_1_S 500.0

typedef struct {
    uint64_t window_ns;                                   /* the present one began */
    observation_range_t current[HAL_PHASES_MAX], voltage; /* measured, as fractions of the full scales */
    observation_range_t speed_rad_s;                      /* true */
} state_t;

static void on_interrupt(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)report;
    state_t *state = memory;
    const bool renew = seen->time_ns >= state->window_ns + WINDOW_NS;
    state->window_ns = renew ? seen->time_ns : state->window_ns;
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        observation_widen(&state->current[phase], seen->drive.current[phase], renew);
    }
    observation_widen(&state->voltage, seen->drive.link_voltage, renew);
    observation_widen(&state->speed_rad_s, seen->plant->speed_rad_s, renew);
}

/* Currents of the phases from one on, those that the machine has. */
static void judge_currents(const observation_t *seen, const state_t *state, checker_report_t *report, unsigned from,
                           const uint16_t *raw, unsigned count) {
    const world_machine_t *machine = seen->world->machine;
    for (unsigned phase = from; phase < from + count && phase < machine->image.machine.phases; phase++) {
        const double current = raw[phase - from] * machine->current_lsb_A / machine->image.machine.ranges.current_A;
        if (!observation_is_within(&state->current[phase], current, ERROR_MAX)) {
            checker_violated(report, phase, current);
        }
    }
}

static void judge_first_currents(const observation_t *seen, const state_t *state, checker_report_t *report,
                                 const uint8_t data[8]) {
    struct drive_currents_t currents;
    drive_currents_unpack(&currents, data, 8);
    const uint16_t raw[4] = {currents.current_a_a, currents.current_b_a, currents.current_c_a, currents.current_d_a};
    judge_currents(seen, state, report, 0, raw, 4);
}

static void judge_other_currents(const observation_t *seen, const state_t *state, checker_report_t *report,
                                 const uint8_t data[8]) {
    struct drive_phases_e_f_t phases;
    drive_phases_e_f_unpack(&phases, data, 8);
    const uint16_t raw[2] = {phases.current_e_a, phases.current_f_a};
    judge_currents(seen, state, report, 4, raw, 2);
}

static void judge_voltage(const observation_t *seen, const state_t *state, checker_report_t *report,
                          const uint8_t data[8]) {
    const world_machine_t *machine = seen->world->machine;
    struct drive_torque_t torque;
    drive_torque_unpack(&torque, data, 8);
    const double voltage = torque.bus_voltage_v * machine->voltage_lsb_V / machine->image.machine.ranges.dc_link_V;
    if (!observation_is_within(&state->voltage, voltage, ERROR_MAX)) {
        checker_violated(report, LINK_VOLTAGE, voltage);
    }
}

static void judge_speed(const observation_t *seen, const state_t *state, checker_report_t *report,
                        const uint8_t data[8]) {
    struct drive_motion_t motion;
    drive_motion_unpack(&motion, data, 8);
    const double rad_s = motion.speed_rpm * seen->world->machine->command_lsb_rpm / RPM_PER_RAD_S;
    const double count_rad_s = ldexp(TWO_PI, -(int)seen->world->encoder_bits) * COUNT_RATE_1_S;
    const double error_rad_s =
        SPEED_ERROR_MAX * fabs(rad_s) + SPEED_ERROR_MAX_BASE * facts_base_rad_s(seen) + count_rad_s;
    const bool settled = seen->drive.state == STATE_RUN && seen->time_ns > seen->state_ns + SETTLED_NS;
    if (settled && facts_speed_is_observed(seen) && !observation_is_within(&state->speed_rad_s, rad_s, error_rad_s)) {
        checker_violated(report, SPEED, rad_s);
    }
}

static void on_frame(const observation_t *seen, void *memory, checker_report_t *report, const checker_frame_t *frame) {
    if (!facts_frames_are_current(seen)) {
        return;
    }
    if (frame->identifier == DRIVE_CURRENTS_FRAME_ID) {
        judge_first_currents(seen, memory, report, frame->data);
    } else if (frame->identifier == DRIVE_PHASES_E_F_FRAME_ID) {
        judge_other_currents(seen, memory, report, frame->data);
    } else if (frame->identifier == DRIVE_TORQUE_FRAME_ID) {
        judge_voltage(seen, memory, report, frame->data);
    } else if (frame->identifier == DRIVE_MOTION_FRAME_ID) {
        judge_speed(seen, memory, report, frame->data);
    }
}

const checker_t wrong_telemetry_checker = {
    .name = "wrong_telemetry", .state_size = sizeof(state_t), .on_interrupt = on_interrupt, .on_frame = on_frame};
