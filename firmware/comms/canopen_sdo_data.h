/* Data and responses of an SDO transfer (canopen_sdo.h). */
#ifndef COMMS_CANOPEN_SDO_DATA_H
#define COMMS_CANOPEN_SDO_DATA_H

#include "comms/canopen_objects.h"

/* Four bytes of a request, low byte first. */
uint32_t canopen_sdo_word(const uint8_t *bytes);

/* Begins a transfer of the object that a request names: its size, and of an upload its bytes. */
uint32_t canopen_sdo_begin(canopen_t *canopen, const canopen_context_t *context, const uint8_t *request, bool download,
                           canopen_object_t *object);

/* Appends bytes of a download; false: more than the object has. */
bool canopen_sdo_put(canopen_t *canopen, const canopen_context_t *context, const uint8_t *data, unsigned count);

/* Bytes of an upload from `offset` on; less at its end. */
unsigned canopen_sdo_get(const canopen_t *canopen, const canopen_context_t *context, uint32_t offset, uint8_t *data,
                         unsigned count);

/* Writes the object of a download that has all its bytes, and ends the transfer. */
uint32_t canopen_sdo_commit(canopen_t *canopen, const canopen_context_t *context);

/* Responses: 8 bytes; command, index and sub-index of the transfer, and a word; and the abort of the transfer. */
void canopen_sdo_send(canopen_t *canopen, const canopen_context_t *context, const uint8_t response[8]);
void canopen_sdo_respond(canopen_t *canopen, const canopen_context_t *context, unsigned command, uint32_t word);
void canopen_sdo_abort(canopen_t *canopen, const canopen_context_t *context, uint32_t code);

#endif
