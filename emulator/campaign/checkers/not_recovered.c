/* After the faults, cleared, armed and commanded, the drive runs again within 150 ms, is at the speed 100 ms after the
 * time that half of the torque limit needs, has no further fault until then, and uses all its phases. Judged up to 0.9
 * of the base speed, and unless what keeps a drive in a fault is still there. [SR-41] */
#include "campaign/checkers/checker.h"

#include <math.h>

enum { NOT_IN_RUN = 1, NOT_AT_SPEED, FAULT_AGAIN, PHASE_LEFT_OUT };

#define STO_DIFFERED_US 195000     /* lines of safe torque off: then both have to be without energy once */
#define SENSOR_HEAT_US 100000      /* a drive takes a current that its sensor has shown for so long for heat */
#define SWITCH_COOL_C 80.0         /* a warmer switch takes away torque: from the limit of 100 C on the run */
#define CONFLICT_NS (1150 * MS_NS) /* and until the drive has been cleared and started */
#define TURNED_PITCHES 2.0         /* then every phase has had its turn */

typedef struct {
    unsigned used; /* bit of each phase with a gate on since the drive runs again */
} state_t;

static void on_look(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)report;
    state_t *state = memory;
    for (unsigned phase = 0; phase < seen->plant->machine->phases && seen->recovery.restarted; phase++) {
        state->used |= (seen->plant->switches[phase] != 0 ? 1u : 0u) << phase;
    }
}

static void on_interrupt(const observation_t *seen, void *memory, checker_report_t *report) {
    (void)memory;
    const observation_recovery_t *recovery = &seen->recovery;
    if (seen->drive.state == STATE_FAULT && seen->before != STATE_FAULT && recovery->restarted && recovery->judged &&
        !recovery->settled && !facts_bus_disturbed(seen)) {
        checker_violated(report, FAULT_AGAIN, seen->drive.fault);
    }
}

static bool lines_differed(const observation_t *seen) {
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = world_begun(seen->world, i, UINT64_MAX);
        if (event != NULL && event->kind == WORLD_SET && (variable_effect(event->what).disturbs & VARIABLE_STO) != 0 &&
            (event->end_us == 0 || event->end_us > event->begin_us + STO_DIFFERED_US)) {
            return true;
        }
    }
    return false;
}

static bool heated_by_sensor(const observation_t *seen) {
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = world_begun(seen->world, i, UINT64_MAX);
        if (event != NULL && event->kind == WORLD_FAULT &&
            (fault_effect(event->what).disturbs & DISTURBS_THERMAL_MODEL) != 0 &&
            event->end_us > event->begin_us + SENSOR_HEAT_US) {
            return true;
        }
    }
    return false;
}

/* A foreign frame with an identifier of the drive is a conflict for a second. */
static bool identifiers_conflict(const observation_t *seen) {
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = world_begun(seen->world, i, UINT64_MAX);
        if (event != NULL && event->kind == WORLD_HOSTILE &&
            (event->what == WORLD_HOSTILE_IDENTITY || event->what == WORLD_HOSTILE_FLOOD) &&
            seen->time_ns < event->end_us * 1000 + CONFLICT_NS) {
            return true;
        }
    }
    return false;
}

/* The reason for which a drive stays in a fault is still there: memory that has changed, until a reset; safe torque
 * off; heat. */
static bool cause_remains(const observation_t *seen) {
    const uint8_t last = seen->causes ? seen->cause[seen->causes - 1] : 0;
    return facts_ever_disturbed(seen, DISTURBS_MEMORY) || lines_differed(seen) || heated_by_sensor(seen) ||
           seen->surged || seen->true_heat.switch_C > SWITCH_COOL_C || last == CAUSE(WINDING_OVERLOAD) ||
           last == CAUSE(INVERTER_OVERLOAD) || identifiers_conflict(seen);
}

static void at_end(const observation_t *seen, void *memory, checker_report_t *report) {
    const state_t *state = memory;
    const observation_recovery_t *recovery = &seen->recovery;
    if (recovery->held || !recovery->judged || cause_remains(seen)) {
        return;
    }
    if (!recovery->restarted) {
        checker_violated(report, NOT_IN_RUN, seen->drive.state);
        return;
    }
    if (!recovery->settled && seen->time_ns > recovery->settle_by_ns) {
        checker_violated(report, NOT_AT_SPEED, seen->plant->speed_rad_s * RPM_PER_RAD_S / recovery->speed_rpm);
    }
    const double pitch_rad = TWO_PI / seen->plant->machine->rotor_poles;
    const bool turned = fabs(seen->plant->rotor_angle_rad - recovery->restart_angle_rad) > TURNED_PITCHES * pitch_rad;
    if (facts_four_quadrants(seen) && turned && state->used + 1u != 1u << seen->plant->machine->phases) {
        checker_violated(report, PHASE_LEFT_OUT, state->used);
    }
}

const checker_t not_recovered_checker = {.name = "not_recovered",
                                         .state_size = sizeof(state_t),
                                         .on_interrupt = on_interrupt,
                                         .on_look = on_look,
                                         .at_end = at_end};
