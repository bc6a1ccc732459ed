/* What a drive does with its commands when no fault is in the way. */
#include "campaign/oracle_parts.h"

#include <math.h>

#include "fault_kinds.h"

#define TORQUE_SETTLED_NS (50 * ORACLE_MS_NS) /* after another command */
#define TORQUE_MIN_NS (5 * ORACLE_MS_NS)
#define TORQUE_SPEED 0.5      /* of the base speed, at most: above, the voltage limits the torque */
#define TORQUE_ERROR_MAX 0.10 /* of the torque: flux linkages of a machine scatter by 5 % */
#define TORQUE_ERROR_MAX_HYSTERESIS 0.25
#define TORQUE_ERROR_MAX_RATED 0.02
#define TORQUE_ERROR_MAX_RATED_HYSTERESIS 0.1 /* of a light winding, whose current changes by much in a period */
#define OVERSHOOT_MAX 0.12                    /* of the speed reference */
#define OVERSHOOT_MAX_BASE 0.05               /* of the base speed */
#define STOP_ERROR_MAX_BASE 0.05
#define STOP_ERROR_MAX_RAD_S 2.0
#define STOP_SETTLED_S 0.1

static bool undisturbed(const oracle_t *oracle) {
    return !oracle_any_injected(oracle, 1, FAULT_COUNT - 1) && !oracle_bus_disturbed(oracle);
}

/* Torque commanded in torque mode, which no fault or limit is in the way of. */
static bool torque_follows(const oracle_t *oracle, const plant_t *plant) {
    return oracle->drive.state == STATE_RUN && oracle->meant.request == SENDER_RUN && oracle->meant.torque &&
           plant->time_ns > oracle->constant_ns + TORQUE_SETTLED_NS &&
           plant->time_ns > oracle->state_ns + TORQUE_SETTLED_NS &&
           plant->time_ns < oracle->run_ns + TORQUE_SETTLED_NS &&
           fabs(plant->speed_rad_s) * ORACLE_RPM_PER_RAD_S < TORQUE_SPEED * oracle->world->machine->speed_base_rpm &&
           (oracle->world->controller == 2 ||
            plant->speed_rad_s > 0.0) && /* one quadrant brakes a rotor that turns back */
           undisturbed(oracle);
}

/* Of the shaft, over whole electrical periods. */
static void look_at_torque(oracle_t *oracle, const plant_t *plant) {
    oracle_torque_t *torque = &oracle->torque;
    if (!torque_follows(oracle, plant)) {
        torque->samples = 0;
        return;
    }
    if (torque->samples == 0) {
        *torque = (oracle_torque_t){.begin_ns = plant->time_ns, .begin_angle_rad = plant->rotor_angle_rad};
    }
    torque->sum_Nm += plant_torque_Nm(plant);
    torque->samples++;
    const double turned_rad = fabs(plant->rotor_angle_rad - torque->begin_angle_rad);
    if (turned_rad < ORACLE_TWO_PI / plant->machine->rotor_poles || plant->time_ns < torque->begin_ns + TORQUE_MIN_NS) {
        return;
    }
    const double mean_Nm = torque->sum_Nm / torque->samples;
    const double wanted_Nm =
        oracle->world->controller == 2 ? oracle->meant.reference : fmax(oracle->meant.reference, 0.0);
    const bool shares = oracle->world->controller == 2;
    const double part = shares ? TORQUE_ERROR_MAX : TORQUE_ERROR_MAX_HYSTERESIS;
    const double part_rated = shares ? TORQUE_ERROR_MAX_RATED : TORQUE_ERROR_MAX_RATED_HYSTERESIS;
    if (fabs(mean_Nm - wanted_Nm) > part * fabs(wanted_Nm) + part_rated * oracle->world->machine->torque_rated_Nm) {
        oracle_violate(oracle, "wrong_torque", plant->time_ns, oracle->world->controller, mean_Nm / wanted_Nm);
    }
    torque->samples = 0;
}

/* Of a speed that is approached from below, before loads end with the faults. */
static void look_at_overshoot(oracle_t *oracle, const plant_t *plant) {
    const world_machine_t *machine = oracle->world->machine;
    const double reference_rad_s = oracle->meant.reference / ORACLE_RPM_PER_RAD_S;
    const bool from_below = oracle->begin_speed_rad_s * reference_rad_s < reference_rad_s * reference_rad_s;
    const bool recovers = oracle->world->recovery_us && plant->time_ns >= oracle->world->recovery_us * 1000;
    if (oracle->drive.state != STATE_RUN || oracle->meant.request != SENDER_RUN || oracle->meant.torque ||
        !from_below || recovers || !undisturbed(oracle) || oracle_overhauled(oracle, plant->speed_rad_s)) {
        return;
    }
    const double base_rad_s = machine->speed_base_rpm / ORACLE_RPM_PER_RAD_S;
    const double over_rad_s = plant->speed_rad_s * (reference_rad_s < 0.0 ? -1.0 : 1.0) - fabs(reference_rad_s);
    const double added_rad_s = oracle->world->controller == 2 ? 0.0 : oracle_added_rad_s(oracle, plant);
    if (over_rad_s > OVERSHOOT_MAX * fabs(reference_rad_s) + OVERSHOOT_MAX_BASE * base_rad_s + added_rad_s) {
        oracle_violate(oracle, "overshoot", plant->time_ns, oracle->world->controller, over_rad_s / base_rad_s);
    }
}

/* A run ended by a request to stop ends at rest; and a drive of four quadrants brakes. */
static void look_at_stop(oracle_t *oracle, const plant_t *plant) {
    const world_machine_t *machine = oracle->world->machine;
    const double least_rad_s =
        STOP_ERROR_MAX_BASE * machine->speed_base_rpm / ORACLE_RPM_PER_RAD_S + STOP_ERROR_MAX_RAD_S;
    const double needed_s = plant->machine->inertia_kg_m2 * oracle->world->inertia_gain *
                            fabs(oracle->stop_speed_rad_s) / (0.5 * machine->torque_max_Nm);
    if (oracle->meant.request == SENDER_STOP && oracle->drive.state == STATE_RUN && oracle->world->controller == 2 &&
        undisturbed(oracle) && !oracle_overhauled(oracle, plant->speed_rad_s) &&
        fabs(plant->speed_rad_s) > least_rad_s &&
        plant->time_ns > oracle->stop_ns + (uint64_t)((STOP_SETTLED_S + needed_s) * 1e9)) {
        oracle_violate(oracle, "not_stopped", plant->time_ns, 0, plant->speed_rad_s / oracle->stop_speed_rad_s);
    }
}

void oracle_look_at_motion(oracle_t *oracle, const plant_t *plant) {
    look_at_torque(oracle, plant);
    look_at_overshoot(oracle, plant);
    look_at_stop(oracle, plant);
}
