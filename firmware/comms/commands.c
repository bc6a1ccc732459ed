#include "comms/commands.h"

#include <assert.h>

#include "comms/counter.h"
#include "comms/units.h"
#include "control/machine_tables.h"
#include "drive_codec.h"
#include "fixed/fixed.h"

/* The only bits of a frame to the drive that no signal covers: required to be zero, reserved for later use. */
#define PARAMETER_REQUEST_RESERVED_BYTE 3

void commands_init(commands_t *commands) {
    *commands = (commands_t){0};
    e2e_receiver_init(&commands->receiver, DRIVE_COMMAND_E2E_DATA_ID);
    e2e_receiver_init(&commands->torque_receiver, DRIVE_TORQUE_COMMAND_E2E_DATA_ID);
}

void commands_check_timeout(commands_t *commands, uint32_t time_us, uint32_t timeout_us) {
    if (time_us - commands->last_received_us > timeout_us) {
        e2e_receiver_restart(&commands->receiver);
        e2e_receiver_restart(&commands->torque_receiver);
    }
}

static commands_frame_t reject(uint16_t *counter) {
    counter_add(counter, 1);
    return COMMANDS_REJECTED;
}

static_assert(DRIVE_COMMAND_LENGTH == DRIVE_TORQUE_COMMAND_LENGTH, "both commands have one check of their length");

/* Writes the request and the reference of a command with a valid checksum; false: out of range, nothing is written. */
static bool unpack(const hal_can_frame_t *frame, command_t *command) {
    if (frame->identifier == DRIVE_TORQUE_COMMAND_FRAME_ID) {
        struct drive_torque_command_t message;
        drive_torque_command_unpack(&message, frame->data, frame->length);
        if (!drive_torque_command_request_is_in_range(message.request)) {
            return false;
        }
        command->request = (command_request_t)message.request;
        command->mode = DRIVE_MODE_TORQUE;
        command->torque_reference_q24 = units_torque_q24(message.torque_reference_nm);
        return true;
    }
    struct drive_command_t message;
    drive_command_unpack(&message, frame->data, frame->length);
    if (!drive_command_request_is_in_range(message.request) ||
        fixed_abs(message.speed_reference_rpm) > machine_tables.speed_reference_max) {
        return false;
    }
    command->request = (command_request_t)message.request;
    command->mode = DRIVE_MODE_SPEED;
    command->speed_reference_q22 = units_speed_q22(message.speed_reference_rpm);
    return true;
}

static commands_frame_t receive_command(commands_t *commands, e2e_receiver_t *receiver, const hal_can_frame_t *frame,
                                        uint32_t time_us, command_t *command) {
    commands_counters_t *counters = &commands->counters;
    if (frame->length != DRIVE_COMMAND_LENGTH) {
        return reject(&counters->wrong_length);
    }
    switch (e2e_check(receiver, frame->data, frame->length)) {
    case E2E_ACCEPTED:
        break;
    case E2E_WRONG_CHECKSUM:
        return reject(&counters->wrong_checksum);
    case E2E_REPEATED:
    case E2E_WRONG_SEQUENCE:
    default:
        return reject(&counters->wrong_counter);
    }
    commands->last_received_us = time_us;
    if (!unpack(frame, command)) {
        return reject(&counters->out_of_range);
    }
    counter_add(&counters->accepted, 1);
    command->time_us = time_us;
    return COMMANDS_COMMAND;
}

commands_frame_t commands_receive(commands_t *commands, const hal_can_frame_t *frame, uint32_t time_us,
                                  command_t *command) {
    commands_counters_t *counters = &commands->counters;
    if (frame->extended || frame->remote) {
        return reject(&counters->unknown_frame);
    }
    if (frame->identifier == DRIVE_COMMAND_FRAME_ID) {
        return receive_command(commands, &commands->receiver, frame, time_us, command);
    }
    if (frame->identifier == DRIVE_TORQUE_COMMAND_FRAME_ID) {
        return receive_command(commands, &commands->torque_receiver, frame, time_us, command);
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
    return reject(&counters->unknown_frame);
}
