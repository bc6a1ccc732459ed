/* Parameters over CAN: PARAMETER_REQUEST in, PARAMETER_RESPONSE out. */
#ifndef COMMS_PARAMETER_PROTOCOL_H
#define COMMS_PARAMETER_PROTOCOL_H

#include <stdbool.h>

#include "drive/parameters.h"
#include "hal_can.h"

/* Carries out the request and writes its answer. The answer repeats operation, index and part; a refused request
 * changes nothing. After a write its value is the one that now holds, accepted or not. Text comes four ASCII characters
 * at a time, the first in the lowest byte; a part beyond the end of the text is all zeros. `writable`: writes are
 * allowed now. request must have come through commands_take. [background] */
void parameter_protocol_answer(parameters_t *parameters, bool writable, const hal_can_frame_t *request,
                               hal_can_frame_t *response);

#endif
