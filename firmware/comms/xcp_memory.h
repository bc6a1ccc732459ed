/* Areas of addresses of XCP (xcp.h). */
#ifndef COMMS_XCP_MEMORY_H
#define COMMS_XCP_MEMORY_H

#include "comms/xcp.h"

typedef enum {
    XCP_ERROR_NONE = 0xFF, /* no code of an error: a response */
    XCP_ERROR_BUSY = 0x10,
    XCP_ERROR_DAQ_ACTIVE = 0x11,
    XCP_ERROR_UNKNOWN = 0x20,
    XCP_ERROR_SYNTAX = 0x21,
    XCP_ERROR_OUT_OF_RANGE = 0x22,
    XCP_ERROR_WRITE_PROTECTED = 0x23,
    XCP_ERROR_ACCESS_DENIED = 0x24,
    XCP_ERROR_ACCESS_LOCKED = 0x25,
    XCP_ERROR_MODE_NOT_VALID = 0x27,
    XCP_ERROR_SEQUENCE = 0x29,
    XCP_ERROR_DAQ_CONFIGURATION = 0x2A,
    XCP_ERROR_MEMORY_OVERFLOW = 0x30,
    XCP_ERROR_GENERIC = 0x31,
    XCP_ERROR_SYNCHRONISED = 0x00,
} xcp_error_t;

#define XCP_RESOURCE_CALIBRATION 0x01u
#define XCP_RESOURCE_DAQ 0x04u
#define XCP_RESOURCE_PROGRAMMING 0x10u

/* Bytes from an address on; false, with nothing written, when one of them is out of its area. [background] */
bool xcp_memory_read(const xcp_t *xcp, const parameters_t *parameters, uint32_t address, unsigned bytes, uint8_t *to);

/* Writes a whole word, low byte first, of the parameters or of the set-up of the triggered buffer. [background] */
xcp_error_t xcp_memory_write(xcp_t *xcp, const xcp_context_t *context, uint32_t address, unsigned bytes,
                             const uint8_t *from);

/* Characters of a text, 0..XCP_EVENTS. */
uint8_t xcp_text_length(const xcp_t *xcp, unsigned text);

#endif
