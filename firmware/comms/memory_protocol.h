/* The operations of PARAMETER_REQUEST on the non-volatile memory: save, restore_defaults, memory, fault_log. */
#ifndef COMMS_MEMORY_PROTOCOL_H
#define COMMS_MEMORY_PROTOCOL_H

#include <stdbool.h>

#include "drive/nvm_store.h"
#include "drive/parameters.h"
#include "hal_can.h"

/* Executes a request and writes its response; false, with nothing done, when it is one of another operation. The
 * response repeats operation, index and part. Saving goes on in the background (nvm_store_step). `writable`: the drive
 * does not run. frame must have passed commands_receive. [background] */
bool memory_protocol_respond(nvm_store_t *store, const hal_t *hal, parameters_t *parameters, bool writable,
                             const hal_can_frame_t *frame, hal_can_frame_t *response_frame);

#endif
