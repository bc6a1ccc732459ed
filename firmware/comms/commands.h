/* Which received frames the drive believes. Every frame passes all checks or changes nothing but the counter of the
 * check that refused it. */
#ifndef COMMS_COMMANDS_H
#define COMMS_COMMANDS_H

#include <stdint.h>

#include "comms/e2e.h"
#include "drive/command.h"
#include "hal_can.h"

/* Known to both ends of DRIVE_COMMAND and part of its checksum. */
#define COMMANDS_DATA_ID 0x5A1E

/* Since start; each holds at 65535. */
typedef struct {
    uint16_t accepted;
    uint16_t unknown_frame;  /* no identifier of ours, a 29-bit one, or a remote frame */
    uint16_t wrong_length;   /* an identifier of ours with another length than the DBC's */
    uint16_t wrong_checksum; /* of a command */
    uint16_t wrong_counter;  /* of a command: repeated or out of sequence */
    uint16_t out_of_range;   /* a value beyond the DBC's range, or a reserved byte that is not zero */
} commands_counters_t;

typedef struct {
    e2e_receiver_t receiver;
    uint32_t heard_us; /* when the receiver accepted a frame last */
    commands_counters_t counters;
} commands_t;

typedef enum { COMMANDS_REFUSED, COMMANDS_COMMAND, COMMANDS_PARAMETER_REQUEST } commands_frame_t;

/* Counters zero; the first good command is accepted whatever its counter. */
void commands_init(commands_t *commands);

/* Lets a sender that fell silent for longer than timeout_us start again with any counter. Call it at least once in 35
 * minutes, half a turn of the clock. [background] */
void commands_watch(commands_t *commands, uint32_t time_us, uint32_t timeout_us);

/* Checks a received frame. COMMANDS_COMMAND: *command is written. COMMANDS_PARAMETER_REQUEST: a well-formed request,
 * not looked into. COMMANDS_REFUSED: counted, *command left alone. [background] */
commands_frame_t commands_take(commands_t *commands, const hal_can_frame_t *frame, uint32_t time_us,
                               command_t *command);

#endif
