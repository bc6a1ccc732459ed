/* Frames that the drive sends as a CANopen device. */
#ifndef COMMS_CANOPEN_SEND_H
#define COMMS_CANOPEN_SEND_H

#include "comms/canopen_types.h"

/* Queues a frame with `length` bytes of data, 0..8; dropped and counted when there is no room. */
void canopen_send(canopen_t *canopen, const canopen_context_t *context, uint32_t identifier, const uint8_t *data,
                  unsigned length);

/* Lets an emergency wait for canopen_send_emergencies; the oldest of five is lost. fault: of drive.dbc. */
void canopen_emergency(canopen_t *canopen, unsigned code, unsigned fault);

/* Queues the oldest emergency that waits, when its inhibit time has passed. error_register: object 0x1001. */
void canopen_send_emergencies(canopen_t *canopen, const canopen_context_t *context, uint8_t error_register);

#endif
