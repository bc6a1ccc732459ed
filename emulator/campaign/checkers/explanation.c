#include "campaign/checkers/explanation.h"

#include <math.h>

#include "campaign/facts.h"
#include "fault_kinds.h"

#define PHASE_CAUSES (CAUSE_BIT(CURRENT_SENSOR) | CAUSE_BIT(PHASE_OPEN) | CAUSE_BIT(PHASE_SHORTED))
#define ENCODER_CAUSES (CAUSE_BIT(ENCODER) | CAUSE_BIT(ENCODER_ANGLE))
#define OVERLOAD_CAUSES (CAUSE_BIT(WINDING_OVERLOAD) | CAUSE_BIT(INVERTER_OVERLOAD))
#define COMMAND_CAUSES (CAUSE_BIT(COMMAND_TIMEOUT) | CAUSE_BIT(COMMAND_ERROR))
#define BUS_CAUSES (COMMAND_CAUSES | CAUSE_BIT(IDENTIFIER_CONFLICT))

#define OF_PHASE (DISTURBS_PHASE | DISTURBS_CURRENT_SENSOR)
#define OF_SENSORS (OF_PHASE | DISTURBS_DC_LINK_SENSOR | DISTURBS_ENCODER)

#define STALLED_NS (100 * MS_NS) /* without a stroke */
#define CONDUCTED_MAX_NS (250 * MS_NS)
#define STALL_CHANGE (1.0 / 128.0) /* of the reference: a change of the speed within STALLED_NS is no stall */
#define LOADED 0.9                 /* of the torque that is left */
#define LOADED_BACK 0.7            /* likewise, of one quadrant turned back */
#define COASTING_NS MS_NS          /* without a gate */

/* --- True of the plant --- */

/* Torque that heat and the client leave. Telemetry that may be disturbed is not looked at: then the temperatures tell
 * that the drive has measured. */
static double torque_left_Nm(const observation_t *seen) {
    const observation_heat_t heat = seen->drive.heat;
    const double announced_Nm = seen->limit.last_ns != 0 ? seen->limit.limit_Nm.low[0] : INFINITY;
    return fmin(announced_Nm, facts_cool_part(heat.winding_C, heat.switch_C) * facts_torque_max_Nm(seen));
}

/* Load and friction leave too little of the torque to change the speed in the time of a stall. A rotor that a load
 * turns backwards has less of it in the mean: one quadrant takes the phases in the order of forward motion, and
 * backwards each of them ends its part where its torque, at the limit of the current, is small. */
static bool overloaded(const observation_t *seen) {
    const plant_t *plant = seen->plant;
    const bool driven_back = !facts_four_quadrants(seen) && plant->speed_rad_s < 0.0 && plant->load_torque_Nm > 0.0;
    const double used_Nm = fabs(plant->load_torque_Nm) + fmax(plant->faults.coulomb_Nm, plant->faults.static_Nm);
    const double change_rad_s = STALL_CHANGE * fabs(seen->client.meant.reference) / RPM_PER_RAD_S;
    const double needed_Nm =
        seen->client.meant.torque ? 0.0 : facts_inertia_kg_m2(seen) * change_rad_s / (1e-9 * STALLED_NS);
    return used_Nm + needed_Nm > (driven_back ? LOADED_BACK : LOADED) * torque_left_Nm(seen);
}

/* A drive with a phase less does not get over the angles at which the others make no torque. */
static bool held_by_lost_phase(const observation_t *seen) {
    const double reference_rad_s = seen->client.meant.reference / RPM_PER_RAD_S;
    return facts_may_be_degraded(seen) && !seen->client.meant.torque &&
           seen->plant->speed_rad_s * reference_rad_s < 0.5 * reference_rad_s * reference_rad_s;
}

static bool true_of_plant(const observation_t *seen, unsigned cause) {
    const world_machine_t *machine = seen->world->machine;
    const observation_recent_t *recent = &seen->recent;
    const double link_V = seen->plant->bus_voltage_V;
    switch (cause) {
    case CAUSE(OVER_CURRENT):
    case CAUSE(HARDWARE_OVER_CURRENT):
        return fmax(recent->current_A, facts_largest_current_A(seen)) > 0.95 * machine->trip_current_A;
    case CAUSE(OVER_VOLTAGE):
        return fmax(recent->voltage_high_V, link_V) > 0.98 * machine->over_voltage_V;
    case CAUSE(UNDER_VOLTAGE):
        return fmin(recent->voltage_low_V, link_V) < 1.02 * machine->under_voltage_V;
    case CAUSE(OVER_SPEED):
        return fmax(recent->speed_rad_s, fabs(seen->plant->speed_rad_s)) * RPM_PER_RAD_S >
               0.95 * machine->over_speed_rpm;
    case CAUSE(STALL):
        return seen->time_ns > seen->rotor.stroke_ns + STALLED_NS || seen->rotor.swings || overloaded(seen) ||
               held_by_lost_phase(seen);
    default:
        return false;
    }
}

/* A reason that the plant shows and that is not the drive's own work. A drive with healthy sensors, phases, supply and
 * processor does not exceed its current; without a load that drives it neither its speed, nor the voltage of a link
 * that is fed as it should be, even when the link takes no energy. */
static bool has_reason(const observation_t *seen, unsigned cause) {
    const sender_meaning_t *meant = &seen->client.meant;
    const bool unsound = facts_disturbed(seen, OF_SENSORS | DISTURBS_SHAFT | DISTURBS_LOAD) ||
                         facts_checks_late(seen) || facts_overhauled(seen, seen->plant->speed_rad_s);
    const double near = facts_four_quadrants(seen) ? 0.97 : 0.8; /* an overshoot of one quadrant stays */
    const bool coasts = seen->dark_ns != 0 && seen->time_ns > seen->dark_ns + COASTING_NS;
    const bool near_limit =
        coasts || (!meant->torque && fabs(meant->reference) > near * seen->world->machine->over_speed_rpm);
    switch (cause) {
    case CAUSE(OVER_CURRENT):
    case CAUSE(HARDWARE_OVER_CURRENT):
        return facts_disturbed(seen, OF_SENSORS | DISTURBS_SUPPLY) || facts_drive_disturbed(seen);
    case CAUSE(OVER_SPEED):
        return unsound || near_limit;
    case CAUSE(OVER_VOLTAGE):
        return unsound || facts_disturbed(seen, DISTURBS_SUPPLY | DISTURBS_MEMORY | DISTURBS_CLOCK);
    default:
        return true;
    }
}

/* --- Of the faults --- */

/* Start of the latest fault of a phase or of a sensor of the motion. */
static uint64_t latest_fault_ns(const observation_t *seen) {
    uint64_t latest_us = 0;
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = world_begun(seen->world, i, seen->time_ns / 1000);
        const bool shows =
            event != NULL && event->kind == WORLD_FAULT && (fault_effect(event->what).disturbs & OF_SENSORS) != 0;
        latest_us = shows && event->begin_us > latest_us ? event->begin_us : latest_us;
    }
    return latest_us * 1000;
}

/* No two phases without a fault have had a current to speak of since the latest one and in the last quarter of a
 * second: one for the encoder's angle and one against it tell nothing. */
static bool conducts_alone(const observation_t *seen) {
    const unsigned faulty = facts_phases_at_fault(seen, seen->time_ns / 1000);
    const uint64_t since_ns = latest_fault_ns(seen);
    unsigned conducting = 0;
    for (unsigned phase = 0; phase < seen->plant->machine->phases; phase++) {
        const uint64_t last_ns = seen->conducted_ns[phase];
        conducting += !(faulty >> phase & 1u) && last_ns > since_ns && seen->time_ns < last_ns + CONDUCTED_MAX_NS;
    }
    return conducting < 2;
}

static uint32_t causes_of_event(const world_event_t *event) {
    const bool clears = event->kind == WORLD_REQUEST && event->what == WORLD_REQUEST_CLEAR; /* refused in a run */
    switch (event->kind) {
    case WORLD_SET:
        return variable_effect(event->what).causes;
    case WORLD_SILENT:
    case WORLD_BEYOND:
        return COMMAND_CAUSES;
    case WORLD_HOSTILE:
    case WORLD_SECOND:
        return BUS_CAUSES;
    default:
        return clears ? COMMAND_CAUSES : 0;
    }
}

/* Causes that several faults together, or a fault from the start, cannot be told apart from. */
static uint32_t causes_alike(const observation_t *seen) {
    const bool of_phase = facts_ever_disturbed(seen, OF_PHASE), of_encoder = facts_ever_disturbed(seen, DISTURBS_ANGLE);
    const unsigned phases = facts_phases_at_fault(seen, seen->time_ns / 1000);
    uint32_t causes = 0;
    /* With one phase that has conducted lately a wrong current and a wrong angle, or one that does not move, are the
     * same; */
    if (!seen->rotor.turned || conducts_alone(seen)) {
        causes |= (of_phase ? ENCODER_CAUSES : 0) | (of_encoder ? PHASE_CAUSES : 0);
    }
    /* and two phases with faults of their own are what a wrong angle looks like. */
    if ((phases & (phases - 1u)) != 0) {
        causes |= CAUSE_BIT(ENCODER_ANGLE);
    }
    /* From a shorted switch through the earth flows a current that no drive can end, also before the first run. */
    if (seen->injected[FAULT_SWITCH_SHORTED] && seen->injected[FAULT_WINDING_TO_EARTH]) {
        causes |= OVERLOAD_CAUSES;
    }
    return causes;
}

explanation_t explanation_of_fault(const observation_t *seen) {
    const unsigned cause = seen->drive.fault;
    uint32_t causes = causes_alike(seen), of_events = 0;
    for (unsigned kind = 1; kind < FAULT_COUNT; kind++) {
        causes |= seen->present[kind] ? fault_effect(kind).causes : 0;
    }
    for (unsigned i = 0; i < seen->world->events; i++) {
        const world_event_t *event = world_begun(seen->world, i, seen->time_ns / 1000);
        of_events |= event != NULL ? causes_of_event(event) : 0;
    }
    causes |= of_events;
    return (explanation_t){
        .explained = (causes >> cause & 1u) || (true_of_plant(seen, cause) && has_reason(seen, cause)),
        .any = seen->ever_disturbed != 0 || of_events != 0,
    };
}
