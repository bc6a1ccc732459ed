/* Validation of received frames. A frame either passes all checks or changes nothing but the counter of the check that
 * rejected it.
 *
 * Arming (arming.h): while the drive is not armed a request to run is published as off. It takes effect when the arming
 * is completed within the command timeout, or with the next command after it. These disarm: the start of the drive
 * (reset and watchdog included), a fault, the end of a run, off and clear_fault after a run was requested, a stop
 * outside of a run, COMMAND_LOST_US without a valid command, outside of a run the command timeout, and commands_disarm.
 *
 * Second sender: all command messages have one sequence counter, and while the drive is armed the receiver stays with
 * the sender that it followed when it was armed. A frame of another one is invalid, but for the few whose counter is by
 * chance the next; then the first sender's are. Every invalid command frame (length, checksum, counter, range) adds
 * COMMANDS_ERROR_STEP to a count, every valid one takes 1 from it; COMMANDS_ERRORS_MAX invalid ones in succession,
 * or among fewer than COMMANDS_ERROR_STEP valid ones, are the fault command_error. Up to two frames lost in
 * succession are no error; nor is the last accepted frame once more, same counter and same checksum, as a gateway or
 * a disturbed acknowledgement duplicates it: it is dropped and counted. After more lost ones the sender is out of
 * sequence: the drive ends in a fault, and has to be armed again. While the drive is not armed another sender is
 * followed once the present one has been silent for COMMANDS_SENDER_LOST_US, and it is not armed for either until the
 * frames of one of them have not come for so long: after a reset the one that it follows may be a recording. A second
 * sender slower than one frame in COMMANDS_ERROR_STEP of the first (2.56 s at 100 frames per second) has no effect but
 * to be counted.
 *
 * PARAMETER_WRITE and PARAMETER_SET_CONTROL pass while the drive is armed for configuration. Their sequence counter
 * continues confirm_configuration's, whose sender the receiver stays with. They are no commands: invalid ones are
 * counted, but no fault. */
#ifndef COMMS_COMMANDS_H
#define COMMS_COMMANDS_H

#include <stdbool.h>
#include <stdint.h>

#include "comms/arming.h"
#include "comms/e2e.h"
#include "control/identify.h"
#include "hal_can.h"
#include "interrupts/command.h"

#define COMMANDS_ERROR_STEP 256u
#define COMMANDS_ERRORS_MAX 4u

/* Longest time from the arming to a request to run. */
#define COMMANDS_ARMED_UNUSED_US 500000u

/* Silence of the present sender before another one is followed: three frames at 100 per second, more than may be lost.
 * Frames of the past, sent once more in their order, do not take its place meanwhile. */
#define COMMANDS_SENDER_LOST_US 30000u

/* Numbers of frames since start; each counter saturates at 65535. */
typedef struct {
    uint16_t accepted;
    uint16_t unknown_frame;  /* unknown or 29-bit identifier, or remote frame */
    uint16_t wrong_length;   /* known identifier with another length than the DBC's */
    uint16_t wrong_checksum; /* protected frame with a wrong checksum */
    uint16_t wrong_counter;  /* command or frame of a set of parameters repeated or out of sequence */
    uint16_t out_of_range; /* value beyond the DBC's range, index beyond the parameters, or a reserved byte that is not
                              zero */
    uint16_t run_unarmed;  /* request to run while not armed; counted as accepted, too */
} commands_counters_t;

typedef struct {
    e2e_receiver_t receiver;     /* of all commands to run */
    uint16_t data_id_offset;     /* of the node, added to the data IDs of drive.dbc; set by the caller after
                                    commands_init */
    uint32_t last_received_us;   /* time of the last frame that it accepted */
    bool contested;              /* valid commands of another sequence come as well */
    uint32_t contested_us;       /* time of the last one */
    e2e_receiver_t set_receiver; /* of PARAMETER_WRITE and PARAMETER_SET_CONTROL, while armed for configuration */
    arming_t arming;
    uint32_t armed_us;   /* when it was armed */
    bool used;           /* a request to run has taken effect since */
    bool ran;            /* the drive has been in state RUN since */
    bool failed;         /* invalid frames are a fault, and no command ends the run before; the caller clears it */
    uint16_t errors;     /* count of invalid command frames while armed, above */
    drive_state_t state; /* of the last commands_supervise */
    command_t requested; /* last valid command; the published one has off instead of run while not armed */
    identify_command_t identify; /* experiment of COMMAND_IDENTIFY */
    commands_counters_t counters;
} commands_t;

typedef enum {
    COMMANDS_REJECTED,
    COMMANDS_ACCEPTED,
    COMMANDS_COMMAND,
    COMMANDS_XCP, /* an XCP_COMMAND (xcp.h) */
    COMMANDS_PARAMETER_REQUEST,
    COMMANDS_PARAMETER_SET
} commands_frame_t;

/* Clears the counters; not armed; the first valid command is accepted with any sequence counter. */
void commands_init(commands_t *commands);

/* Disarms, and restarts the receiver after more than timeout_us without a command, so that a sender may start again
 * with any counter. state: of the drive. Call it in every round of the background. [background] */
void commands_supervise(commands_t *commands, drive_state_t state, uint32_t time_us, uint32_t timeout_us);

/* Requests to run are refused until the drive is armed again. [background] */
void commands_disarm(commands_t *commands);

/* Checks a received frame. COMMANDS_COMMAND: *command is written. COMMANDS_PARAMETER_REQUEST: a request of the right
 * length, its contents not checked. COMMANDS_PARAMETER_SET: a PARAMETER_WRITE within the DBC's range, or a
 * PARAMETER_SET_CONTROL likewise, which comes while the drive is not armed for configuration, too, for the response.
 * COMMANDS_ACCEPTED: a frame that is no command and needs no response, or a command while failed in RUN.
 * COMMANDS_REJECTED: counted, *command unchanged. hal: its random number generator. [background] */
commands_frame_t commands_receive(commands_t *commands, hal_t *hal, const hal_can_frame_t *frame, uint32_t time_us,
                                  uint32_t timeout_us, command_t *command);

#endif
