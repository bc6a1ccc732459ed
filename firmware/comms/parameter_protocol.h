/* Reading the parameters over CAN: one PARAMETER_RESPONSE to each PARAMETER_REQUEST. */
#ifndef COMMS_PARAMETER_PROTOCOL_H
#define COMMS_PARAMETER_PROTOCOL_H

#include "hal_can.h"
#include "storage/parameters.h"

/* Writes the response to a request, which it repeats with operation, index and part; nothing is changed by any request.
 * Text is transferred four ASCII characters at a time, the first in the lowest byte; a part beyond the end of the text
 * is all zeros. frame must have passed commands_receive. [background] */
void parameter_protocol_respond(const parameters_t *parameters, const hal_can_frame_t *frame,
                                hal_can_frame_t *response_frame);

#endif
