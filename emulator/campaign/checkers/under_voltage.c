/* In state run the link voltage is not below its threshold by 6 % for 3 ms. [SR-15] */
#include "campaign/checkers/checker.h"

#define PART 0.94
#define TIME_NS (3 * MS_NS)

typedef struct {
    uint64_t since_ns;
} state_t;

static void on_look(const observation_t *seen, void *memory, checker_report_t *report) {
    state_t *state = memory;
    const double link_V = seen->plant->bus_voltage_V, threshold_V = seen->world->machine->under_voltage_V;
    const bool low = seen->drive.state == STATE_RUN && !facts_disturbed(seen, DISTURBS_DC_LINK_SENSOR) &&
                     link_V < PART * threshold_V;
    observation_since(&state->since_ns, low, seen->time_ns);
    if (state->since_ns && seen->time_ns > state->since_ns + TIME_NS && !facts_drive_disturbed(seen)) {
        checker_violated(report, 0, link_V / threshold_V);
    }
}

const checker_t under_voltage_checker = {.name = "under_voltage", .state_size = sizeof(state_t), .on_look = on_look};
