/* LSS slave (CiA 305): selection by switch or by identity, node-ID, its storage, identification. The bit rate is the
 * board's; the node-ID is never an unconfigured device's, so that fast scan finds none. */
#ifndef COMMS_CANOPEN_LSS_H
#define COMMS_CANOPEN_LSS_H

#include "comms/canopen_objects.h"

#define CANOPEN_LSS_REQUEST 0x7E5u

/* Handles a request; not in state operational. A node-ID acts with the next reset communication. */
void canopen_lss_receive(canopen_t *canopen, const canopen_context_t *context, const hal_can_frame_t *frame);

#endif
