/* Validation of received frames. A frame either passes all checks or changes nothing but the counter of the check that
 * rejected it. */
#ifndef COMMS_COMMANDS_H
#define COMMS_COMMANDS_H

#include <stdint.h>

#include "comms/e2e.h"
#include "drive/command.h"
#include "hal_can.h"

/* Numbers of frames since start; each counter saturates at 65535. */
typedef struct {
    uint16_t accepted;
    uint16_t unknown_frame;  /* unknown or 29-bit identifier, or remote frame */
    uint16_t wrong_length;   /* known identifier with another length than the DBC's */
    uint16_t wrong_checksum; /* command with a wrong checksum */
    uint16_t wrong_counter;  /* command repeated or out of sequence */
    uint16_t out_of_range;   /* value beyond the DBC's range, or a reserved byte that is not zero */
} commands_counters_t;

typedef struct {
    e2e_receiver_t receiver;        /* of DRIVE_COMMAND */
    e2e_receiver_t torque_receiver; /* of DRIVE_TORQUE_COMMAND */
    uint32_t last_received_us;      /* time of the last frame that one of them accepted */
    commands_counters_t counters;
} commands_t;

typedef enum { COMMANDS_REJECTED, COMMANDS_COMMAND, COMMANDS_PARAMETER_REQUEST } commands_frame_t;

/* Clears the counters; the first valid command is accepted with any sequence counter. */
void commands_init(commands_t *commands);

/* Restarts the receivers after more than timeout_us without a command, so that a sender may start again with any
 * counter. Call it at least once in 35 minutes, half the period of the clock. [background] */
void commands_check_timeout(commands_t *commands, uint32_t time_us, uint32_t timeout_us);

/* Checks a received frame. COMMANDS_COMMAND: *command is written. COMMANDS_PARAMETER_REQUEST: a request of the right
 * length, its contents not checked. COMMANDS_REJECTED: counted, *command unchanged. [background] */
commands_frame_t commands_receive(commands_t *commands, const hal_can_frame_t *frame, uint32_t time_us,
                                  command_t *command);

#endif
