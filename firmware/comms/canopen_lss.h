/* LSS slave (CiA 305): selection by switch, by identity or by fast scan, node-ID, its storage, identification. The bit
 * rate is the board's. */
#ifndef COMMS_CANOPEN_LSS_H
#define COMMS_CANOPEN_LSS_H

#include "comms/canopen_objects.h"

#define CANOPEN_LSS_REQUEST 0x7E5u

/* Handles a request; not in state operational. A node-ID acts with the next reset communication, which is due when this
 * returns true: a device without one has got it, and the configuration has ended. */
bool canopen_lss_receive(canopen_t *canopen, const canopen_context_t *context, const hal_can_frame_t *frame);

#endif
