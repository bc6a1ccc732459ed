/* Parameter access over CAN: one PARAMETER_RESPONSE to each PARAMETER_REQUEST. */
#ifndef COMMS_PARAMETER_PROTOCOL_H
#define COMMS_PARAMETER_PROTOCOL_H

#include <stdbool.h>

#include "drive/parameters.h"
#include "hal_can.h"

/* Executes a request and writes its response. The response repeats operation, index and part; a rejected request
 * changes nothing. After a write the response has the value now in effect, accepted or not. Text is transferred four
 * ASCII characters at a time, the first in the lowest byte; a part beyond the end of the text is all zeros. `writable`:
 * writes are permitted now. frame must have passed commands_receive. [background] */
void parameter_protocol_respond(parameters_t *parameters, bool writable, const hal_can_frame_t *frame,
                                hal_can_frame_t *response_frame);

#endif
