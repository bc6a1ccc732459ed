#include "comms/canopen_demand.h"

#include "comms/canopen_position.h"
#include "comms/canopen_units.h"
#include "comms/units.h"
#include "control/machine_tables.h"
#include "fixed/compiler.h"
#include "fixed/divide.h"
#include "fixed/fixed.h"

#define HALT 0x0100u
#define HALT_FAST 2
#define BITS 16
#define US_PER_MS 1000u
#define MILLI 1000
#define LONG_US 100000000u /* windows are shorter */

/* 2^16 / 10^6, Q20. */
#define Q16_PER_US_Q20 INT64_C(68719)

static bool is_torque(unsigned mode) {
    return mode == CANOPEN_MODE_TORQUE || mode == CANOPEN_MODE_CYCLIC_TORQUE || mode == CANOPEN_MODE_NONE;
}

/* Bit of a mode in 0x6502. */
#define MODE(mode) (1 << ((mode)-1))

COLD int32_t canopen_demand_modes(const canopen_t *canopen) {
    const int32_t modes = MODE(CANOPEN_MODE_VELOCITY) | MODE(CANOPEN_MODE_TORQUE) | MODE(CANOPEN_MODE_CYCLIC_VELOCITY) |
                          MODE(CANOPEN_MODE_CYCLIC_TORQUE);
    const int32_t position =
        MODE(CANOPEN_MODE_POSITION) | MODE(CANOPEN_MODE_HOMING) | MODE(CANOPEN_MODE_CYCLIC_POSITION);
    return canopen->measured.has_position ? modes | position : modes;
}

COLD bool canopen_demand_has_mode(const canopen_t *canopen, int32_t mode) {
    return mode == CANOPEN_MODE_NONE ||
           (mode > 0 && mode <= CANOPEN_MODE_CYCLIC_TORQUE && (canopen_demand_modes(canopen) & MODE(mode)) != 0);
}

static bool is_cyclic(unsigned mode) {
    return mode == CANOPEN_MODE_CYCLIC_VELOCITY || mode == CANOPEN_MODE_CYCLIC_TORQUE;
}

static int32_t demand_of(const canopen_drive_t *drive) {
    return fixed_saturate(fixed_shift(drive->demand_q16, BITS));
}

static int64_t q16(int32_t milli) {
    return (int64_t)milli * (INT64_C(1) << BITS);
}

static int32_t present_speed(const canopen_t *canopen) {
    return canopen_speed_of_machine(canopen->measured.speed);
}

static int32_t torque_target(const canopen_t *canopen) {
    return canopen->values[CANOPEN_VALUE_TARGET_TORQUE] * MILLI; /* of 16 bits */
}

static void aim(canopen_t *canopen) {
    canopen_drive_t *drive = &canopen->drive;
    drive->target = drive->torque ? torque_target(canopen)
                                  : canopen_velocity_milli(canopen, canopen->values[CANOPEN_VALUE_TARGET_VELOCITY]);
    drive->left_us = (uint32_t)canopen->values[CANOPEN_VALUE_INTERPOLATION] * US_PER_MS;
}

COLD void canopen_demand_begin(canopen_t *canopen) {
    canopen_drive_t *drive = &canopen->drive;
    drive->mode = (uint8_t)canopen->values[CANOPEN_VALUE_MODE];
    drive->torque = is_torque(drive->mode);
    drive->position = canopen_position_is(drive->mode);
    drive->demand_q16 =
        q16(drive->torque ? canopen_torque_of_q8(canopen->measured.reference_q8) * MILLI : present_speed(canopen));
    drive->at_rest = false;
    drive->within_us = 0;
    aim(canopen);
    if (drive->position) {
        canopen_position_begin(canopen);
    }
}

COLD void canopen_demand_stop(canopen_t *canopen) {
    canopen_drive_t *drive = &canopen->drive;
    const int64_t present = q16(present_speed(canopen));
    const bool ahead = present > 0 ? drive->demand_q16 > present || drive->demand_q16 < 0
                                   : drive->demand_q16 < present || drive->demand_q16 > 0;
    if (drive->torque || drive->position || ahead) { /* a demand ahead of the rotor would go on to accelerate it */
        drive->torque = drive->position = false;
        drive->demand_q16 = present;
    }
    drive->at_rest = false;
}

COLD void canopen_demand_target(canopen_t *canopen, unsigned slot) {
    const bool torque = canopen->drive.torque;
    if (slot == (torque ? CANOPEN_VALUE_TARGET_TORQUE : CANOPEN_VALUE_TARGET_VELOCITY)) {
        aim(canopen);
    } else if (slot == CANOPEN_VALUE_TARGET_POSITION) {
        canopen_position_target(canopen);
    }
}

COLD bool canopen_demand_rests(const canopen_t *canopen, uint32_t time_us) {
    const canopen_drive_t *drive = &canopen->drive;
    return drive->at_rest && (drive->slow_us > 0 || time_us - drive->stopped_us > CANOPEN_STANDSTILL_MAX_US);
}

/* Moves the demand towards a target by a rate in 0.001 of a unit per second, at most 2^30. */
static void ramp(canopen_drive_t *drive, int32_t target, int32_t rate, uint32_t elapsed_us) {
    const int64_t most = fixed_shift((int64_t)rate * elapsed_us * Q16_PER_US_Q20, 20) + 1;
    const int64_t missing = q16(target) - drive->demand_q16;
    drive->demand_q16 += fixed_clamp_64(missing, -most, most);
}

static void interpolate(canopen_drive_t *drive, uint32_t elapsed_us) {
    if (drive->left_us <= elapsed_us) {
        drive->left_us = 0;
        drive->demand_q16 = q16(drive->target);
        return;
    }
    const int64_t missing = q16(drive->target) - drive->demand_q16; /* below 2^49, of time 2^13 */
    drive->demand_q16 += fixed_divide(missing * elapsed_us, drive->left_us);
    drive->left_us -= elapsed_us;
}

static void step_velocity(canopen_t *canopen, uint32_t elapsed_us, bool halted) {
    canopen_drive_t *drive = &canopen->drive;
    const bool stops = drive->stopping || halted;
    const bool fast = drive->stopping ? drive->fast : canopen->values[CANOPEN_VALUE_HALT_OPTION] == HALT_FAST;
    if (is_cyclic(drive->mode) && !stops) {
        interpolate(drive, elapsed_us);
        return;
    }
    const int32_t target = stops ? 0 : canopen_velocity_milli(canopen, canopen->values[CANOPEN_VALUE_TARGET_VELOCITY]);
    const int32_t present = demand_of(drive);
    const bool slower = fixed_magnitude(target) < fixed_magnitude(present) || (target < 0) != (present < 0);
    const unsigned rate = stops && fast ? CANOPEN_VALUE_QUICK_STOP_DECELERATION
                          : slower      ? CANOPEN_VALUE_DECELERATION
                                        : CANOPEN_VALUE_ACCELERATION;
    ramp(drive, target, canopen_acceleration_milli(canopen, canopen->values[rate]), elapsed_us);
}

static void step_torque(canopen_t *canopen, uint32_t elapsed_us, bool halted) {
    canopen_drive_t *drive = &canopen->drive;
    if (drive->mode == CANOPEN_MODE_CYCLIC_TORQUE && !halted) {
        interpolate(drive, elapsed_us);
        return;
    }
    const int32_t target = halted || drive->mode == CANOPEN_MODE_NONE ? 0 : torque_target(canopen);
    ramp(drive, target, fixed_clamp(canopen->values[CANOPEN_VALUE_TORQUE_SLOPE], 1, MILLI * MILLI) * MILLI, elapsed_us);
}

static uint32_t longer(uint32_t time_us, uint32_t elapsed_us, bool holds) {
    return holds ? fixed_min_u32(time_us + elapsed_us, LONG_US) : 0;
}

/* Times for which velocity or position is within the window of the profile, and the velocity below the threshold. */
static void watch(canopen_t *canopen, uint32_t elapsed_us, bool halted) {
    canopen_drive_t *drive = &canopen->drive;
    const int32_t velocity = canopen_velocity(canopen, present_speed(canopen));
    const int32_t target = halted || drive->stopping ? 0 : canopen->values[CANOPEN_VALUE_TARGET_VELOCITY];
    const uint32_t away = fixed_magnitude(fixed_subtract(velocity, target));
    const bool within = drive->position ? canopen_position_within(canopen)
                                        : away <= (uint32_t)canopen->values[CANOPEN_VALUE_VELOCITY_WINDOW];
    drive->within_us = longer(drive->within_us, elapsed_us, within);
    drive->slow_us = longer(drive->slow_us, elapsed_us,
                            fixed_magnitude(velocity) <= (uint32_t)canopen->values[CANOPEN_VALUE_VELOCITY_THRESHOLD]);
}

static bool is_halted(const canopen_t *canopen) {
    return ((uint32_t)canopen->values[CANOPEN_VALUE_CONTROLWORD] & HALT) != 0;
}

COLD void canopen_demand_step(canopen_t *canopen, uint32_t time_us) {
    canopen_drive_t *drive = &canopen->drive;
    const uint32_t elapsed_us = fixed_min_u32(time_us - drive->step_us, CANOPEN_STEP_MAX_US);
    drive->step_us = time_us;
    watch(canopen, elapsed_us, is_halted(canopen));
    if (!canopen_enabled(canopen)) {
        drive->mode = (uint8_t)canopen->values[CANOPEN_VALUE_MODE];
        drive->demand_q16 = 0;
        drive->limited = drive->position = false;
        return;
    }
    if (!drive->stopping && drive->mode != canopen->values[CANOPEN_VALUE_MODE]) {
        canopen_demand_begin(canopen);
    }
    if (drive->position) {
        canopen_position_step(canopen, elapsed_us, is_halted(canopen));
    } else if (drive->torque) {
        step_torque(canopen, elapsed_us, is_halted(canopen));
    } else {
        step_velocity(canopen, elapsed_us, is_halted(canopen));
    }
    if (drive->stopping && !drive->at_rest && demand_of(drive) == 0) {
        drive->at_rest = true;
        drive->stopped_us = time_us;
    }
}

COLD void canopen_demand_command(canopen_t *canopen, command_t *command) {
    canopen_drive_t *drive = &canopen->drive;
    const int32_t demand = demand_of(drive);
    if (drive->position) {
        command->mode = DRIVE_MODE_POSITION; /* its speed reference is 0 */
        canopen_position_command(canopen, is_halted(canopen), &command->position);
        drive->limited = canopen->place.limited;
        return;
    }
    if (drive->torque) {
        command->mode = DRIVE_MODE_TORQUE;
        command->torque_reference_q24 = canopen_torque_q24(demand);
        drive->limited = false;
        return;
    }
    const int32_t most = machine_tables.speed_reference_max, wanted = canopen_machine_speed(demand);
    const int32_t within = fixed_clamp(wanted, -most, most);
    drive->limited = within != wanted;
    command->mode = DRIVE_MODE_SPEED;
    command->speed_reference_q22 = units_speed_q22(within);
}

COLD int32_t canopen_demand_velocity(const canopen_t *canopen) {
    const canopen_drive_t *drive = &canopen->drive;
    return drive->position ? canopen_speed_of_machine(units_milli_rpm(canopen->place.speed_reference_q22))
           : drive->torque ? 0
                           : demand_of(drive);
}

COLD bool canopen_demand_reached(const canopen_t *canopen) {
    const canopen_drive_t *drive = &canopen->drive;
    if (drive->state != CANOPEN_OPERATION_ENABLED) {
        return drive->state == CANOPEN_QUICK_STOP_ACTIVE && drive->at_rest;
    }
    if (drive->position) {
        return canopen_position_reached(canopen, is_halted(canopen));
    }
    if (drive->mode == CANOPEN_MODE_TORQUE && drive->torque) {
        return demand_of(drive) == (is_halted(canopen) ? 0 : torque_target(canopen));
    }
    return drive->mode == CANOPEN_MODE_VELOCITY &&
           drive->within_us >= (uint32_t)canopen->values[CANOPEN_VALUE_VELOCITY_WINDOW_TIME] * US_PER_MS;
}

COLD bool canopen_demand_slow_or_followed(const canopen_t *canopen) {
    const canopen_drive_t *drive = &canopen->drive;
    if (canopen_position_is(drive->mode)) {
        return drive->state == CANOPEN_OPERATION_ENABLED && drive->position &&
               canopen_position_acknowledged(canopen, is_halted(canopen));
    }
    if (is_cyclic(drive->mode)) {
        return drive->state == CANOPEN_OPERATION_ENABLED && !drive->stopping && !is_halted(canopen);
    }
    return drive->mode == CANOPEN_MODE_VELOCITY &&
           drive->slow_us >= (uint32_t)canopen->values[CANOPEN_VALUE_VELOCITY_THRESHOLD_TIME] * US_PER_MS;
}
