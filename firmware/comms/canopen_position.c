#include "comms/canopen_position.h"

#include "comms/canopen_units.h"
#include "comms/units.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"

/* Bits of the controlword. */
#define ORDER 0x10u
#define IMMEDIATELY 0x20u
#define RELATIVE 0x40u

#define HALT_FAST 2
#define JERK_LIMITED 3
#define US_PER_MS 1000u
#define LATE_CYCLES 3u
#define LONG_US 100000000u

/* Methods of CiA 402 by the parameter homing_method: the present place, the index pulse in positive and in negative
 * direction, and mechanical stops likewise, which CiA leaves to the manufacturer. */
static const int8_t methods[POSITION_HOMING_METHODS] = {37, 34, 33, -2, -1};
#define METHOD_HERE_FORMERLY 35

COLD position_homing_t canopen_homing_method(int32_t method) {
    unsigned parameter = 0;
    while (parameter < POSITION_HOMING_METHODS && methods[parameter] != method) {
        parameter++;
    }
    return method == METHOD_HERE_FORMERLY ? POSITION_HOMING_HERE : (position_homing_t)parameter;
}

COLD int32_t canopen_homing_number(int32_t parameter) {
    return (uint32_t)parameter < POSITION_HOMING_METHODS ? methods[parameter] : 0;
}

static uint32_t controlword(const canopen_t *canopen) {
    return (uint32_t)canopen->values[CANOPEN_VALUE_CONTROLWORD];
}

/* The position loop follows what is published. */
static bool follows(const canopen_t *canopen) {
    return canopen->place.active && canopen->place.sequence == canopen->position.sequence;
}

static void publish(canopen_position_t *position, position_order_t order) {
    position->order = order;
    position->sequence++;
}

COLD void canopen_position_begin(canopen_t *canopen) {
    canopen->position = (canopen_position_t){
        .order = POSITION_ORDER_HALT,
        .sequence = canopen->position.sequence + 1u,
        .move = {.target = canopen->place.position},
        .silent_us = LONG_US,
    };
}

/* --- profile position -------------------------------------------------------------------------------------------- */

/* Speed limit of velocity units; at least one LSB, because 0 is the drive's own. */
static int32_t speed_q22(const canopen_t *canopen, int32_t velocity) {
    const int32_t milli = fixed_abs(canopen_velocity_milli(canopen, velocity));
    return fixed_max(units_speed_q22(canopen_machine_speed(milli)), 1);
}

static canopen_move_t set_point(const canopen_t *canopen) {
    const int32_t *values = canopen->values;
    const int64_t wanted = canopen_position_q32(canopen, values[CANOPEN_VALUE_TARGET_POSITION]); /* below 2^52 */
    const bool relative = (controlword(canopen) & RELATIVE) != 0;
    const bool smooth = values[CANOPEN_VALUE_PROFILE_TYPE] == JERK_LIMITED;
    return (canopen_move_t){
        .target =
            fixed_clamp_64(relative ? canopen->position.move.target + wanted : wanted, -POSITION_MAX, POSITION_MAX),
        .speed_q22 = speed_q22(canopen, values[CANOPEN_VALUE_PROFILE_VELOCITY]),
        .acceleration_rpm_s = canopen_rate(canopen, values[CANOPEN_VALUE_ACCELERATION]),
        .deceleration_rpm_s = canopen_rate(canopen, values[CANOPEN_VALUE_DECELERATION]),
        .jerk_rpm_s2 = smooth ? canopen_rate(canopen, values[CANOPEN_VALUE_PROFILE_JERK]) : 0,
    };
}

/* Begins a move at once. */
static void begin_move(canopen_t *canopen, const canopen_move_t *to) {
    canopen_position_t *position = &canopen->position;
    position->move = *to;
    position->moving = position->targeted = true;
    position->waiting = false;
    canopen->drive.within_us = 0;
    publish(position, position->order);
}

static void take_set_point(canopen_t *canopen) {
    canopen_position_t *position = &canopen->position;
    if (position->acknowledged) {
        return;
    }
    const canopen_move_t wanted = set_point(canopen);
    position->acknowledged = true;
    if (position->moving && (controlword(canopen) & IMMEDIATELY) == 0) {
        position->next = wanted;
        position->waiting = true;
    } else {
        begin_move(canopen, &wanted);
    }
}

static bool arrived(const canopen_t *canopen) {
    const uint32_t window_us = (uint32_t)canopen->values[CANOPEN_VALUE_POSITION_WINDOW_TIME] * US_PER_MS;
    return canopen_position_within(canopen) && canopen->drive.within_us >= window_us;
}

static void step_profile(canopen_t *canopen) {
    canopen_position_t *position = &canopen->position;
    if (position->moving && arrived(canopen)) {
        position->moving = false;
        if (position->waiting) {
            const canopen_move_t next = position->next;
            begin_move(canopen, &next);
        }
    }
    position->acknowledged = position->acknowledged && ((controlword(canopen) & ORDER) != 0 || position->waiting);
}

/* --- homing ------------------------------------------------------------------------------------------------------ */

static void order_homing(canopen_position_t *position, bool rises) {
    if (rises) {
        position->homing = CANOPEN_HOMING_WANTED;
    } else if (position->homing == CANOPEN_HOMING_WANTED || position->homing == CANOPEN_HOMING_RUNS) {
        position->homing = CANOPEN_HOMING_IDLE;
    }
}

static void step_homing(canopen_t *canopen, bool halted) {
    canopen_position_t *position = &canopen->position;
    const position_status_t *place = &canopen->place;
    if (halted) {
        order_homing(position, false);
    } else if (position->homing == CANOPEN_HOMING_WANTED && position->order == POSITION_ORDER_HALT &&
               follows(canopen)) {
        position->homing = CANOPEN_HOMING_RUNS;
    } else if (position->homing == CANOPEN_HOMING_RUNS && follows(canopen) && !place->homing) {
        position->homing = place->homed && !place->homing_failed ? CANOPEN_HOMING_ATTAINED : CANOPEN_HOMING_FAILED;
    }
}

/* --- all modes --------------------------------------------------------------------------------------------------- */

COLD void canopen_position_order(canopen_t *canopen, bool rises) {
    if (canopen->drive.mode == CANOPEN_MODE_HOMING) {
        order_homing(&canopen->position, rises);
    } else if (canopen->drive.mode == CANOPEN_MODE_POSITION && rises) {
        take_set_point(canopen);
    }
}

COLD void canopen_position_target(canopen_t *canopen) {
    canopen_position_t *position = &canopen->position;
    if (!canopen->drive.position || canopen->drive.mode != CANOPEN_MODE_CYCLIC_POSITION) {
        return;
    }
    const int64_t wanted = canopen_position_q32(canopen, canopen->values[CANOPEN_VALUE_TARGET_POSITION]);
    position->move = (canopen_move_t){.target = fixed_clamp_64(wanted, -POSITION_MAX, POSITION_MAX)};
    position->targeted = true;
    position->silent_us = 0;
    publish(position, position->order);
}

static position_order_t wanted_order(const canopen_t *canopen, bool halted) {
    const canopen_position_t *position = &canopen->position;
    if (canopen->drive.mode == CANOPEN_MODE_HOMING) {
        return position->homing == CANOPEN_HOMING_RUNS ? POSITION_ORDER_HOME : POSITION_ORDER_HALT;
    }
    if (halted || !position->targeted) {
        return POSITION_ORDER_HALT;
    }
    return canopen->drive.mode == CANOPEN_MODE_CYCLIC_POSITION ? POSITION_ORDER_CYCLIC : POSITION_ORDER_PROFILE;
}

COLD void canopen_position_step(canopen_t *canopen, uint32_t elapsed_us, bool halted) {
    canopen_position_t *position = &canopen->position;
    position->silent_us = fixed_min_u32(position->silent_us + elapsed_us, LONG_US);
    if (canopen->drive.mode == CANOPEN_MODE_POSITION) {
        step_profile(canopen);
    } else if (canopen->drive.mode == CANOPEN_MODE_HOMING) {
        step_homing(canopen, halted);
    }
    const position_order_t order = wanted_order(canopen, halted);
    if (order != position->order || (halted && !canopen->drive.halted)) { /* a halt acknowledges in a halt, too */
        publish(position, order);
    }
    canopen->drive.halted = halted;
}

/* Software position limits, in the order of the drive's positions. */
static void limit(const canopen_t *canopen, position_set_point_t *set_point) {
    const int64_t a = canopen_position_q32(canopen, canopen->values[CANOPEN_VALUE_POSITION_MIN]);
    const int64_t b = canopen_position_q32(canopen, canopen->values[CANOPEN_VALUE_POSITION_MAX]);
    set_point->bounded = true;
    set_point->lowest = a < b ? a : b;
    set_point->highest = a < b ? b : a;
}

COLD void canopen_position_command(const canopen_t *canopen, bool halted, position_set_point_t *set_point) {
    const canopen_position_t *position = &canopen->position;
    const int32_t *values = canopen->values;
    const canopen_move_t *move = &position->move;
    *set_point = (position_set_point_t){
        .order = position->order,
        .homing = POSITION_HOMING_METHODS,
        .sequence = position->sequence,
        .target = move->target,
        .speed_q22 = move->speed_q22,
        .acceleration_rpm_s = move->acceleration_rpm_s,
        .deceleration_rpm_s = move->deceleration_rpm_s,
        .jerk_rpm_s2 = move->jerk_rpm_s2,
        .cycle_ms = (uint32_t)values[CANOPEN_VALUE_INTERPOLATION],
    };
    if (position->order == POSITION_ORDER_HOME) {
        const int32_t rate = canopen_rate(canopen, values[CANOPEN_VALUE_HOMING_ACCELERATION]);
        set_point->target = fixed_clamp_64(-canopen_position_q32(canopen, values[CANOPEN_VALUE_HOME_OFFSET]),
                                           -POSITION_MAX, POSITION_MAX);
        set_point->acceleration_rpm_s = set_point->deceleration_rpm_s = rate;
    } else if (position->order == POSITION_ORDER_HALT) {
        set_point->acknowledges = true;
        const bool fast = halted && values[CANOPEN_VALUE_HALT_OPTION] == HALT_FAST;
        set_point->deceleration_rpm_s =
            canopen_rate(canopen, values[fast ? CANOPEN_VALUE_QUICK_STOP_DECELERATION : CANOPEN_VALUE_DECELERATION]);
    }
    limit(canopen, set_point);
}

COLD bool canopen_position_within(const canopen_t *canopen) {
    const canopen_position_t *position = &canopen->position;
    return position->order == POSITION_ORDER_PROFILE && follows(canopen) && canopen->place.in_position &&
           canopen->place.arrived == position->sequence;
}

COLD bool canopen_position_reached(const canopen_t *canopen, bool halted) {
    const canopen_position_t *position = &canopen->position;
    const bool stands = canopen->drive.slow_us > 0;
    if (canopen->drive.mode == CANOPEN_MODE_HOMING) {
        return stands && position->homing != CANOPEN_HOMING_WANTED && position->homing != CANOPEN_HOMING_RUNS;
    }
    if (canopen->drive.mode == CANOPEN_MODE_CYCLIC_POSITION) {
        return false;
    }
    return halted ? stands : !position->moving && arrived(canopen);
}

/* Cyclic targets come in time, and the position loop follows them. */
static bool follows_targets(const canopen_t *canopen) {
    const uint32_t late_us = LATE_CYCLES * US_PER_MS * (uint32_t)canopen->values[CANOPEN_VALUE_INTERPOLATION];
    return follows(canopen) && !canopen->place.following_error && canopen->position.silent_us <= late_us;
}

COLD bool canopen_position_acknowledged(const canopen_t *canopen, bool halted) {
    const canopen_position_t *position = &canopen->position;
    switch (canopen->drive.mode) {
    case CANOPEN_MODE_POSITION:
        return position->acknowledged;
    case CANOPEN_MODE_HOMING:
        return position->homing == CANOPEN_HOMING_ATTAINED;
    default:
        return !halted && follows_targets(canopen);
    }
}

COLD bool canopen_position_failed(const canopen_t *canopen) {
    if (!canopen->drive.position || canopen->drive.state != CANOPEN_OPERATION_ENABLED) {
        return false;
    }
    return canopen->drive.mode == CANOPEN_MODE_HOMING ? canopen->position.homing == CANOPEN_HOMING_FAILED
                                                      : canopen->place.following_error;
}
