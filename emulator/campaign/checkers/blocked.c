/* While a speed is commanded, the rotor does not stay within a quarter of a stroke for 300 ms and three strokes, nor
 * within a stroke for 500 ms and six: a swing that grows is no standstill. [SR-24] */
#include "campaign/checkers/checker.h"

#include "fault_kinds.h"

#define HELD_NS (300 * MS_NS)
#define SWINGING_NS (500 * MS_NS)

typedef struct {
    observation_stay_t held, swinging;
} state_t;

static void on_millisecond(const observation_t *seen, void *memory, checker_report_t *report) {
    state_t *state = memory;
    const bool pushed = facts_pushed(seen);
    const double stroke_rad = facts_stroke_rad(seen);
    const uint64_t held_ns = observation_stays_ns(seen, &state->held, pushed, 0.25 * stroke_rad);
    const uint64_t swinging_ns = observation_stays_ns(seen, &state->swinging, pushed, stroke_rad);
    const uint64_t strokes_ns = pushed ? facts_strokes_ns(seen, 3.0) : 0;
    const bool hidden = facts_checks_late(seen) || /* or the encoder shows a rotor that turns */
                        facts_disturbed_besides(seen, DISTURBS_ANGLE, FAULT_ENCODER_STUCK);
    if ((held_ns > HELD_NS + strokes_ns || swinging_ns > SWINGING_NS + 2 * strokes_ns) && !hidden) {
        checker_violated(report, 0, (double)swinging_ns * 1e-6);
    }
}

const checker_t blocked_checker = {.name = "blocked", .state_size = sizeof(state_t), .on_millisecond = on_millisecond};
