/* In a run no phase gets voltage for twenty times its largest flux linkage, in pulses of more than three periods, and
 * no current at all. [SR-25] */
#include "campaign/checkers/checker.h"

#include <math.h>

#include "fault_kinds.h"

#define FLUX_LINKAGES 20.0 /* of the aligned position at the trip current */
#define NO_CURRENT_A 1e-3  /* a current that an open diode ends is gone at once */
#define PULSE_PERIODS 3.0  /* a shorter pulse the opposite voltage may have ended before a sample */
#define PULSE_MIN_PART                                                                                                 \
    64 /* of the period, an error that the voltage of any converter has: a look in 25 or 50 may                        \
          meet each such pulse, and would take 10 ns for 19 us */

typedef struct {
    double flux_Wb[HAL_PHASES_MAX];  /* applied to a phase without any current, V s, */
    double pulse_Wb[HAL_PHASES_MAX]; /* by the present pulse, which the opposite voltage ends */
} state_t;

/* Length of the present part of a period, between two edges of the phase. */
static uint64_t part_ns(const observation_t *seen, unsigned phase) {
    const half_bridge_pattern_t *pattern = &seen->plant->pattern[phase];
    const unsigned next = seen->plant->edge_next[phase];
    const uint64_t begin_ns = next > 0 ? pattern->delay_ns[next - 1] : 0;
    return (next < pattern->count ? pattern->delay_ns[next] : seen->period_ns) - begin_ns;
}

static void on_look(const observation_t *seen, void *memory, checker_report_t *report) {
    state_t *state = memory;
    const plant_t *plant = seen->plant;
    const double step_Wb = plant->bus_voltage_V * (double)OBSERVATION_LOOK_NS * 1e-9;
    /* Looks meet a pulse once more than it has of their steps. */
    const double short_Wb = step_Wb + PULSE_PERIODS * plant->bus_voltage_V * (double)seen->period_ns * 1e-9;
    const bool hidden = facts_disturbed(seen, DISTURBS_CURRENT_SENSOR | DISTURBS_DC_LINK_SENSOR) ||
                        seen->present[FAULT_DIODE_OPEN] || facts_checks_late(seen);
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        double *flux_Wb = &state->flux_Wb[phase], *pulse_Wb = &state->pulse_Wb[phase];
        if (seen->drive.state != STATE_RUN || plant_current_A(plant, phase) > NO_CURRENT_A) {
            *flux_Wb = *pulse_Wb = 0.0;
        } else if (plant->switches[phase] == 0) {
            *pulse_Wb = fmax(0.0, fmin(*pulse_Wb, short_Wb) - step_Wb);
        } else if (plant->switches[phase] == (HALF_BRIDGE_UPPER | HALF_BRIDGE_LOWER) &&
                   part_ns(seen, phase) > seen->period_ns / PULSE_MIN_PART) {
            *pulse_Wb += step_Wb;
            *flux_Wb += *pulse_Wb > short_Wb ? step_Wb : 0.0;
            if (*flux_Wb > FLUX_LINKAGES * seen->largest_flux_Wb && !hidden) {
                checker_violated(report, phase, *flux_Wb);
            }
        }
    }
}

const checker_t no_current_checker = {.name = "no_current", .state_size = sizeof(state_t), .on_look = on_look};
