/* Speed, link voltage and largest current in the snapshot of a fault are the values at its instant. [SR-40] */
#include "campaign/checkers/checker.h"

#include <math.h>

enum { SPEED = 16, LINK_VOLTAGE, CURRENT };

#define RAN_NS (100 * MS_NS) /* until the speed is observed */
#define OLD_NS (30 * MS_NS)  /* until the first snapshot after a fault may be an earlier one's */
#define ERROR_MAX 0.001      /* of the full scale */
#define SPEED_ERROR_MAX 0.2
#define SPEED_ERROR_MAX_BASE 0.1
#define SPEED_LSBS 250.0 /* of a command, in one of the snapshot */

typedef struct {
    double speed_rpm, voltage, current; /* when the fault was latched; as fractions of the full scales */
    bool observed;                      /* the speed, by a run of long and all interrupts until then */
} state_t;

static void on_interrupt(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)report;
    state_t *state = memory;
    if (seen->drive.state != STATE_FAULT || seen->before == STATE_FAULT) {
        return;
    }
    *state = (state_t){.speed_rpm = seen->plant->speed_rad_s * RPM_PER_RAD_S,
                       .voltage = seen->drive.link_voltage,
                       .observed = seen->before == STATE_RUN && seen->before_ns > RAN_NS &&
                                   facts_speed_is_observed(seen) && !facts_checks_late(seen)};
    for (unsigned phase = 0; phase < seen->plant->machine->phases; phase++) {
        state->current = fmax(state->current, seen->drive.current[phase]);
    }
}

static void judge(checker_report_t *report, unsigned number, double value, double truth, double error) {
    if (fabs(value - truth) > error) {
        checker_violated(report, number, value);
    }
}

static void on_frame(const observation_t *seen, void *memory, checker_report_t *report, const checker_frame_t *frame) {
    const state_t *state = memory;
    const world_machine_t *machine = seen->world->machine;
    const sensor_ranges_t *ranges = &machine->image.machine.ranges;
    if (frame->identifier != DRIVE_FAULT_SNAPSHOT_FRAME_ID || !facts_frames_are_current(seen) ||
        seen->drive.state != STATE_FAULT || seen->time_ns < seen->latched_ns + OLD_NS ||
        seen->reset_ns > seen->latched_ns || facts_state_changed(seen)) {
        return;
    }
    struct drive_fault_snapshot_t snapshot;
    drive_fault_snapshot_unpack(&snapshot, frame->data, 8);
    if (state->observed) {
        const double error_rpm =
            SPEED_ERROR_MAX * fabs(state->speed_rpm) + SPEED_ERROR_MAX_BASE * machine->speed_base_rpm;
        judge(report, SPEED, snapshot.speed_rpm * SPEED_LSBS * machine->command_lsb_rpm, state->speed_rpm, error_rpm);
    }
    judge(report, LINK_VOLTAGE, snapshot.bus_voltage_v * machine->voltage_lsb_V / ranges->dc_link_V, state->voltage,
          ERROR_MAX);
    judge(report, CURRENT, snapshot.current_max_a * machine->current_lsb_A / ranges->current_A, state->current,
          ERROR_MAX);
}

const checker_t wrong_snapshot_checker = {
    .name = "wrong_snapshot", .state_size = sizeof(state_t), .on_interrupt = on_interrupt, .on_frame = on_frame};
