#include "campaign/oracle_parts.h"

#include <math.h>

#include "bench_variables.h"
#include "fault_kinds.h"

#define OBSERVED_S 3e-3 /* until speed and load are observed: three poles at 1000 rad/s */

/* A switch that a short circuit has heated further takes away torque, from the limit of 100 C on the run, until it has
 * cooled. */
#define SWITCH_COOL_C 80.0

double oracle_recovery_speed_rpm(oracle_t *oracle, const plant_t *plant) {
    const world_machine_t *machine = oracle->world->machine;
    const double now_rpm = plant->speed_rad_s * ORACLE_RPM_PER_RAD_S;
    /* A drive of one quadrant cannot slow down. */
    oracle->recovery_rpm = fmax(fabs(now_rpm) * 1.1, 0.2 * machine->speed_base_rpm);
    if (oracle->world->controller == 2 && now_rpm < 0.0) {
        oracle->recovery_rpm = -oracle->recovery_rpm;
    }
    oracle->recovery_judged = fabs(oracle->recovery_rpm) <= 0.9 * machine->speed_base_rpm &&
                              fabs(oracle->recovery_rpm) <= 0.95 * machine->speed_command_max_rpm &&
                              (now_rpm >= 0.0 || oracle->world->controller == 2);
    return fmin(fabs(oracle->recovery_rpm), machine->speed_command_max_rpm) * (oracle->recovery_rpm < 0.0 ? -1.0 : 1.0);
}

double oracle_added_rad_s(const oracle_t *oracle, const plant_t *plant) {
    const machine_t *machine = plant->machine;
    const double late_s =
        3e-9 * (double)oracle->period_ns + OBSERVED_S + oracle->detection.largest_flux_Wb / machine->supply_voltage_V;
    return late_s * oracle->world->machine->torque_max_Nm / (machine->inertia_kg_m2 * oracle->world->inertia_gain);
}

/* Part of the speed that a drive of one quadrant may have at most. */
static double most_of_one_quadrant(const oracle_t *oracle, const plant_t *plant) {
    return fmax(1.2, 1.05 + oracle_added_rad_s(oracle, plant) * ORACLE_RPM_PER_RAD_S / fabs(oracle->recovery_rpm));
}

void oracle_look_at_recovery(oracle_t *oracle, const plant_t *plant) {
    if (!oracle->recovered) {
        return;
    }
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        oracle->used |= (plant->switches[phase] != 0 ? 1u : 0u) << phase;
    }
    const double part = plant->speed_rad_s * ORACLE_RPM_PER_RAD_S / oracle->recovery_rpm;
    /* A drive of one quadrant waits for the friction to take an overshoot. */
    const double most = oracle->world->controller == 2 ? 1.005 : most_of_one_quadrant(oracle, plant);
    oracle_since(&oracle->in_band_ns, part >= 0.995 && part <= most, plant->time_ns);
    oracle->settled =
        oracle->settled || (oracle->in_band_ns && plant->time_ns >= oracle->in_band_ns + 2 * ORACLE_MS_NS);
}

/* Lines of safe torque off that differed for 200 ms keep a drive in a fault until both have been without energy. */
static bool sto_lines_differed(const oracle_t *oracle) {
    const world_t *world = oracle->world;
    for (unsigned i = 0; i < world->events; i++) {
        const world_event_t *event = world_begun(world, i, UINT64_MAX);
        if (event != NULL && event->kind == WORLD_SET &&
            (event->what == BENCH_VARIABLE_STO_1 || event->what == BENCH_VARIABLE_STO_2) &&
            (event->end_us == 0 || event->end_us > event->begin_us + 195000)) {
            return true;
        }
    }
    return false;
}

/* A drive takes a current that its sensor has shown for so long for heat, which has to go before it runs. */
static bool heated_by_sensor(const oracle_t *oracle) {
    const world_t *world = oracle->world;
    for (unsigned i = 0; i < world->events; i++) {
        const world_event_t *event = world_begun(world, i, UINT64_MAX);
        if (event != NULL && event->kind == WORLD_FAULT && event->what >= FAULT_CURRENT_SENSOR_STUCK &&
            event->what <= FAULT_CURRENT_SENSOR_OFFSET && event->end_us > event->begin_us + 100000) {
            return true;
        }
    }
    return false;
}

/* True when what keeps a drive in a fault is still there: nothing to be judged. */
static bool cause_remains(const oracle_t *oracle) {
    if (oracle_any_injected(oracle, FAULT_LIMIT_FLIPPED, FAULT_PERIOD_REGISTER_FLIPPED)) {
        return true; /* memory that has changed: until a reset */
    }
    if (sto_lines_differed(oracle) || heated_by_sensor(oracle) || oracle->surged) {
        return true;
    }
    const uint8_t last = oracle->causes ? oracle->cause[oracle->causes - 1] : 0;
    return last == CAUSE_WINDING_OVERLOAD || last == CAUSE_INVERTER_OVERLOAD || last == CAUSE_IDENTIFIER_CONFLICT;
}

/* A drive takes an encoder for frozen until it counts, which at rest only a hand on the shaft or a reset can end. */
static bool held_by_encoder(const oracle_t *oracle, const plant_t *plant) {
    const bool any =
        oracle_encoder_faulty(oracle) || oracle_any_injected(oracle, FAULT_SHAFT_LOCKED, FAULT_STATIC_FRICTION);
    return any && !oracle->recovered && fabs(plant->speed_rad_s) < 2.0;
}

void oracle_enter_run(oracle_t *oracle, const plant_t *plant) {
    if (oracle->recovered || oracle->world->recovery_us == 0 ||
        plant->time_ns < oracle->world->recovery_us * 1000 + 25 * ORACLE_MS_NS) {
        return;
    }
    const machine_t *machine = plant->machine;
    const double change_rad_s = fabs(oracle->recovery_rpm / ORACLE_RPM_PER_RAD_S - plant->speed_rad_s);
    const double needed_s =
        machine->inertia_kg_m2 * oracle->world->inertia_gain * change_rad_s / (0.5 * oracle_torque_max_Nm(oracle));
    oracle->recovered = true;
    oracle->recovery_angle_rad = plant->rotor_angle_rad;
    oracle->settle_by_ns = plant->time_ns + (uint64_t)((0.1 + needed_s) * 1e9);
}

void oracle_finish(oracle_t *oracle, const plant_t *plant, oracle_heat_t heat) {
    oracle_judge_temperature(oracle, plant, heat);
    oracle->held = held_by_encoder(oracle, plant);
    if (oracle->held || !oracle->recovery_judged || cause_remains(oracle) || oracle->bus_disturbed ||
        heat.switch_C > SWITCH_COOL_C) {
        return;
    }
    if (!oracle->recovered) {
        oracle_violate(oracle, "not_recovered", plant->time_ns, 1, oracle->drive.state);
    } else if (!oracle->settled && plant->time_ns > oracle->settle_by_ns) {
        oracle_violate(oracle, "not_recovered", plant->time_ns, 2,
                       plant->speed_rad_s * ORACLE_RPM_PER_RAD_S / oracle->recovery_rpm);
    }
    const bool turned =
        fabs(plant->rotor_angle_rad - oracle->recovery_angle_rad) > 2.0 * ORACLE_TWO_PI / plant->machine->rotor_poles;
    if (oracle->recovered && oracle->world->controller == 2 && turned &&
        oracle->used + 1u != 1u << plant->machine->phases) {
        oracle_violate(oracle, "not_recovered", plant->time_ns, 4, oracle->used);
    }
}
