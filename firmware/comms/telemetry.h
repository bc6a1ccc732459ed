/* Cyclic transmission of telemetry.
 *
 * Which message is sent how often, and which messages belong together, is written in drive.dbc (attributes
 * GenMsgCycleTime, GenMsgStartDelayTime, GenMsgSendType, TelemetryGroup and TelemetryRate). A telemetry cycle is the
 * greatest common divisor of the cycle times, 1 ms; the first cycle after start has every message without a start
 * delay. The messages of a TelemetryRate but `fixed` have a common period that parameters set; a new one counts from
 * their last frame on.
 *
 * Overload, in this order: telemetry gives way to commands and responses of other nodes by its identifiers; what the
 * bus does not take is dropped, as follows; the heartbeat stays.
 *
 * Frames wait in a queue for one of the three mailboxes. The frames of a group that are due in a cycle are queued
 * together or, when the queue has no room for all of them, dropped together and counted: what waits stays whole and in
 * order, what is missing shows in the cycle number. One place is kept for a heartbeat. Frames of the group `fault` are
 * sent only in state fault: in the cycle after the fault, and periodically from there.
 *
 * The frames of the groups `background` and `idle` have the highest identifiers on the bus. While other nodes hold one
 * back it keeps a mailbox, so there is never more than one: others are dropped and counted until it is known to have
 * left. A frame of `idle` is dropped, too, in a cycle that begins with frames of an earlier one in the queue. In such a
 * cycle the drive's own telemetry may be what holds the heartbeat back: TELEMETRY_PATIENCE_US after it has entered a
 * mailbox telemetry pauses for TELEMETRY_PAUSE_US. When other nodes fill the bus meanwhile, it pauses again after as
 * long, until the heartbeat is known to have left.
 */
#ifndef COMMS_TELEMETRY_H
#define COMMS_TELEMETRY_H

#include <stdbool.h>
#include <stdint.h>

#include "comms/frame_queue.h"
#include "drive_telemetry.h"
#include "hal_can.h"

#define TELEMETRY_CYCLE_US (1000 * DRIVE_TELEMETRY_CYCLE_MS)
#define TELEMETRY_PATIENCE_US 10000u
#define TELEMETRY_PAUSE_US 4000u /* the three mailboxes at 125 kbit/s, 135 bits each, and a frame of another node */

typedef struct {
    uint32_t next_us;                             /* when the next cycle is due */
    uint32_t identifier_offset;                   /* of the node */
    uint8_t cycle;                                /* number of the next cycle */
    uint16_t period[DRIVE_TELEMETRY_RATES];       /* cycles; not of `fixed` */
    uint16_t countdown[DRIVE_TELEMETRY_MESSAGES]; /* cycles until each message is due */
    bool in_fault;
    bool position_used;         /* position mode has been used since the start: its messages are sent */
    uint32_t fault_time_us;     /* of the fault reported last */
    bool background_queued;     /* a frame of `background` or `idle` is in the queue */
    bool background_in_mailbox; /* one may be in a mailbox; cleared by the caller when none is taken */
    bool backlog;               /* the present cycle began with frames of an earlier one in the queue */
    uint32_t background_us;     /* when one entered a mailbox last, or the end of the last pause without success */
    uint16_t dropped;           /* frames, since start; saturates at 65535 */
    frame_queue_t queue;
} telemetry_t;

/* The first cycle is due at time_us; periods as in drive.dbc. */
void telemetry_init(telemetry_t *telemetry, uint32_t identifier_offset, uint32_t time_us);

/* Sets the period of the messages of a rate, not `fixed`, in cycles, 1..1000. [background] */
void telemetry_set_period(telemetry_t *telemetry, drive_telemetry_rate_t rate, unsigned period);

/* True when a cycle is due. No cycle is further ahead than one: such a time has changed in memory. */
static inline bool telemetry_due(const telemetry_t *telemetry, uint32_t time_us) {
    return telemetry->next_us - time_us - 1u >= TELEMETRY_CYCLE_US;
}

/* Queues the frames of one cycle and sets the time of the next one on the grid that began at start; cycles that were
 * missed altogether are left out, but counted in the cycle number. Writes values->bus_counters.telemetry_dropped after
 * the groups of this cycle that precede the counters. [background] */
void telemetry_cycle(telemetry_t *telemetry, drive_telemetry_t *values);

/* Sets the time of the next cycle alone, as telemetry_cycle does. time_us: of the values of this one. [background] */
void telemetry_advance(telemetry_t *telemetry, uint32_t time_us);

/* True while the mailboxes are to run empty, so that the heartbeat leaves. [background] */
bool telemetry_pauses(telemetry_t *telemetry, uint32_t time_us);

/* Moves waiting frames to the mailboxes until all of them are occupied. [background] */
void telemetry_flush(telemetry_t *telemetry, hal_t *hal, uint32_t time_us);

#endif
