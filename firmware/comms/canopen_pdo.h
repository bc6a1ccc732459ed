/* Process data: four receive and four transmit PDOs with free mapping, and SYNC.
 *
 * A receive PDO is taken as a whole: when one of its values cannot be written none is. Its transmission type says when:
 * at once, or with the next SYNC. A transmit PDO is sent after a change of its data, with its event timer, or with a
 * SYNC; not more often than a telemetry cycle of 1 ms and its inhibit time. State operational only.
 */
#ifndef COMMS_CANOPEN_PDO_H
#define COMMS_CANOPEN_PDO_H

#include "comms/canopen_objects.h"

/* Takes a receive PDO, the first one of an identifier; false: no PDO has it. */
bool canopen_pdo_receive(canopen_t *canopen, const canopen_context_t *context, const hal_can_frame_t *frame);

/* A SYNC has been received. */
void canopen_pdo_sync(canopen_t *canopen, const canopen_context_t *context);

/* Queues the transmit PDOs that are due; a receive PDO whose event timer has run out is the loss of the master. */
void canopen_pdo_step(canopen_t *canopen, const canopen_context_t *context);

#endif
