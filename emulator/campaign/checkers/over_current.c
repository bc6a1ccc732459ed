/* No phase's current is above the comparators' threshold in two looks in succession while a gate of it is on. Without a
 * gate no drive can end a current, which the rotor or a shorted switch then drives. [SR-10] [SR-11] */
#include "campaign/checkers/checker.h"

#define LOOKS 2

typedef struct {
    unsigned looks[HAL_PHASES_MAX]; /* in succession with a current above */
} state_t;

/* Tolerance: what the current rises by in a control period, before the comparator's response is latched. */
static double rise_A(const observation_t *seen, unsigned phase, double current_A) {
    const plant_t *plant = seen->plant;
    magnetics_point_t point;
    magnetics_evaluate(&plant->magnetics, plant_phase_angle_rad(plant, phase), current_A, &point);
    return plant->bus_voltage_V * (double)seen->period_ns * 1e-9 / point.incremental_inductance_H;
}

static void on_look(const observation_t *seen, void *memory, checker_report_t *report) {
    state_t *state = memory;
    const double threshold_A = seen->plant->machine->trip_current_A;
    for (unsigned phase = 0; phase < seen->plant->machine->phases && threshold_A != 0.0; phase++) {
        const double current_A = plant_current_A(seen->plant, phase);
        const bool above = seen->plant->switches[phase] != 0 && current_A > threshold_A &&
                           current_A > threshold_A + rise_A(seen, phase, current_A);
        state->looks[phase] = above ? state->looks[phase] + 1 : 0;
        if (state->looks[phase] >= LOOKS) {
            checker_violated(report, phase, current_A / threshold_A);
        }
    }
}

const checker_t over_current_checker = {.name = "over_current", .state_size = sizeof(state_t), .on_look = on_look};
