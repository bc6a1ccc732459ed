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
#define FOLLOWING_ERROR_MAX 0.02 /* of the reference, */
#define FOLLOWING_ERROR_MAX_QUADRANTS 0.003
#define FOLLOWING_ERROR_MAX_SMC 0.1    /* which hunts with a light rotor, */
#define FOLLOWING_ERROR_MAX_BASE 0.002 /* and of the base speed */
#define FOLLOWING_ERROR_MAX_BASE_QUADRANTS 0.001
#define FOLLOWING_SETTLED_S 0.15 /* after the time that half of the torque limit needs */
#define FOLLOWING_MIN_S 0.05
#define FOLLOWING_SPEED 0.9 /* of the base speed, at most */
#define FOLLOWING_LIMIT 0.8 /* of the largest torque, at least */
#define LOAD_SETTLED_US 250000
#define COARSE_BITS 12
#define COARSE_SPEED 0.05 /* of the base speed */
#define WRONG_WAY_SPEED 0.05
#define WRONG_WAY_TORQUE 0.1 /* of the rated one */
#define LIMIT_PART 1.3
#define LIMIT_MIN_NS (20 * ORACLE_MS_NS)
#define LIMIT_SPEED 0.9 /* of the base speed, at most; with hysteresis TORQUE_SPEED */
#define LIMIT_AGE_MAX_NS (120 * ORACLE_MS_NS)
#define HAND_OVER_PERIODS 128.0 /* of a stroke: with fewer, the BP-PID's hand-over takes most of it, */
#define HAND_OVER_PART 0.5      /* and this part of the torque is judged */

static bool undisturbed(const oracle_t *oracle) {
    return !oracle_any_injected(oracle, 1, FAULT_COUNT - 1) && !oracle->bus_disturbed;
}

/* By heat. */
static bool derated(const oracle_t *oracle) {
    const oracle_telemetry_t *telemetry = &oracle->telemetry;
    const double limit_Nm = fmin(telemetry->limit_Nm.low[0], telemetry->limit_Nm.low[1]);
    return telemetry->limit_ns != 0 && limit_Nm < FOLLOWING_LIMIT * oracle_torque_max_Nm(oracle);
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
           undisturbed(oracle) &&
           !derated(oracle);
}

/* Adds the torque of the shaft. True, with the mean, at the end of an electrical period that is at least so long, after
 * which it begins anew. */
static bool mean_torque(oracle_torque_t *torque, const plant_t *plant, uint64_t min_ns, double *mean_Nm) {
    if (torque->samples == 0) {
        *torque = (oracle_torque_t){.begin_ns = plant->time_ns, .begin_angle_rad = plant->rotor_angle_rad};
    }
    torque->sum_Nm += plant_torque_Nm(plant);
    torque->samples++;
    const double turned_rad = fabs(plant->rotor_angle_rad - torque->begin_angle_rad);
    if (turned_rad < ORACLE_TWO_PI / plant->machine->rotor_poles || plant->time_ns < torque->begin_ns + min_ns) {
        return false;
    }
    *mean_Nm = torque->sum_Nm / torque->samples;
    torque->samples = 0;
    return true;
}

static void look_at_torque(oracle_t *oracle, const plant_t *plant) {
    oracle_torque_t *torque = &oracle->torque;
    if (!torque_follows(oracle, plant)) {
        torque->samples = 0;
        return;
    }
    double mean_Nm;
    if (!mean_torque(torque, plant, TORQUE_MIN_NS, &mean_Nm)) {
        return;
    }
    const double wanted_Nm =
        oracle->world->controller == 2 ? oracle->meant.reference : fmax(oracle->meant.reference, 0.0);
    if (fabs(wanted_Nm) > oracle_torque_max_Nm(oracle)) {
        return;
    }
    const bool shares = oracle->world->controller == 2;
    const double part = shares ? TORQUE_ERROR_MAX : TORQUE_ERROR_MAX_HYSTERESIS;
    const double part_rated = shares ? TORQUE_ERROR_MAX_RATED : TORQUE_ERROR_MAX_RATED_HYSTERESIS;
    if (fabs(mean_Nm - wanted_Nm) > part * fabs(wanted_Nm) + part_rated * oracle->world->machine->torque_rated_Nm) {
        oracle_violate(oracle, "wrong_torque", plant->time_ns, oracle->world->controller, mean_Nm / wanted_Nm);
    }
}

/* Of a speed that is approached from below, before loads end with the faults. */
static void look_at_overshoot(oracle_t *oracle, const plant_t *plant) {
    const world_machine_t *machine = oracle->world->machine;
    const double reference_rad_s = oracle->meant.reference / ORACLE_RPM_PER_RAD_S;
    const bool from_below = oracle->begin_speed_rad_s * reference_rad_s < reference_rad_s * reference_rad_s;
    const bool recovers = oracle->world->recovery_us && plant->time_ns >= oracle->world->recovery_us * 1000;
    if (oracle->drive.state != STATE_RUN || oracle->meant.request != SENDER_RUN || oracle->meant.torque ||
        !oracle_can_turn(oracle) || !from_below || recovers || !undisturbed(oracle) ||
        oracle_overhauled(oracle, plant->speed_rad_s)) {
        return;
    }
    const double base_rad_s = machine->speed_base_rpm / ORACLE_RPM_PER_RAD_S;
    const double over_rad_s = plant->speed_rad_s * (reference_rad_s < 0.0 ? -1.0 : 1.0) - fabs(reference_rad_s);
    const double added_rad_s = oracle->world->controller == 2 ? 0.0 : oracle_added_rad_s(oracle, plant);
    if (over_rad_s > OVERSHOOT_MAX * fabs(reference_rad_s) + OVERSHOOT_MAX_BASE * base_rad_s + added_rad_s) {
        oracle_violate(oracle, "overshoot", plant->time_ns, oracle->world->controller, over_rad_s / base_rad_s);
    }
}

/* A run ended by a request to stop becomes no faster, and ends at rest; and a drive of four quadrants brakes, while it
 * hears that request: without it the torque ramps to zero and the rotor coasts. */
static void look_at_stop(oracle_t *oracle, const plant_t *plant) {
    const world_machine_t *machine = oracle->world->machine;
    const double base_rad_s = machine->speed_base_rpm / ORACLE_RPM_PER_RAD_S;
    const bool stops = oracle->meant.request == SENDER_STOP && oracle->drive.state == STATE_RUN &&
                       undisturbed(oracle) && !oracle_overhauled(oracle, plant->speed_rad_s);
    if (stops && fabs(plant->speed_rad_s) > fabs(oracle->stop_speed_rad_s) + OVERSHOOT_MAX_BASE * base_rad_s +
                                                oracle_added_rad_s(oracle, plant)) {
        oracle_violate(oracle, "not_stopped", plant->time_ns, 1, plant->speed_rad_s / oracle->stop_speed_rad_s);
    }
    const double least_rad_s = STOP_ERROR_MAX_BASE * base_rad_s + STOP_ERROR_MAX_RAD_S;
    const double needed_s = plant->machine->inertia_kg_m2 * oracle->world->inertia_gain *
                            fabs(oracle->stop_speed_rad_s) / (0.5 * oracle_torque_max_Nm(oracle));
    if (stops && oracle->world->controller == 2 && !derated(oracle) && fabs(plant->speed_rad_s) > least_rad_s &&
        plant->time_ns < oracle->run_ns + TORQUE_SETTLED_NS &&
        plant->time_ns > oracle->stop_ns + (uint64_t)((STOP_SETTLED_S + needed_s) * 1e9)) {
        oracle_violate(oracle, "not_stopped", plant->time_ns, 0, plant->speed_rad_s / oracle->stop_speed_rad_s);
    }
}

/* No sine, and no step or ramp a short time ago. */
static bool load_is_constant(const oracle_t *oracle, uint64_t now_us) {
    for (unsigned i = 0; i < oracle->world->events; i++) {
        const world_event_t *event = world_begun(oracle->world, i, now_us);
        if (event == NULL) {
            continue;
        }
        const uint64_t last_us = event->end_us != 0 && event->end_us <= now_us ? event->end_us : event->begin_us;
        if (oracle_is_load_sine(event) || (oracle_is_load(event) && now_us < last_us + LOAD_SETTLED_US)) {
            return false;
        }
    }
    return true;
}

/* A constant speed that nothing keeps the drive from. */
static bool speed_follows(const oracle_t *oracle, const plant_t *plant) {
    const world_machine_t *machine = oracle->world->machine;
    const double reference_rpm = fabs(oracle->meant.reference), base_rpm = machine->speed_base_rpm;
    const double change_rad_s = reference_rpm / ORACLE_RPM_PER_RAD_S + fabs(oracle->begin_speed_rad_s);
    const double needed_s = plant->machine->inertia_kg_m2 * oracle->world->inertia_gain * change_rad_s /
                            (0.5 * oracle_torque_max_Nm(oracle));
    const uint64_t since_ns = oracle->constant_ns > oracle->state_ns ? oracle->constant_ns : oracle->state_ns;
    const bool coarse = oracle->world->encoder_bits < COARSE_BITS && reference_rpm < COARSE_SPEED * base_rpm;
    return oracle->drive.state == STATE_RUN && oracle->meant.request == SENDER_RUN && !oracle->meant.torque &&
           oracle_can_turn(oracle) && undisturbed(oracle) && !coarse && !derated(oracle) &&
           plant->time_ns < oracle->run_ns + TORQUE_SETTLED_NS &&
           plant->time_ns > since_ns + (uint64_t)((FOLLOWING_SETTLED_S + needed_s) * 1e9) &&
           reference_rpm <= FOLLOWING_SPEED * base_rpm && !oracle_overhauled(oracle, plant->speed_rad_s) &&
           load_is_constant(oracle, plant->time_ns / 1000);
}

static void look_at_speed(oracle_t *oracle, const plant_t *plant) {
    oracle_speed_t *speed = &oracle->speed;
    if (!speed_follows(oracle, plant)) {
        speed->begin_ns = 0;
        return;
    }
    if (speed->begin_ns == 0) {
        *speed = (oracle_speed_t){plant->time_ns, plant->rotor_angle_rad};
    }
    const double time_s = (double)(plant->time_ns - speed->begin_ns) * 1e-9;
    const double turned_rad = plant->rotor_angle_rad - speed->begin_angle_rad;
    const double reference_rad_s = oracle->meant.reference / ORACLE_RPM_PER_RAD_S;
    if (time_s < FOLLOWING_MIN_S || time_s * fabs(reference_rad_s) < ORACLE_TWO_PI) {
        return;
    }
    const bool quadrants = oracle->world->controller == 2;
    const double part = quadrants                        ? FOLLOWING_ERROR_MAX_QUADRANTS
                        : oracle->world->controller == 1 ? FOLLOWING_ERROR_MAX_SMC
                                                         : FOLLOWING_ERROR_MAX;
    const double part_base = quadrants ? FOLLOWING_ERROR_MAX_BASE_QUADRANTS : FOLLOWING_ERROR_MAX_BASE;
    const double base_rad_s = oracle->world->machine->speed_base_rpm / ORACLE_RPM_PER_RAD_S;
    const double count_rad_s = ldexp(ORACLE_TWO_PI, -(int)oracle->world->encoder_bits) / time_s;
    const double most_rad_s = part * fabs(reference_rad_s) + part_base * base_rad_s + count_rad_s;
    const double error_rad_s = turned_rad / time_s - reference_rad_s;
    if (quadrants ? fabs(error_rad_s) > most_rad_s : error_rad_s < -most_rad_s) {
        oracle_violate(oracle, "not_following", plant->time_ns, oracle->world->controller,
                       turned_rad / time_s / reference_rad_s);
    }
    speed->begin_ns = 0;
}

/* A drive of one quadrant does not drive forwards because a speed backwards is commanded. */
static void look_at_direction(oracle_t *oracle, const plant_t *plant) {
    const world_machine_t *machine = oracle->world->machine;
    const bool forwards = plant->speed_rad_s * ORACLE_RPM_PER_RAD_S > WRONG_WAY_SPEED * machine->speed_base_rpm &&
                          plant_torque_Nm(plant) > WRONG_WAY_TORQUE * machine->torque_rated_Nm;
    oracle_since(&oracle->forwards_ns,
                 forwards && oracle->drive.state == STATE_RUN && oracle->meant.request == SENDER_RUN &&
                     !oracle->meant.torque && !oracle_can_turn(oracle) && undisturbed(oracle) &&
                     plant->time_ns > oracle->constant_ns + TORQUE_SETTLED_NS,
                 plant->time_ns);
    if (oracle->forwards_ns != 0 && plant->time_ns > oracle->forwards_ns + TORQUE_SETTLED_NS) {
        oracle_violate(oracle, "wrong_way", plant->time_ns, oracle->world->controller, plant_torque_Nm(plant));
    }
}

/* Measured by healthy sensors, with a healthy memory. */
static bool torque_is_known(const oracle_t *oracle) {
    return !oracle_any_injected(oracle, FAULT_WINDING_OPEN, FAULT_ENCODER_NO_ANSWER) &&
           !oracle_any_injected(oracle, FAULT_INTERRUPT_LOST, FAULT_INTERRUPT_STORM) &&
           !oracle_any_injected(oracle, FAULT_LIMIT_FLIPPED, FAULT_CLOCK_DRIFT) && !oracle->bus_disturbed;
}

/* Single pulses near base speed take some electrical periods until their mean is that of the reference. */
void oracle_judge_limit(oracle_t *oracle, uint64_t time_ns, double mean_Nm, double limit_Nm) {
    const bool shares = oracle->world->controller == 2;
    if (mean_Nm > LIMIT_PART * limit_Nm + (shares ? 0.05 : 0.1) * oracle->world->machine->torque_rated_Nm) {
        oracle_violate(oracle, "above_limit", time_ns, oracle->world->controller, mean_Nm / limit_Nm);
    }
}

/* The BP-PID of `paper` takes tens of periods to open the outgoing phase. Meanwhile the incoming one keeps the current
 * for the hand-over angle, which further on may alone make more than the reference. */
static bool hands_over_long(const oracle_t *oracle, const plant_t *plant) {
    const double stroke_rad = oracle_stroke_rad(plant);
    const double period_rad = fabs(plant->speed_rad_s) * (double)oracle->period_ns * 1e-9;
    return oracle->world->controller == 1 && HAND_OVER_PERIODS * period_rad > stroke_rad;
}

/* The torque keeps to the limit that the client has set, and to that which telemetry announces before or after. */
static void look_at_torque_limit(oracle_t *oracle, const plant_t *plant) {
    oracle_torque_t *torque = &oracle->any_torque;
    const oracle_telemetry_t *telemetry = &oracle->telemetry;
    const double most = oracle->world->controller == 2 ? LIMIT_SPEED : TORQUE_SPEED;
    if (oracle->drive.state != STATE_RUN || !torque_is_known(oracle) || telemetry->limit_ns <= oracle->reset_ns ||
        plant->time_ns > telemetry->limit_ns + LIMIT_AGE_MAX_NS ||
        fabs(plant->speed_rad_s) * ORACLE_RPM_PER_RAD_S > most * oracle->world->machine->speed_base_rpm) {
        torque->samples = 0;
        return;
    }
    double mean_Nm;
    if (!mean_torque(torque, plant, LIMIT_MIN_NS, &mean_Nm)) {
        return;
    }
    mean_Nm = (hands_over_long(oracle, plant) ? HAND_OVER_PART : 1.0) * fabs(mean_Nm);
    oracle->mean_torque_Nm = fmax(oracle->mean_torque_Nm, mean_Nm);
    if (oracle_sets_in_effect(oracle)) {
        oracle_judge_limit(oracle, plant->time_ns, mean_Nm, oracle_torque_max_Nm(oracle));
    }
}

void oracle_look_at_motion(oracle_t *oracle, const plant_t *plant) {
    look_at_speed(oracle, plant);
    look_at_direction(oracle, plant);
    look_at_torque_limit(oracle, plant);
    look_at_torque(oracle, plant);
    look_at_overshoot(oracle, plant);
    look_at_stop(oracle, plant);
}
