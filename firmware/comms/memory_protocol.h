/* The operations of PARAMETER_REQUEST on the non-volatile memory: save, restore_defaults, memory, fault_log. */
#ifndef COMMS_MEMORY_PROTOCOL_H
#define COMMS_MEMORY_PROTOCOL_H

#include <stdbool.h>

#include "hal_can.h"
#include "interrupts/self_test.h"
#include "storage/nvm_store.h"

/* Writes the response to a request; false when it is one of another operation. The response repeats operation, index
 * and part. Nothing is changed: save and restore_defaults are for PARAMETER_SET_CONTROL. frame must have passed
 * commands_receive. [background] */
bool memory_protocol_respond(const nvm_store_t *store, const self_test_t *test, const hal_t *hal,
                             const hal_can_frame_t *frame, hal_can_frame_t *response_frame);

#endif
