/* The operation fault_trace of PARAMETER_REQUEST: reads the control periods before a fault (interrupts/fault_trace.h).
 */
#ifndef COMMS_TRACE_PROTOCOL_H
#define COMMS_TRACE_PROTOCOL_H

#include <stdbool.h>

#include "hal_can.h"
#include "interrupts/control_step.h"
#include "interrupts/fault_trace.h"

/* Executes a request and writes its response; false, with nothing done, when it is one of another operation. The
 * response repeats operation, index and part. frame must have passed commands_receive. [background] */
bool trace_protocol_respond(const fault_trace_t *trace, const control_parameters_t *parameters,
                            const hal_can_frame_t *frame, hal_can_frame_t *response_frame);

#endif
