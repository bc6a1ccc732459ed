/* Cyclic transmission of telemetry.
 *
 * Which message is sent how often, and which messages belong together, is written in drive.dbc (attributes
 * GenMsgCycleTime, GenMsgStartDelayTime, GenMsgSendType and TelemetryGroup). A telemetry cycle is the greatest common
 * divisor of the cycle times; the first cycle after start has every message without a start delay.
 *
 * Frames wait in a queue for one of the three mailboxes. The frames of a group that are due in a cycle are queued
 * together or, when the queue has no room for all of them, dropped together and counted: what waits stays whole and in
 * order, what is missing shows in the cycle number. Frames of the group `fault` are sent only in state fault: in the
 * cycle after the fault, and periodically from there.
 *
 * The frames of the groups `background` and `idle` have the highest identifiers on the bus. While other nodes hold one
 * back it keeps a mailbox, so there is never more than one: others are dropped and counted until it is known to have
 * left. A frame of `idle` is dropped, too, in a cycle that begins with frames of an earlier one in the queue.
 */
#ifndef COMMS_TELEMETRY_H
#define COMMS_TELEMETRY_H

#include <stdbool.h>
#include <stdint.h>

#include "comms/frame_queue.h"
#include "drive_telemetry.h"
#include "hal_can.h"

#define TELEMETRY_CYCLE_US (1000 * DRIVE_TELEMETRY_CYCLE_MS)

typedef struct {
    uint32_t next_us;                             /* when the next cycle is due */
    uint8_t cycle;                                /* number of the next cycle */
    uint16_t countdown[DRIVE_TELEMETRY_MESSAGES]; /* cycles until each message is due */
    bool in_fault;
    uint32_t fault_time_us;         /* of the fault reported last */
    uint32_t background_identifier; /* of the frame that background_queued is about */
    bool background_queued;         /* a frame of `background` or `idle` is in the queue */
    bool background_in_mailbox;     /* one may be in a mailbox */
    uint16_t dropped;               /* frames, since start; saturates at 65535 */
    frame_queue_t queue;
} telemetry_t;

/* The first cycle is due at time_us. */
void telemetry_init(telemetry_t *telemetry, uint32_t time_us);

/* True when a cycle is due. */
static inline bool telemetry_due(const telemetry_t *telemetry, uint32_t time_us) {
    return (int32_t)(time_us - telemetry->next_us) >= 0;
}

/* Queues the frames of one cycle and sets the time of the next one on the grid that began at start; cycles that were
 * missed altogether are left out, but counted in the cycle number. Writes values->bus_counters.telemetry_dropped after
 * the groups of this cycle that precede the counters. [background] */
void telemetry_cycle(telemetry_t *telemetry, drive_telemetry_t *values);

/* Moves waiting frames to the mailboxes until all of them are occupied. [background] */
void telemetry_flush(telemetry_t *telemetry, hal_t *hal);

#endif
