/* Codes of the commands of XCP, and access to the bytes of its messages, low byte first (xcp.h). */
#ifndef COMMS_XCP_CODE_H
#define COMMS_XCP_CODE_H

#include <stdint.h>

enum {
    PROGRAM_RESET = 0xCF, /* the first of the group PGM */
    PROGRAM = 0xD0,
    PROGRAM_CLEAR = 0xD1,
    PROGRAM_START = 0xD2,
    ALLOC_ODT_ENTRY = 0xD3, /* the first of the group DAQ */
    ALLOC_ODT = 0xD4,
    ALLOC_DAQ = 0xD5,
    FREE_DAQ = 0xD6,
    GET_DAQ_EVENT_INFO = 0xD7,
    GET_DAQ_LIST_INFO = 0xD8,
    GET_DAQ_RESOLUTION_INFO = 0xD9,
    GET_DAQ_PROCESSOR_INFO = 0xDA,
    GET_DAQ_CLOCK = 0xDC,
    START_STOP_SYNCH = 0xDD,
    START_STOP_DAQ_LIST = 0xDE,
    GET_DAQ_LIST_MODE = 0xDF,
    SET_DAQ_LIST_MODE = 0xE0,
    WRITE_DAQ = 0xE1,
    SET_DAQ_PTR = 0xE2,
    CLEAR_DAQ_LIST = 0xE3, /* the last one */
    DOWNLOAD = 0xF0,
    SHORT_UPLOAD = 0xF4,
    UPLOAD = 0xF5,
    SET_MTA = 0xF6,
    UNLOCK = 0xF7,
    GET_SEED = 0xF8,
    SET_REQUEST = 0xF9,
    GET_ID = 0xFA,
    GET_COMM_MODE_INFO = 0xFB,
    SYNCH = 0xFC,
    GET_STATUS = 0xFD,
    DISCONNECT = 0xFE,
    CONNECT = 0xFF,
};

static inline uint16_t xcp_get_half_word(const uint8_t *at) {
    return (uint16_t)(at[0] | at[1] << 8);
}

static inline uint32_t xcp_get_word(const uint8_t *at) {
    return xcp_get_half_word(at) | (uint32_t)xcp_get_half_word(at + 2) << 16;
}

static inline void xcp_put_half_word(uint8_t *at, uint32_t value) {
    at[0] = (uint8_t)value;
    at[1] = (uint8_t)(value >> 8);
}

static inline void xcp_put_word(uint8_t *at, uint32_t value) {
    xcp_put_half_word(at, value);
    xcp_put_half_word(at + 2, value >> 16);
}

#endif
