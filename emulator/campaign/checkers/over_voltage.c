/* No gate is on for 200 us at a link voltage above the limit by 2 %. Only of a machine whose supply takes no energy
 * back, and with a healthy sensor, which is the only one. [SR-13] [SR-14] */
#include "campaign/checkers/checker.h"

#define MARGIN 1.02
#define TIME_NS (MS_NS / 5)

typedef struct {
    uint64_t since_ns;
} state_t;

static void on_look(const observation_t *seen, void *memory, checker_report_t *report) {
    state_t *state = memory;
    const double link_V = seen->plant->bus_voltage_V, limit_V = seen->world->machine->over_voltage_V;
    const bool above = seen->gates && seen->plant->machine->dc_link.capacitance_F > 0.0 &&
                       !facts_disturbed(seen, DISTURBS_DC_LINK_SENSOR) && link_V > MARGIN * limit_V;
    observation_since(&state->since_ns, above, seen->time_ns);
    if (state->since_ns && seen->time_ns > state->since_ns + TIME_NS) {
        checker_violated(report, 0, link_V / limit_V);
    }
}

const checker_t over_voltage_checker = {.name = "over_voltage", .state_size = sizeof(state_t), .on_look = on_look};
