/* The SDO server of CiA 301: expedited, segmented and block transfer, one at a time.
 *
 * A request that begins a transfer ends the one before it without effect. Numbers are written when their last byte has
 * come; the parameter set is staged meanwhile, and checked and applied then. A transfer without a request for
 * CANOPEN_SDO_SILENT_US has ended: in a block download any other request would be a segment.
 */
#ifndef COMMS_CANOPEN_SDO_H
#define COMMS_CANOPEN_SDO_H

#include "comms/canopen_objects.h"

#define CANOPEN_SDO_REQUEST 0x600u
#define CANOPEN_SDO_SILENT_US 1000000u

/* Handles a request. */
void canopen_sdo_receive(canopen_t *canopen, const canopen_context_t *context, const hal_can_frame_t *frame);

/* Queues segments of a block upload while there is room. */
void canopen_sdo_step(canopen_t *canopen, const canopen_context_t *context);

#endif
