/* Measurements on the bus against what the drive has measured, and against the plant. */
#include "campaign/oracle_parts.h"

#include <math.h>

#include "bench_variables.h"
#include "drive_codec.h"
#include "fault_kinds.h"

#define WINDOW_NS (2 * ORACLE_MS_NS) /* a frame is younger than that */
#define SETTLED_NS (100 * ORACLE_MS_NS)
#define SNAPSHOT_NS (30 * ORACLE_MS_NS) /* until the first snapshot after a fault may be an earlier one's */
#define ERROR_MAX 0.001                 /* of the full scale */
#define SPEED_ERROR_MAX 0.1             /* of the speed, which the drive observes, */
#define SPEED_ERROR_MAX_BASE 0.05       /* and of the base speed, */
#define COUNT_RATE_1_S 500.0            /* and half a count in a millisecond */

/* Default parameters, and the error of a torque limit: heat changes between two readings of it. */
#define WINDING_LIMIT_C 155.0
#define INVERTER_LIMIT_C 100.0
#define DERATING_K 20.0
#define DERATING_ERROR_MAX 0.12
#define SET_LIMIT_ERROR_MAX 1.03 /* of the limit that the client has set, which a frame rounds */
#define LIMIT_WINDOW_NS (50 * ORACLE_MS_NS)

/* Means of the torque in frames, which meet its ripple anywhere. */
#define TORQUE_FRAMES 25
#define TORQUE_PERIODS 2.0
#define TORQUE_SPEED 0.5 /* of the base speed, at most */
#define TORQUE_ERROR_MAX 0.3
#define TORQUE_ERROR_MAX_RATED 0.15

/* Of drive.dbc. */
enum { OPERATION_SET_CONTROL = 12, STATUS_DONE = 0, STEP_APPLY = 2, STEP_SAVE = 4 };

static void widen(oracle_range_t *range, double value, bool renew) {
    if (renew) {
        range->low[1] = range->low[0];
        range->high[1] = range->high[0];
        range->low[0] = range->high[0] = value;
    }
    range->low[0] = fmin(range->low[0], value);
    range->high[0] = fmax(range->high[0], value);
}

static bool is_within(const oracle_range_t *range, double value, double error) {
    return value >= fmin(range->low[0], range->low[1]) - error && value <= fmax(range->high[0], range->high[1]) + error;
}

/* Only in a run that nothing disturbs. */
static void follow_torque(oracle_t *oracle, const plant_t *plant) {
    oracle_torque_telemetry_t *torque = &oracle->telemetry.torque;
    oracle->telemetry.angle_rad = plant->rotor_angle_rad;
    const bool known =
        oracle->drive.state == STATE_RUN && plant->time_ns > oracle->state_ns + SETTLED_NS &&
        !oracle_any_injected(oracle, 1, FAULT_COUNT - 1) && !oracle->bus_disturbed &&
        fabs(plant->speed_rad_s) * ORACLE_RPM_PER_RAD_S < TORQUE_SPEED * oracle->world->machine->speed_base_rpm;
    if (!known || torque->frames == 0) {
        *torque = (oracle_torque_telemetry_t){.begin_angle_rad = plant->rotor_angle_rad};
    }
    if (known) {
        const double torque_Nm = plant_torque_Nm(plant);
        torque->least_Nm = torque->samples ? fmin(torque->least_Nm, torque_Nm) : torque_Nm;
        torque->most_Nm = torque->samples ? fmax(torque->most_Nm, torque_Nm) : torque_Nm;
        torque->true_sum_Nm += torque_Nm;
        torque->samples++;
    }
}

void oracle_remember_measurement(oracle_t *oracle, const plant_t *plant) {
    oracle_telemetry_t *telemetry = &oracle->telemetry;
    const bool renew = plant->time_ns >= telemetry->window_ns + WINDOW_NS;
    telemetry->window_ns = renew ? plant->time_ns : telemetry->window_ns;
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        widen(&telemetry->current[phase], oracle->drive.current[phase], renew);
    }
    widen(&telemetry->link_voltage, oracle->drive.link_voltage, renew);
    widen(&telemetry->speed_rad_s, plant->speed_rad_s, renew);
    follow_torque(oracle, plant);
}

void oracle_remember_fault(oracle_t *oracle, const plant_t *plant) {
    oracle_telemetry_t *telemetry = &oracle->telemetry;
    telemetry->fault_speed_rad_s = plant->speed_rad_s;
    telemetry->fault_link_voltage = oracle->drive.link_voltage;
    telemetry->fault_current = 0.0;
    for (unsigned phase = 0; phase < plant->machine->phases; phase++) {
        telemetry->fault_current = fmax(telemetry->fault_current, oracle->drive.current[phase]);
    }
}

static double unsigned_16(const uint8_t *data) {
    return data[0] | data[1] << 8;
}

static double signed_16(const uint8_t *data) {
    return (int16_t)(uint16_t)(data[0] | data[1] << 8);
}

static double signed_24(const uint8_t *data) {
    return (int32_t)((uint32_t)(data[0] | data[1] << 8 | data[2] << 16) ^ 0x800000u) - 0x800000;
}

static void judge(oracle_t *oracle, bool holds, uint64_t time_ns, unsigned number, double value) {
    if (!holds) {
        oracle_violate(oracle, "wrong_telemetry", time_ns, number, value);
    }
}

/* A shaft that is stopped at once stands before the drive observes it; and the observer goes by the torque of the
 * measured currents. */
static bool observes_speed(const oracle_t *oracle) {
    return !oracle_encoder_faulty(oracle) &&
           !oracle_any_injected(oracle, FAULT_CURRENT_SENSOR_OPEN, FAULT_CURRENT_SENSOR_SWAPPED) &&
           !oracle_any_injected(oracle, FAULT_SHAFT_LOCKED, FAULT_LOAD_DROPPED) &&
           !oracle_any_injected(oracle, FAULT_LIMIT_FLIPPED, FAULT_CLOCK_DRIFT);
}

static void judge_snapshot(oracle_t *oracle, uint64_t time_ns, const uint8_t data[8]) {
    const oracle_telemetry_t *telemetry = &oracle->telemetry;
    const world_machine_t *machine = oracle->world->machine;
    const sensor_ranges_t *ranges = &machine->image.machine.ranges;
    if (oracle->drive.state != STATE_FAULT || time_ns < oracle->latched_ns + SNAPSHOT_NS ||
        oracle->reset_ns > oracle->latched_ns || oracle_state_changed(oracle)) {
        return;
    }
    const double true_rpm = telemetry->fault_speed_rad_s * ORACLE_RPM_PER_RAD_S;
    const double rpm = signed_16(data) * 250.0 * machine->command_lsb_rpm;
    const double error_rpm = 2.0 * (SPEED_ERROR_MAX * fabs(true_rpm) + SPEED_ERROR_MAX_BASE * machine->speed_base_rpm);
    judge(oracle, !observes_speed(oracle) || !telemetry->ran || fabs(rpm - true_rpm) <= error_rpm, time_ns, 16, rpm);
    const double link = unsigned_16(data + 2) * machine->voltage_lsb_V / ranges->dc_link_V;
    judge(oracle, fabs(link - telemetry->fault_link_voltage) <= ERROR_MAX, time_ns, 17, link);
    const double current = unsigned_16(data + 4) * machine->current_lsb_A / ranges->current_A;
    judge(oracle, fabs(current - telemetry->fault_current) <= ERROR_MAX, time_ns, 18, current);
}

double oracle_cool_part(double winding_C, double switch_C) {
    const double room = fmin(WINDING_LIMIT_C - winding_C, INVERTER_LIMIT_C - switch_C) / DERATING_K;
    return fmin(fmax(room, 0.0), 1.0);
}

/* The torque that heat leaves, by what the drive says of itself. */
static void judge_thermal(oracle_t *oracle, uint64_t time_ns, const uint8_t data[8]) {
    const double most_Nm = oracle->world->machine->torque_max_Nm;
    const double load_percent = 0.01 * fmax(unsigned_16(data), unsigned_16(data + 2));
    const double room = fmin(fmax((100.0 - load_percent) / 10.0, 0.0), oracle_cool_part(data[6], data[7]));
    const double limit_Nm = signed_16(data + 4) * 256.0 * oracle->world->machine->command_lsb_Nm;
    oracle_telemetry_t *telemetry = &oracle->telemetry;
    const bool renew = time_ns >= telemetry->limit_window_ns + LIMIT_WINDOW_NS;
    telemetry->limit_window_ns = renew ? time_ns : telemetry->limit_window_ns;
    telemetry->limit_ns = time_ns;
    widen(&telemetry->limit_Nm, limit_Nm, renew);
    const double mean_Nm = oracle->mean_torque_Nm;
    oracle->mean_torque_Nm = 0.0;
    if (oracle_any_injected(oracle, FAULT_LIMIT_FLIPPED, FAULT_CLOCK_DRIFT)) {
        return; /* by a constant that has changed the limit may be any, also a negative one */
    }
    oracle_judge_limit(oracle, time_ns, mean_Nm, fmax(telemetry->limit_Nm.high[0], telemetry->limit_Nm.high[1]));
    if (oracle_sets_in_effect(oracle) && time_ns > oracle->applied_ns + SETTLED_NS &&
        limit_Nm > SET_LIMIT_ERROR_MAX * oracle_torque_max_Nm(oracle)) {
        oracle_violate(oracle, "above_limit", time_ns, 3, limit_Nm / oracle_torque_max_Nm(oracle));
    }
    if (limit_Nm > most_Nm * (room + DERATING_ERROR_MAX)) {
        oracle_violate(oracle, "not_derated", time_ns, 0, limit_Nm / most_Nm);
    }
}

/* Sets that are in effect, and a set of parameters whose check is wrong. */
static void judge_set(oracle_t *oracle, uint64_t time_ns, const uint8_t data[8]) {
    const bool done = data[0] == OPERATION_SET_CONTROL && data[3] == STATUS_DONE;
    const bool applies = done && data[4] == STEP_APPLY;
    oracle->applied += applies;
    oracle->applied_ns = applies ? time_ns : oracle->applied_ns;
    oracle->saved_ns = done && data[4] == STEP_SAVE ? time_ns : oracle->saved_ns;
    for (unsigned i = 0; i < oracle->world->events; i++) {
        const world_event_t *event = world_begun(oracle->world, i, UINT64_MAX);
        if (event != NULL && event->kind == WORLD_DEGRADED && event->what == WORLD_DEGRADED_WRONG_CHECK && applies &&
            !(oracle->limited != NULL && oracle->applied == 1)) {
            oracle_violate(oracle, "applied", time_ns, 0, 0.0);
        }
    }
}

/* A frame of the torque; and each interrupt the true one. */
static void judge_torque(oracle_t *oracle, uint64_t time_ns, double estimate_Nm) {
    oracle_torque_telemetry_t *torque = &oracle->telemetry.torque;
    torque->estimate_sum_Nm += estimate_Nm;
    torque->frames++;
    const double turned_rad = fabs(oracle->telemetry.angle_rad - torque->begin_angle_rad);
    const double pitch_rad = ORACLE_TWO_PI / oracle->world->machine->image.machine.rotor_poles;
    if (torque->frames < TORQUE_FRAMES || torque->samples == 0 || turned_rad < TORQUE_PERIODS * pitch_rad) {
        return;
    }
    const double mean_Nm = torque->estimate_sum_Nm / torque->frames, true_Nm = torque->true_sum_Nm / torque->samples;
    const double error_Nm =
        TORQUE_ERROR_MAX * fabs(true_Nm) + TORQUE_ERROR_MAX_RATED * oracle->world->machine->torque_rated_Nm;
    const bool shares = oracle->world->controller == 2; /* with hysteresis frames may all meet the same torque */
    const double least_Nm = shares ? true_Nm : torque->least_Nm, most_Nm = shares ? true_Nm : torque->most_Nm;
    judge(oracle, mean_Nm >= least_Nm - error_Nm && mean_Nm <= most_Nm + error_Nm, time_ns, 10, mean_Nm / true_Nm);
    torque->frames = 0;
}

void oracle_on_telemetry(oracle_t *oracle, uint64_t time_ns, unsigned identifier, const uint8_t data[8]) {
    const oracle_telemetry_t *telemetry = &oracle->telemetry;
    const world_machine_t *machine = oracle->world->machine;
    const sensor_ranges_t *ranges = &machine->image.machine.ranges;
    if (identifier == DRIVE_PARAMETER_RESPONSE_FRAME_ID) {
        judge_set(oracle, time_ns, data);
        return;
    }
    if (oracle->bus_disturbed || oracle_any_injected(oracle, FAULT_INTERRUPT_LOST, FAULT_INTERRUPT_STORM) ||
        oracle_any_injected(oracle, FAULT_CLOCK_DRIFT, FAULT_CLOCK_DRIFT) ||
        oracle_variable_begun(oracle, BENCH_VARIABLE_INTERRUPT_TIME_US, time_ns / 1000) ||
        time_ns < oracle->reset_ns + SNAPSHOT_NS) {
        return; /* frames may be older */
    }
    switch (identifier) {
    case DRIVE_CURRENTS_FRAME_ID:
        for (unsigned phase = 0; phase < machine->image.machine.phases; phase++) {
            const double current = unsigned_16(data + (size_t)2 * phase) * machine->current_lsb_A / ranges->current_A;
            judge(oracle, is_within(&telemetry->current[phase], current, ERROR_MAX), time_ns, phase, current);
        }
        break;
    case DRIVE_TORQUE_FRAME_ID: {
        const double link = unsigned_16(data + 6) * machine->voltage_lsb_V / ranges->dc_link_V;
        judge(oracle, is_within(&telemetry->link_voltage, link, ERROR_MAX), time_ns, 8, link);
        judge_torque(oracle, time_ns, signed_16(data + 2) * 256.0 * machine->command_lsb_Nm);
        break;
    }
    case DRIVE_MOTION_FRAME_ID: {
        const double rad_s = signed_24(data) * machine->command_lsb_rpm / ORACLE_RPM_PER_RAD_S;
        const double base_rad_s = machine->speed_base_rpm / ORACLE_RPM_PER_RAD_S;
        const double count_rad_s = ldexp(ORACLE_TWO_PI, -(int)oracle->world->encoder_bits) * COUNT_RATE_1_S;
        const bool settled = oracle->drive.state == STATE_RUN && time_ns > oracle->state_ns + SETTLED_NS;
        judge(oracle,
              !settled || !observes_speed(oracle) ||
                  is_within(&telemetry->speed_rad_s, rad_s,
                            SPEED_ERROR_MAX * fabs(rad_s) + SPEED_ERROR_MAX_BASE * base_rad_s + count_rad_s),
              time_ns, 9, rad_s);
        break;
    }
    case DRIVE_FAULT_SNAPSHOT_FRAME_ID:
        judge_snapshot(oracle, time_ns, data);
        break;
    case DRIVE_THERMAL_FRAME_ID:
        judge_thermal(oracle, time_ns, data);
        break;
    default:
        break;
    }
}
