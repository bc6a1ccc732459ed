#include "comms/canopen_drive.h"

#include "comms/arming.h"
#include "comms/canopen_demand.h"
#include "comms/canopen_position.h"
#include "comms/canopen_send.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"

/* Bits of the controlword. */
#define SWITCH_ON 0x01u
#define ENABLE_VOLTAGE 0x02u
#define NO_QUICK_STOP 0x04u
#define ENABLE_OPERATION 0x08u
#define ORDER 0x10u /* new set-point, or homing operation start */
#define FAULT_RESET 0x80u

/* Bits of the statusword. */
#define VOLTAGE_ENABLED 0x0010u
#define REMOTE 0x0200u
#define TARGET_REACHED 0x0400u
#define INTERNAL_LIMIT 0x0800u
#define SPEED_ZERO_OR_FOLLOWS 0x1000u /* set-point acknowledge and homing attained, too */
#define POSITION_ERROR 0x2000u

/* Codes of EMCY and their bits of the error register. */
enum {
    REGISTER_ANY = 1,
    REGISTER_CURRENT = 2,
    REGISTER_VOLTAGE = 4,
    REGISTER_TEMPERATURE = 8,
    REGISTER_BUS = 16,
    REGISTER_PROFILE = 32
};

typedef enum { NONE, DISABLE_VOLTAGE, QUICK_STOP, SHUTDOWN, DISABLE_OPERATION, ENABLE } command_code_t;

static const uint8_t state_bits[CANOPEN_STATES] = {
    [CANOPEN_NOT_READY] = 0x00,          [CANOPEN_SWITCH_ON_DISABLED] = 0x40,
    [CANOPEN_READY_TO_SWITCH_ON] = 0x21, [CANOPEN_SWITCHED_ON] = 0x23,
    [CANOPEN_OPERATION_ENABLED] = 0x27,  [CANOPEN_QUICK_STOP_ACTIVE] = 0x07,
    [CANOPEN_FAULT_REACTION] = 0x0F,     [CANOPEN_FAULT] = 0x08,
};

/* Enters a state in which the drive does not run. */
static void rest(canopen_t *canopen, const canopen_context_t *context, canopen_state_t state) {
    canopen->drive.state = state;
    canopen->drive.stopping = false;
    commands_disarm(context->commands);
}

/* Ramps to standstill, then enters a state. */
static void stop(canopen_t *canopen, canopen_state_t state, canopen_state_t after, bool fast) {
    canopen->drive.state = state;
    canopen->drive.after = after;
    canopen->drive.fast = fast;
    canopen->drive.stopping = true;
    canopen_demand_stop(canopen);
}

static void enable(canopen_t *canopen, const canopen_context_t *context) {
    commands_t *commands = context->commands;
    if (canopen->nmt != CANOPEN_NMT_OPERATIONAL || canopen->bus_off) {
        return;
    }
    if (canopen->measured.state != DRIVE_STATE_READY) {
        canopen->drive.enabling = true;
        canopen->drive.enabling_us = context->time_us;
        return;
    }
    commands_disarm(commands);
    arming_arm(&commands->arming);
    commands->armed_us = commands->last_received_us = context->time_us;
    canopen->drive.state = CANOPEN_OPERATION_ENABLED;
    canopen->drive.stopping = false;
    canopen->communication_error = 0;
    canopen_demand_begin(canopen);
}

/* By its option code from operation enabled: at once, or after a ramp, which goes on when the command is repeated. */
static void leave(canopen_t *canopen, const canopen_context_t *context, canopen_state_t to, unsigned option) {
    const canopen_drive_t *drive = &canopen->drive;
    if (canopen->values[option] == 0) {
        rest(canopen, context, to);
    } else if (!drive->stopping || drive->after != to) {
        stop(canopen, CANOPEN_OPERATION_ENABLED, to, false);
    }
}

static void quick_stop(canopen_t *canopen, const canopen_context_t *context) {
    const int32_t option = canopen->values[CANOPEN_VALUE_QUICK_STOP_OPTION];
    if (option == 0) {
        rest(canopen, context, CANOPEN_SWITCH_ON_DISABLED);
        return;
    }
    stop(canopen, CANOPEN_QUICK_STOP_ACTIVE, option >= 5 ? CANOPEN_QUICK_STOP_ACTIVE : CANOPEN_SWITCH_ON_DISABLED,
         option == 2 || option == 6);
}

static command_code_t decode(uint32_t word) {
    if ((word & ENABLE_VOLTAGE) == 0) {
        return DISABLE_VOLTAGE;
    }
    if ((word & NO_QUICK_STOP) == 0) {
        return QUICK_STOP;
    }
    if ((word & SWITCH_ON) == 0) {
        return SHUTDOWN;
    }
    return (word & ENABLE_OPERATION) == 0 ? DISABLE_OPERATION : ENABLE;
}

COLD bool canopen_drive_is_stop(const canopen_t *canopen, uint32_t word) {
    const command_code_t code = decode(word);
    return (word & FAULT_RESET) == 0 &&
           (canopen_enabled(canopen) ? code != ENABLE : code == DISABLE_VOLTAGE || code == QUICK_STOP);
}

static void reset_fault(canopen_t *canopen, const canopen_context_t *context) {
    canopen_drive_t *drive = &canopen->drive;
    if (canopen->measured.state == DRIVE_STATE_FAULT) {
        drive->clearing = true;
        drive->clearing_us = context->time_us;
    }
    drive->lost = false;
    canopen->communication_error = 0;
}

/* Transitions of a drive that is enabled. */
static void control_enabled(canopen_t *canopen, const canopen_context_t *context, command_code_t code) {
    canopen_drive_t *drive = &canopen->drive;
    if (code == DISABLE_VOLTAGE) {
        rest(canopen, context, CANOPEN_SWITCH_ON_DISABLED);
    } else if (code == QUICK_STOP) {
        quick_stop(canopen, context);
    } else if (code == SHUTDOWN) {
        leave(canopen, context, CANOPEN_READY_TO_SWITCH_ON, CANOPEN_VALUE_SHUTDOWN_OPTION);
    } else if (code == DISABLE_OPERATION) {
        leave(canopen, context, CANOPEN_SWITCHED_ON, CANOPEN_VALUE_DISABLE_OPTION);
    } else if (drive->stopping) { /* enabled once more before the ramp has ended */
        drive->stopping = false;
        canopen_demand_begin(canopen);
    }
}

/* Transitions of a drive that is ready to switch on, or switched on. */
static void control_ready(canopen_t *canopen, const canopen_context_t *context, command_code_t code) {
    canopen_drive_t *drive = &canopen->drive;
    if (code == DISABLE_VOLTAGE || code == QUICK_STOP) {
        drive->state = CANOPEN_SWITCH_ON_DISABLED;
    } else if (code == SHUTDOWN) {
        drive->state = CANOPEN_READY_TO_SWITCH_ON;
    } else {
        drive->state = CANOPEN_SWITCHED_ON;
        if (code == ENABLE) {
            enable(canopen, context);
        }
    }
}

/* Edges of bit 4 while the drive is enabled, and was before. */
static void order(canopen_t *canopen, canopen_state_t before, bool bit) {
    canopen_drive_t *drive = &canopen->drive;
    if (bit != drive->order_bit && before == CANOPEN_OPERATION_ENABLED && drive->state == before && drive->position &&
        drive->mode == canopen->values[CANOPEN_VALUE_MODE]) {
        canopen_position_order(canopen, bit);
    }
    drive->order_bit = bit;
}

COLD void canopen_drive_control(canopen_t *canopen, const canopen_context_t *context) {
    canopen_drive_t *drive = &canopen->drive;
    const uint32_t word = (uint32_t)canopen->values[CANOPEN_VALUE_CONTROLWORD];
    const bool resets = (word & FAULT_RESET) != 0 && !drive->reset_bit;
    drive->reset_bit = (word & FAULT_RESET) != 0;
    const command_code_t code = decode(word);
    const canopen_state_t before = drive->state;
    drive->enabling = false;
    switch (drive->state) {
    case CANOPEN_SWITCH_ON_DISABLED:
        if (code == SHUTDOWN) {
            drive->state = CANOPEN_READY_TO_SWITCH_ON;
        }
        break;
    case CANOPEN_READY_TO_SWITCH_ON:
    case CANOPEN_SWITCHED_ON:
        control_ready(canopen, context, code);
        break;
    case CANOPEN_OPERATION_ENABLED:
        control_enabled(canopen, context, code);
        break;
    case CANOPEN_QUICK_STOP_ACTIVE:
        if (code == DISABLE_VOLTAGE) {
            rest(canopen, context, CANOPEN_SWITCH_ON_DISABLED);
        } else if (code == ENABLE && drive->after == CANOPEN_QUICK_STOP_ACTIVE) {
            drive->state = CANOPEN_OPERATION_ENABLED;
            drive->stopping = false;
            canopen_demand_begin(canopen);
        }
        break;
    case CANOPEN_FAULT:
        if (resets) {
            reset_fault(canopen, context);
        }
        break;
    default: /* not ready to switch on, fault reaction active: no command */
        break;
    }
    order(canopen, before, (word & ORDER) != 0);
}

COLD void canopen_drive_abort(canopen_t *canopen, const canopen_context_t *context) {
    if (canopen->drive.state != CANOPEN_OPERATION_ENABLED && canopen->drive.state != CANOPEN_QUICK_STOP_ACTIVE) {
        return;
    }
    switch (canopen->values[CANOPEN_VALUE_ABORT_OPTION]) {
    case 1:
        canopen->drive.lost = true;
        stop(canopen, CANOPEN_FAULT_REACTION, CANOPEN_FAULT, true);
        break;
    case 2:
        rest(canopen, context, CANOPEN_SWITCH_ON_DISABLED);
        break;
    default:
        stop(canopen, CANOPEN_QUICK_STOP_ACTIVE, CANOPEN_SWITCH_ON_DISABLED, true);
        break;
    }
}

COLD void canopen_drive_lose_master(canopen_t *canopen, const canopen_context_t *context, unsigned code) {
    canopen->communication_error = (uint16_t)code;
    canopen_emergency(canopen, code, FAULT_NONE);
    if (canopen->nmt == CANOPEN_NMT_OPERATIONAL && code != CANOPEN_RPDO_TIMEOUT) {
        const int32_t behaviour = canopen->values[CANOPEN_VALUE_ERROR_BEHAVIOUR];
        canopen->nmt = behaviour == 0   ? CANOPEN_NMT_PRE_OPERATIONAL
                       : behaviour == 2 ? CANOPEN_NMT_STOPPED
                                        : CANOPEN_NMT_OPERATIONAL;
    }
    canopen_drive_abort(canopen, context);
}

COLD void canopen_drive_disable(canopen_t *canopen, const canopen_context_t *context) {
    const canopen_state_t state = canopen->drive.state;
    rest(canopen, context, state == CANOPEN_FAULT || state == CANOPEN_NOT_READY ? state : CANOPEN_SWITCH_ON_DISABLED);
}

/* The drive is in a fault. */
static void follow_fault(canopen_t *canopen, const canopen_context_t *context) {
    canopen_drive_t *drive = &canopen->drive;
    const uint8_t fault = canopen->measured.fault;
    if (fault != canopen->reported_fault && fault < FAULT_COUNT) {
        canopen->reported_fault = fault;
        canopen_emergency(canopen, canopen_error_codes[fault], fault);
    }
    if (drive->state != CANOPEN_FAULT) {
        rest(canopen, context, CANOPEN_FAULT);
    }
    drive->clearing = drive->clearing && context->time_us - drive->clearing_us < CANOPEN_CLEARING_US;
}

/* Transitions of an enabled drive by itself: disarmed, or at rest after a ramp. */
static void follow_run(canopen_t *canopen, const canopen_context_t *context) {
    const canopen_drive_t *drive = &canopen->drive;
    if (!context->commands->arming.armed) {
        rest(canopen, context, CANOPEN_SWITCH_ON_DISABLED);
    } else if (drive->stopping && drive->state != drive->after && canopen_demand_rests(canopen, context->time_us)) {
        rest(canopen, context, drive->after);
    }
}

/* Enable operation that has come before the drive was ready. */
static void follow_enabling(canopen_t *canopen, const canopen_context_t *context) {
    canopen_drive_t *drive = &canopen->drive;
    drive->enabling = drive->enabling && drive->state == CANOPEN_SWITCHED_ON &&
                      context->time_us - drive->enabling_us < CANOPEN_ENABLING_US;
    if (drive->enabling && canopen->measured.state == DRIVE_STATE_READY) {
        drive->enabling = false;
        enable(canopen, context);
    }
}

/* Transitions that follow from the state of the drive alone. */
static void follow_drive(canopen_t *canopen, const canopen_context_t *context) {
    canopen_drive_t *drive = &canopen->drive;
    const drive_state_t state = canopen->measured.state;
    if (state == DRIVE_STATE_FAULT) {
        follow_fault(canopen, context);
        return;
    }
    drive->clearing = false;
    if (state == DRIVE_STATE_INITIALISE) {
        rest(canopen, context, CANOPEN_NOT_READY);
    } else if (drive->state == CANOPEN_NOT_READY || (drive->state == CANOPEN_FAULT && !drive->lost)) {
        rest(canopen, context, CANOPEN_SWITCH_ON_DISABLED);
        canopen->reported_fault = FAULT_NONE;
    } else if (canopen_enabled(canopen)) {
        follow_run(canopen, context);
    } else {
        follow_enabling(canopen, context);
    }
}

/* A following error, and the end of all errors. */
static void follow_errors(canopen_t *canopen) {
    const uint16_t code = canopen_drive_error_code(canopen);
    if (code != canopen->drive.error && (code == 0 || code == CANOPEN_FOLLOWING_ERROR)) {
        canopen_emergency(canopen, code, FAULT_NONE);
    }
    canopen->drive.error = code;
}

COLD void canopen_drive_step(canopen_t *canopen, const canopen_context_t *context, command_t *command) {
    canopen_drive_t *drive = &canopen->drive;
    commands_t *commands = context->commands;
    follow_drive(canopen, context);
    canopen_demand_step(canopen, context->time_us);
    follow_errors(canopen);
    command_t made = {.request = drive->clearing ? COMMAND_CLEAR_FAULT : COMMAND_OFF, .time_us = context->time_us};
    if (canopen_enabled(canopen)) {
        made.request = COMMAND_RUN;
        canopen_demand_command(canopen, &made);
        commands->used = true;
    }
    commands->requested = *command = made;
    commands->last_received_us = context->time_us;
}

COLD uint16_t canopen_drive_statusword(const canopen_t *canopen) {
    const canopen_drive_t *drive = &canopen->drive;
    uint32_t word = state_bits[(unsigned)drive->state < CANOPEN_STATES ? drive->state : CANOPEN_NOT_READY];
    word |= canopen->measured.supplied ? VOLTAGE_ENABLED : 0;
    word |= canopen->nmt == CANOPEN_NMT_OPERATIONAL ? REMOTE : 0;
    word |= drive->limited || canopen->measured.limited ? INTERNAL_LIMIT : 0;
    if (canopen_demand_reached(canopen)) {
        word |= TARGET_REACHED;
    }
    if (canopen_demand_slow_or_followed(canopen)) {
        word |= SPEED_ZERO_OR_FOLLOWS;
    }
    if (canopen_position_failed(canopen)) {
        word |= POSITION_ERROR;
    }
    return (uint16_t)word;
}

COLD uint16_t canopen_drive_error_code(const canopen_t *canopen) {
    const canopen_measured_t *measured = &canopen->measured;
    if (measured->state == DRIVE_STATE_FAULT && measured->fault < FAULT_COUNT) {
        return canopen_error_codes[measured->fault];
    }
    if (canopen->drive.position && canopen->place.following_error) {
        return CANOPEN_FOLLOWING_ERROR;
    }
    return canopen->communication_error;
}

COLD uint8_t canopen_drive_error_register(const canopen_t *canopen) {
    const uint16_t code = canopen_drive_error_code(canopen);
    if (code == 0) {
        return 0;
    }
    switch (code >> 12) {
    case 2:
        return REGISTER_ANY | REGISTER_CURRENT;
    case 3:
        return REGISTER_ANY | REGISTER_VOLTAGE;
    case 4:
        return REGISTER_ANY | REGISTER_TEMPERATURE;
    case 8:
        return REGISTER_ANY | (code == CANOPEN_FOLLOWING_ERROR ? REGISTER_PROFILE : REGISTER_BUS);
    default:
        return REGISTER_ANY;
    }
}
