#include "comms/commands.h"

#include <assert.h>

#include "comms/counter.h"
#include "comms/units.h"
#include "control/machine_tables.h"
#include "drive_codec.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"
#include "storage/parameters.h"

/* The only bits of a frame to the drive that no signal covers: required to be zero, reserved for later use. */
#define PARAMETER_REQUEST_RESERVED_BYTE 3

void commands_init(commands_t *commands) {
    *commands = (commands_t){0};
    e2e_receiver_init(&commands->receiver);
    arming_init(&commands->arming);
}

/* [SR-35] */
COLD void commands_disarm(commands_t *commands) {
    arming_disarm(&commands->arming);
    commands->used = commands->ran = false;
    commands->errors = 0;
}

/* True when a drive that is armed must not remain so. [SR-35] */
static bool must_disarm(const commands_t *commands, uint32_t time_us, uint32_t timeout_us) {
    const uint32_t silent_us = time_us - commands->last_received_us;
    const bool running = commands->state == DRIVE_STATE_RUN;
    return commands->state == DRIVE_STATE_FAULT || (commands->ran && !running) ||
           silent_us > (running ? COMMAND_LOST_US : timeout_us) ||
           (!commands->used && time_us - commands->armed_us > COMMANDS_ARMED_UNUSED_US);
}

/* Another sender is forgotten when its frames have not come for long enough. [SR-36] */
static void expire_contest(commands_t *commands, uint32_t time_us) {
    commands->contested = commands->contested && time_us - commands->contested_us < COMMANDS_SENDER_LOST_US;
}

/* [SR-35] [SR-36] */
COLD void commands_supervise(commands_t *commands, drive_state_t state, uint32_t time_us, uint32_t timeout_us) {
    if (state == DRIVE_STATE_RUN && commands->state != DRIVE_STATE_RUN) {
        arming_end_configuration(&commands->arming);
    }
    commands->state = state;
    arming_check_timeout(&commands->arming, time_us);
    if (commands->arming.armed != 0) {
        commands->ran |= state == DRIVE_STATE_RUN;
        if (must_disarm(commands, time_us, timeout_us)) {
            commands_disarm(commands);
        }
    }
    if (!commands->arming.armed && time_us - commands->last_received_us > timeout_us) {
        e2e_receiver_restart(&commands->receiver);
        expire_contest(commands, time_us); /* in silence nothing else does, and the clock comes round */
    }
}

/* [SR-32] */
static commands_frame_t reject(uint16_t *counter) {
    counter_add(counter, 1);
    return COMMANDS_REJECTED;
}

/* As reject, of a command frame. [SR-33] */
static commands_frame_t reject_command(commands_t *commands, uint16_t *counter) {
    if (commands->arming.armed != 0) {
        commands->errors = (uint16_t)(commands->errors + COMMANDS_ERROR_STEP);
        if (commands->errors > (COMMANDS_ERRORS_MAX - 1u) * COMMANDS_ERROR_STEP) {
            commands->failed = true;
            commands_disarm(commands);
        }
    }
    return reject(counter);
}

static_assert(DRIVE_COMMAND_LENGTH == DRIVE_TORQUE_COMMAND_LENGTH, "both commands have one check of their length");
static_assert(DRIVE_COMMAND_LENGTH == (unsigned)DRIVE_IDENTIFY_WINDOW_LENGTH, "likewise");
static_assert(DRIVE_POSITION_COMMAND_LENGTH == (unsigned)DRIVE_IDENTIFY_COMMAND_LENGTH, "likewise");

/* Writes an experiment, of which the window comes before the rest. As unpack. [SR-32] */
static bool unpack_identify(const hal_can_frame_t *frame, identify_command_t *identify, command_t *command) {
    if (frame->identifier == DRIVE_IDENTIFY_WINDOW_FRAME_ID) {
        struct drive_identify_window_t window;
        (void)drive_identify_window_unpack(&window, frame->data, frame->length);
        identify->angle_q16 = window.angle;
        identify->width_q16 = window.width;
        return true;
    }
    struct drive_identify_command_t message;
    (void)drive_identify_command_unpack(&message, frame->data, frame->length);
    if (!drive_identify_command_request_is_in_range(message.request) ||
        !drive_identify_command_kind_is_in_range(message.kind) || message.phase >= machine_tables.phases) {
        return false;
    }
    command->request = message.request == COMMAND_RUN ? COMMAND_IDENTIFY : (command_request_t)message.request;
    command->mode = DRIVE_MODE_SPEED;
    command->speed_reference_q22 = 0;
    identify->kind = (identify_kind_t)message.kind;
    identify->phase = message.phase;
    identify->number = message.number;
    identify->level_q12 = message.level;
    identify->time_ms = message.time_ms;
    return true;
}

/* As unpack; the order and the position in its range are valid in every bit. [SR-32] */
static bool unpack_position(const hal_can_frame_t *frame, command_t *command) {
    struct drive_position_command_t message;
    (void)drive_position_command_unpack(&message, frame->data, frame->length);
    if (!drive_position_command_request_is_in_range(message.request) ||
        !drive_position_command_order_is_in_range(message.order)) {
        return false;
    }
    command->request = (command_request_t)message.request;
    command->mode = DRIVE_MODE_POSITION;
    command->speed_reference_q22 = 0; /* of a drive without this mode, and of one that loses its commands */
    command->position = (position_set_point_t){
        .order = (position_order_t)message.order,
        .homing = POSITION_HOMING_METHODS,
        .sequence = command->position.sequence + 1,
        .target = units_position(message.position_deg),
    };
    return true;
}

/* Writes the request and the reference of a command with a valid checksum; false: out of range, nothing is written.
 * [SR-32] */
static bool unpack(const hal_can_frame_t *frame, command_t *command) {
    if (frame->identifier == DRIVE_POSITION_COMMAND_FRAME_ID) {
        return unpack_position(frame, command);
    }
    if (frame->identifier == DRIVE_TORQUE_COMMAND_FRAME_ID) {
        struct drive_torque_command_t message;
        (void)drive_torque_command_unpack(&message, frame->data, frame->length);
        if (!drive_torque_command_request_is_in_range(message.request)) {
            return false;
        }
        command->request = (command_request_t)message.request;
        command->mode = DRIVE_MODE_TORQUE;
        command->torque_reference_q24 = units_torque_q24(message.torque_reference_nm);
        return true;
    }
    struct drive_command_t message;
    (void)drive_command_unpack(&message, frame->data, frame->length);
    if (!drive_command_request_is_in_range(message.request) ||
        fixed_abs(message.speed_reference_rpm) > machine_tables.speed_reference_max) {
        return false;
    }
    command->request = (command_request_t)message.request;
    command->mode = DRIVE_MODE_SPEED;
    command->speed_reference_q22 = units_speed_q22(message.speed_reference_rpm);
    return true;
}

/* Writes the command in effect: the last valid one, and off instead of run while not armed. [SR-34] */
static void publish(commands_t *commands, command_t *command) {
    *command = commands->requested;
    if (!command_needs_arming(command->request)) {
        return;
    }
    if (commands->arming.armed != 0) {
        commands->used = true;
    } else {
        command->request = COMMAND_OFF;
        counter_add(&commands->counters.run_unarmed, 1);
    }
}

/* Follows the sequence of a sender's commands. False: the frame is not the next one of the sender that commands; its
 * rejection is written. [SR-36] */
static bool follow_sender(commands_t *commands, unsigned data_id, const hal_can_frame_t *frame, uint32_t time_us,
                          commands_frame_t *rejection) {
    commands_counters_t *counters = &commands->counters;
    const uint16_t data_id_of_node = (uint16_t)(data_id + commands->data_id_offset);
    commands->receiver.locked =
        commands->arming.armed || time_us - commands->last_received_us < COMMANDS_SENDER_LOST_US;
    switch (e2e_check(&commands->receiver, data_id_of_node, frame->data, frame->length)) {
    case E2E_ACCEPTED:
        expire_contest(commands, time_us);
        return true;
    case E2E_RESYNCHRONISED:
        commands->contested = false;
        return true;
    case E2E_WRONG_CHECKSUM:
        *rejection = reject_command(commands, &counters->wrong_checksum);
        return false;
    case E2E_REPEATED: /* duplicated on the way, no evidence of a second sender */
        *rejection = reject(&counters->wrong_counter);
        return false;
    default: /* E2E_WRONG_SEQUENCE */
        commands->contested = true;
        commands->contested_us = time_us;
        *rejection = reject_command(commands, &counters->wrong_counter);
        return false;
    }
}

/* In a run there is no fault to clear, and a run of one kind does not become one of the other. [SR-33] [SR-36] */
static bool may_follow(const commands_t *commands, command_request_t request) {
    const command_request_t before = commands->requested.request;
    const bool changes_kind = command_needs_arming(request) && command_needs_arming(before) && request != before;
    return commands->state != DRIVE_STATE_RUN || (request != COMMAND_CLEAR_FAULT && !changes_kind);
}

/* [SR-32] [SR-33] */
static commands_frame_t receive_command(commands_t *commands, unsigned data_id, const hal_can_frame_t *frame,
                                        uint32_t time_us, command_t *command) {
    commands_counters_t *counters = &commands->counters;
    const bool experiments = frame->identifier == DRIVE_IDENTIFY_COMMAND_FRAME_ID;
    const bool longer = experiments || frame->identifier == DRIVE_POSITION_COMMAND_FRAME_ID;
    if (frame->length != (longer ? DRIVE_POSITION_COMMAND_LENGTH : DRIVE_COMMAND_LENGTH)) {
        return reject_command(commands, &counters->wrong_length);
    }
    commands_frame_t rejection;
    if (!follow_sender(commands, data_id, frame, time_us, &rejection)) {
        return rejection;
    }
    commands->last_received_us = time_us;
    command_t requested = commands->requested;
    identify_command_t experiment = commands->identify;
    if (!(experiments || frame->identifier == DRIVE_IDENTIFY_WINDOW_FRAME_ID
              ? unpack_identify(frame, &experiment, &requested)
              : unpack(frame, &requested)) ||
        !may_follow(commands, requested.request)) {
        return reject_command(commands, &counters->out_of_range);
    }
    commands->requested = requested;
    commands->identify = experiment;
    counter_add(&counters->accepted, 1);
    commands->errors = (uint16_t)(commands->errors - (commands->errors > 0));
    commands->requested.time_us = time_us;
    const bool stopping = commands->requested.request == COMMAND_STOP && commands->state == DRIVE_STATE_RUN;
    if (commands->used && !command_needs_arming(commands->requested.request) && !stopping) {
        commands_disarm(commands);
    }
    if (commands->failed && commands->state == DRIVE_STATE_RUN) { /* it would end the run before the fault does */
        return COMMANDS_ACCEPTED;
    }
    publish(commands, command);
    return COMMANDS_COMMAND;
}

/* The drive is armed for the sender of the last command, which must not be older than the command timeout; not while
 * valid commands of another sequence come as well, because that may be the one of who confirms. [SR-34] */
static commands_frame_t receive_arming(commands_t *commands, hal_t *hal, const hal_can_frame_t *frame, uint32_t time_us,
                                       uint32_t timeout_us, command_t *command) {
    if (frame->length != DRIVE_ARM_LENGTH) {
        return reject(&commands->counters.wrong_length);
    }
    if (!e2e_checksum_matches((uint16_t)(DRIVE_ARM_E2E_DATA_ID + commands->data_id_offset), frame->data,
                              frame->length)) {
        return reject(&commands->counters.wrong_checksum);
    }
    const bool stopped = commands->state == DRIVE_STATE_INITIALISE || commands->state == DRIVE_STATE_READY;
    const bool commanded =
        commands->receiver.synchronised && !commands->contested && time_us - commands->last_received_us <= timeout_us;
    const bool request = frame->data[E2E_HEADER_BYTES] == ARMING_STEP_REQUEST_RUN;
    switch (arming_receive(&commands->arming, hal, frame, stopped && (commanded || request), time_us)) {
    case ARMING_ARMED:
        commands->armed_us = time_us;
        publish(commands, command);
        return COMMANDS_COMMAND;
    case ARMING_CONFIGURING:
        commands->set_receiver =
            (e2e_receiver_t){.locked = true, .synchronised = true, .counter = frame->data[E2E_HEADER_BYTES - 1]};
        return COMMANDS_ACCEPTED;
    case ARMING_CHALLENGED:
        return COMMANDS_ACCEPTED;
    default: /* ARMING_REFUSED */
        return COMMANDS_REJECTED;
    }
}

static_assert(DRIVE_PARAMETER_WRITE_LENGTH == DRIVE_PARAMETER_SET_CONTROL_LENGTH, "one check of their length");

/* The byte after the header is an index or a step. [SR-32] [SR-56] */
static commands_frame_t receive_set(commands_t *commands, unsigned data_id, unsigned end, const hal_can_frame_t *frame,
                                    uint32_t time_us) {
    commands_counters_t *counters = &commands->counters;
    const uint16_t data_id_of_node = (uint16_t)(data_id + commands->data_id_offset);
    const bool control = frame->identifier == DRIVE_PARAMETER_SET_CONTROL_FRAME_ID;
    if (frame->length != DRIVE_PARAMETER_WRITE_LENGTH) {
        return reject(&counters->wrong_length);
    }
    if (!e2e_checksum_matches(data_id_of_node, frame->data, frame->length)) {
        return reject(&counters->wrong_checksum);
    }
    if (!commands->arming.configuring) {
        (void)arming_refuse(&commands->arming);
    } else if (e2e_check(&commands->set_receiver, data_id_of_node, frame->data, frame->length) != E2E_ACCEPTED) {
        return reject(&counters->wrong_counter);
    } else {
        commands->arming.configuring_us = time_us;
    }
    if (frame->data[E2E_HEADER_BYTES] >= end) {
        return reject(&counters->out_of_range);
    }
    return control || commands->arming.configuring ? COMMANDS_PARAMETER_SET : COMMANDS_REJECTED;
}

/* [SR-32] */
commands_frame_t commands_receive(commands_t *commands, hal_t *hal, const hal_can_frame_t *frame, uint32_t time_us,
                                  uint32_t timeout_us, command_t *command) {
    commands_counters_t *counters = &commands->counters;
    if (frame->extended || frame->remote) {
        return reject(&counters->unknown_frame);
    }
    if (frame->identifier == DRIVE_COMMAND_FRAME_ID) {
        return receive_command(commands, DRIVE_COMMAND_E2E_DATA_ID, frame, time_us, command);
    }
    if (frame->identifier == DRIVE_TORQUE_COMMAND_FRAME_ID) {
        return receive_command(commands, DRIVE_TORQUE_COMMAND_E2E_DATA_ID, frame, time_us, command);
    }
    if (frame->identifier == DRIVE_POSITION_COMMAND_FRAME_ID) {
        return receive_command(commands, DRIVE_POSITION_COMMAND_E2E_DATA_ID, frame, time_us, command);
    }
    if (frame->identifier == DRIVE_IDENTIFY_COMMAND_FRAME_ID) {
        return receive_command(commands, DRIVE_IDENTIFY_COMMAND_E2E_DATA_ID, frame, time_us, command);
    }
    if (frame->identifier == DRIVE_IDENTIFY_WINDOW_FRAME_ID) {
        return receive_command(commands, DRIVE_IDENTIFY_WINDOW_E2E_DATA_ID, frame, time_us, command);
    }
    if (frame->identifier == DRIVE_ARM_FRAME_ID) {
        return receive_arming(commands, hal, frame, time_us, timeout_us, command);
    }
    if (frame->identifier == DRIVE_PARAMETER_WRITE_FRAME_ID) {
        return receive_set(commands, DRIVE_PARAMETER_WRITE_E2E_DATA_ID, PARAMETER_COUNT, frame, time_us);
    }
    if (frame->identifier == DRIVE_PARAMETER_SET_CONTROL_FRAME_ID) {
        return receive_set(commands, DRIVE_PARAMETER_SET_CONTROL_E2E_DATA_ID, PARAMETER_SET_STEP_SAVE + 1u, frame,
                           time_us);
    }
    if (frame->identifier == DRIVE_PARAMETER_REQUEST_FRAME_ID) {
        if (frame->length != DRIVE_PARAMETER_REQUEST_LENGTH) {
            return reject(&counters->wrong_length);
        }
        if (frame->data[PARAMETER_REQUEST_RESERVED_BYTE] != 0) {
            return reject(&counters->out_of_range);
        }
        return COMMANDS_PARAMETER_REQUEST;
    }
    if (frame->identifier == DRIVE_XCP_COMMAND_FRAME_ID) {
        return COMMANDS_XCP;
    }
    return reject(&counters->unknown_frame);
}
