#include "comms/commands.h"

#include <assert.h>

#include "comms/counter.h"
#include "comms/units.h"
#include "drive_codec.h"

static_assert(COMMAND_OFF == DRIVE_COMMAND_REQUEST_OFF_CHOICE, "as in drive.dbc");
static_assert(COMMAND_RUN == DRIVE_COMMAND_REQUEST_RUN_CHOICE, "as in drive.dbc");
static_assert(COMMAND_STOP == DRIVE_COMMAND_REQUEST_STOP_CHOICE, "as in drive.dbc");
static_assert(COMMAND_CLEAR_FAULT == DRIVE_COMMAND_REQUEST_CLEAR_FAULT_CHOICE, "as in drive.dbc");

/* The only bits of a frame to the drive that no signal covers: they must be zero, so that they can get a meaning. */
#define PARAMETER_REQUEST_RESERVED_BYTE 3

void commands_init(commands_t *commands) {
    *commands = (commands_t){0};
    e2e_receiver_init(&commands->receiver, COMMANDS_DATA_ID);
}

void commands_watch(commands_t *commands, uint32_t time_us, uint32_t timeout_us) {
    if (commands->receiver.synchronised && time_us - commands->heard_us > timeout_us) {
        e2e_receiver_restart(&commands->receiver);
    }
}

static commands_frame_t refuse(uint16_t *counter) {
    counter_add(counter, 1);
    return COMMANDS_REFUSED;
}

static commands_frame_t take_command(commands_t *commands, const hal_can_frame_t *frame, uint32_t time_us,
                                     command_t *command) {
    commands_counters_t *counters = &commands->counters;
    if (frame->length != DRIVE_COMMAND_LENGTH) {
        return refuse(&counters->wrong_length);
    }
    switch (e2e_check(&commands->receiver, frame->data, frame->length)) {
    case E2E_ACCEPTED:
        break;
    case E2E_WRONG_CHECKSUM:
        return refuse(&counters->wrong_checksum);
    case E2E_REPEATED:
    case E2E_WRONG_SEQUENCE:
    default:
        return refuse(&counters->wrong_counter);
    }
    commands->heard_us = time_us;

    struct drive_command_t message;
    drive_command_unpack(&message, frame->data, frame->length);
    if (!drive_command_request_is_in_range(message.request) ||
        !drive_command_speed_reference_rpm_is_in_range(message.speed_reference_rpm)) {
        return refuse(&counters->out_of_range);
    }
    counter_add(&counters->accepted, 1);
    command->request = (command_request_t)message.request;
    command->speed_reference_q22 = units_speed_q22(message.speed_reference_rpm);
    command->time_us = time_us;
    return COMMANDS_COMMAND;
}

commands_frame_t commands_take(commands_t *commands, const hal_can_frame_t *frame, uint32_t time_us,
                               command_t *command) {
    commands_counters_t *counters = &commands->counters;
    if (frame->extended || frame->remote) {
        return refuse(&counters->unknown_frame);
    }
    if (frame->identifier == DRIVE_COMMAND_FRAME_ID) {
        return take_command(commands, frame, time_us, command);
    }
    if (frame->identifier == DRIVE_PARAMETER_REQUEST_FRAME_ID) {
        if (frame->length != DRIVE_PARAMETER_REQUEST_LENGTH) {
            return refuse(&counters->wrong_length);
        }
        if (frame->data[PARAMETER_REQUEST_RESERVED_BYTE] != 0) {
            return refuse(&counters->out_of_range);
        }
        return COMMANDS_PARAMETER_REQUEST;
    }
    return refuse(&counters->unknown_frame);
}
