/* The DAQ list of XCP (xcp.h): its allocation, and the frames of its records. */
#ifndef COMMS_XCP_DAQ_H
#define COMMS_XCP_DAQ_H

#include "comms/xcp.h"
#include "comms/xcp_memory.h"

/* Executes a command of the group DAQ, whole, of 8 bytes with zeros behind those that have come. response: 8 bytes, the
 * first one written by the caller; length of it is written as well. XCP_ERROR_UNKNOWN: a command of another group.
 * [background] */
xcp_error_t xcp_daq_command(xcp_t *xcp, const uint8_t *command, uint8_t *response, uint8_t *length);

/* Stops measuring. [background] */
void xcp_daq_stop(xcp_t *xcp);

/* The next frame of a record; false when there is none. [background] */
bool xcp_daq_next_frame(xcp_t *xcp, hal_can_frame_t *frame);

#endif
