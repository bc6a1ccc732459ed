/* The drive's side of the bus: commands and parameter requests in, telemetry and parameter responses out.
 *
 * All of it runs in the background. A caller's loop, cheap when nothing is due:
 *
 *     const uint32_t time_us = hal_time_us(hal);
 *     if (comms_telemetry_due(&comms, time_us)) {
 *         ... fill a telemetry_snapshot_t, with the control interrupt kept out ...
 *         comms_telemetry(&comms, hal, &snapshot);
 *     }
 *     if (comms_background(&comms, hal, &parameters, writable, time_us)) {
 *         ... carry out comms.command ...
 *     }
 */
#ifndef COMMS_COMMS_H
#define COMMS_COMMS_H

#include <stdbool.h>
#include <stdint.h>

#include "comms/commands.h"
#include "comms/frame_queue.h"
#include "comms/telemetry.h"
#include "drive/parameters.h"
#include "hal_can.h"

/* Received frames that one call looks at, at most. The shortest frame takes 47 us at 1 Mbit/s, so even a full bus
 * brings fewer than this between two calls at the slowest control rate. */
#define COMMS_FRAMES_PER_CALL 4

typedef struct {
    commands_t commands;
    telemetry_t telemetry;
    frame_queue_t responses; /* to parameter requests */
    command_t command;       /* the command accepted last */
} comms_t;

/* phases 1..4; the first telemetry cycle is due at time_us. */
void comms_init(comms_t *comms, uint8_t phases, uint32_t control_rate_hz, uint32_t time_us);

/* Sends what waits and takes at most COMMS_FRAMES_PER_CALL received frames. True: a command was accepted and stands in
 * comms->command; receiving stops there, so that the caller sees every command, in order.
 *
 * Telemetry goes first, parameter responses when none of it waits. No response is ever dropped: with the queue of
 * responses full nothing is received. That state cannot keep commands out, because PARAMETER_REQUEST loses arbitration
 * against everything the drive waits to send before its heartbeat: responses leave before more requests arrive.
 *
 * `writable`: parameters may be written now. [background] */
bool comms_background(comms_t *comms, hal_t *hal, parameters_t *parameters, bool writable, uint32_t time_us);

/* Whether comms_telemetry is due. [background] */
static inline bool comms_telemetry_due(const comms_t *comms, uint32_t time_us) {
    return telemetry_due(&comms->telemetry, time_us);
}

/* Queues one cycle of telemetry and sends what the mailboxes take. [background] */
void comms_telemetry(comms_t *comms, hal_t *hal, const telemetry_snapshot_t *snapshot);

#endif
