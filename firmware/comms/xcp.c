#include "comms/xcp.h"

#include "comms/arming.h"
#include "comms/xcp_code.h"
#include "comms/xcp_daq.h"
#include "comms/xcp_memory.h"
#include "comms/xcp_program.h"
#include "drive_codec.h"
#include "fixed/fixed.h"
#include "hal_random.h"

enum { RESPONSE = 0xFF, ERROR = 0xFE };
enum { ID_TEXT = 0, ID_FILE_NAME = 1, ID_EPK = 5 };
enum { MESSAGE_BYTES = 8, DATA_BYTES = MESSAGE_BYTES - 1, DOWNLOAD_BYTES = MESSAGE_BYTES - 2, KEY_BYTES = 4 };

#define COMM_MODE 0xC0u     /* low byte first, addresses of bytes, UPLOAD in blocks, more by GET_COMM_MODE_INFO */
#define PROTOCOL_VERSION 1u /* of protocol and transport layer */
#define STORE_CAL 0x01u
#define STATUS_DAQ 0x40u
#define DRIVER_VERSION 0x10u

typedef struct {
    uint8_t data[MESSAGE_BYTES];
    uint8_t length;
} message_t;

/* Bytes of a command without data and keys of a count of its own; 0: one. Codes are unique in their lower six bits. */
#define COMMAND_INDEX 0x3F
static const uint8_t least_bytes[COMMAND_INDEX + 1] = {
    [PROGRAM_RESET & COMMAND_INDEX] = 1,
    [PROGRAM & COMMAND_INDEX] = 2,
    [PROGRAM_CLEAR & COMMAND_INDEX] = 8,
    [PROGRAM_START & COMMAND_INDEX] = 1,
    [ALLOC_ODT_ENTRY & COMMAND_INDEX] = 6,
    [ALLOC_ODT & COMMAND_INDEX] = 5,
    [ALLOC_DAQ & COMMAND_INDEX] = 4,
    [GET_DAQ_EVENT_INFO & COMMAND_INDEX] = 4,
    [GET_DAQ_LIST_INFO & COMMAND_INDEX] = 4,
    [START_STOP_SYNCH & COMMAND_INDEX] = 2,
    [START_STOP_DAQ_LIST & COMMAND_INDEX] = 4,
    [GET_DAQ_LIST_MODE & COMMAND_INDEX] = 4,
    [SET_DAQ_LIST_MODE & COMMAND_INDEX] = 7,
    [WRITE_DAQ & COMMAND_INDEX] = 8,
    [SET_DAQ_PTR & COMMAND_INDEX] = 6,
    [DOWNLOAD & COMMAND_INDEX] = 2,
    [SHORT_UPLOAD & COMMAND_INDEX] = 8,
    [UPLOAD & COMMAND_INDEX] = 2,
    [SET_MTA & COMMAND_INDEX] = 8,
    [UNLOCK & COMMAND_INDEX] = 2,
    [GET_SEED & COMMAND_INDEX] = 3,
    [SET_REQUEST & COMMAND_INDEX] = 4,
    [GET_ID & COMMAND_INDEX] = 2,
    [CONNECT & COMMAND_INDEX] = 2,
};

static bool is_whole(const uint8_t *command, unsigned bytes) {
    const bool counted = command[0] == DOWNLOAD || command[0] == UNLOCK || command[0] == PROGRAM;
    const unsigned least = command[0] < PROGRAM_RESET ? 0 : least_bytes[command[0] & COMMAND_INDEX];
    return bytes >= least + (counted ? fixed_min_u32(command[1], DOWNLOAD_BYTES) : 0);
}

void xcp_init(xcp_t *xcp, const void *memory, uint32_t words, sampler_t *sampler) {
    *xcp = (xcp_t){0};
    xcp_attach(xcp, memory, words, sampler);
}

void xcp_attach(xcp_t *xcp, const void *memory, uint32_t words, sampler_t *sampler) {
    xcp->memory = memory;
    xcp->words = words;
    xcp->sampler = sampler;
}

static void end_session(xcp_t *xcp) {
    xcp_daq_stop(xcp);
    xcp->daq = (xcp_daq_t){0};
    xcp->connected = false;
    xcp->unlocked = 0;
    xcp->seed = 0;
    xcp->upload_left = 0;
    xcp->programming = false;
    xcp->pending = false;
}

/* That can be unlocked. */
static uint8_t resources_of(const xcp_context_t *context) {
    const uint8_t always = XCP_RESOURCE_CALIBRATION | XCP_RESOURCE_DAQ;
    return context->tables != NULL ? always | XCP_RESOURCE_PROGRAMMING : always;
}

static void respond(message_t *response, const uint8_t *bytes, uint8_t count) {
    for (unsigned i = 0; i < count; i++) {
        response->data[1 + i] = bytes[i];
    }
    response->length = (uint8_t)(1 + count);
}

static xcp_error_t connect(xcp_t *xcp, const xcp_context_t *context, message_t *response) {
    end_session(xcp);
    xcp->connected = true;
    const uint8_t bytes[] = {resources_of(context), COMM_MODE,       MESSAGE_BYTES, MESSAGE_BYTES, 0,
                             PROTOCOL_VERSION,      PROTOCOL_VERSION};
    respond(response, bytes, sizeof bytes);
    return XCP_ERROR_NONE;
}

static xcp_error_t get_status(const xcp_t *xcp, const xcp_context_t *context, message_t *response) {
    const bool saving = context->store->saving == NVM_STORE_SAVING;
    const unsigned status = (xcp->daq.running ? STATUS_DAQ : 0) | (saving ? STORE_CAL : 0);
    const uint8_t bytes[] = {(uint8_t)status, (uint8_t)(resources_of(context) & ~xcp->unlocked), 0, 0, 0};
    respond(response, bytes, sizeof bytes);
    return XCP_ERROR_NONE;
}

/* One text serves as description, as name of the A2L file and as EPK; other types of identification there are not. */
static xcp_error_t get_id(xcp_t *xcp, const uint8_t *command, message_t *response) {
    const bool has = command[1] == ID_TEXT || command[1] == ID_FILE_NAME || command[1] == ID_EPK;
    const uint8_t bytes[] = {0, 0, 0, has ? xcp_text_length(xcp, 0) : 0, 0, 0, 0};
    respond(response, bytes, sizeof bytes);
    xcp->address = XCP_AREA_TEXT;
    return XCP_ERROR_NONE;
}

static xcp_error_t get_seed(xcp_t *xcp, hal_t *hal, const xcp_context_t *context, const uint8_t *command,
                            uint32_t time_us, message_t *response) {
    if (command[1] != 0 || (command[2] & resources_of(context)) == 0 || (command[2] & (command[2] - 1u)) != 0) {
        return XCP_ERROR_OUT_OF_RANGE;
    }
    uint8_t bytes[1 + KEY_BYTES] = {0}; /* 0: it is unlocked */
    if ((xcp->unlocked & command[2]) == 0) {
        const uint32_t random = hal_random_u32(hal);
        xcp->seed = random != 0 ? random : 1;
        xcp->seed_us = time_us;
        xcp->seed_resource = command[2];
        bytes[0] = KEY_BYTES;
        xcp_put_word(bytes + 1, xcp->seed);
    }
    respond(response, bytes, sizeof bytes);
    return XCP_ERROR_NONE;
}

static xcp_error_t unlock(xcp_t *xcp, const xcp_context_t *context, const uint8_t *command, uint32_t time_us,
                          message_t *response) {
    const uint32_t seed = xcp->seed;
    xcp->seed = 0;
    if (seed == 0) {
        return XCP_ERROR_SEQUENCE;
    }
    if (command[1] != KEY_BYTES || xcp_get_word(command + 2) != ~seed ||
        time_us - xcp->seed_us > ARMING_RESPONSE_MAX_US) {
        end_session(xcp); /* as the standard asks */
        return XCP_ERROR_ACCESS_LOCKED;
    }
    xcp->unlocked |= xcp->seed_resource;
    const uint8_t locked = (uint8_t)(resources_of(context) & ~xcp->unlocked);
    respond(response, &locked, 1);
    return XCP_ERROR_NONE;
}

static xcp_error_t set_request(const xcp_t *xcp, const xcp_context_t *context, const uint8_t *command) {
    if (command[1] != STORE_CAL) {
        return XCP_ERROR_OUT_OF_RANGE;
    }
    if ((xcp->unlocked & XCP_RESOURCE_CALIBRATION) == 0) {
        return XCP_ERROR_ACCESS_LOCKED;
    }
    if (context->conditions->running || !parameters_intact(context->parameters)) {
        return XCP_ERROR_ACCESS_DENIED;
    }
    parameter_store_save(context->store);
    return XCP_ERROR_NONE;
}

static xcp_error_t download(xcp_t *xcp, const xcp_context_t *context, const uint8_t *command) {
    const unsigned bytes = command[1];
    if (bytes == 0 || bytes > DOWNLOAD_BYTES) {
        return XCP_ERROR_OUT_OF_RANGE;
    }
    const xcp_error_t error = xcp_memory_write(xcp, context, xcp->address, bytes, command + 2);
    xcp->address += error == XCP_ERROR_NONE ? bytes : 0;
    return error;
}

/* The first frame of an UPLOAD; the others follow by xcp_next_frame(). */
static xcp_error_t upload(xcp_t *xcp, const parameters_t *parameters, unsigned bytes, message_t *response) {
    uint8_t data[DATA_BYTES];
    const uint8_t now = (uint8_t)(bytes < DATA_BYTES ? bytes : DATA_BYTES);
    uint8_t last;
    if (bytes == 0 || !xcp_memory_read(xcp, parameters, xcp->address + bytes - 1u, 1, &last) ||
        !xcp_memory_read(xcp, parameters, xcp->address, now, data)) {
        return XCP_ERROR_OUT_OF_RANGE;
    }
    respond(response, data, now);
    xcp->address += now;
    xcp->upload_left = (uint8_t)(bytes - now);
    return XCP_ERROR_NONE;
}

/* There is no address extension. */
static xcp_error_t set_address(xcp_t *xcp, const uint8_t *command) {
    if (command[3] != 0) {
        return XCP_ERROR_OUT_OF_RANGE;
    }
    xcp->address = xcp_get_word(command + 4);
    return XCP_ERROR_NONE;
}

static xcp_error_t short_upload(xcp_t *xcp, const parameters_t *parameters, const uint8_t *command,
                                message_t *response) {
    if (command[1] > DATA_BYTES || command[3] != 0) {
        return XCP_ERROR_OUT_OF_RANGE;
    }
    xcp->address = xcp_get_word(command + 4);
    return upload(xcp, parameters, command[1], response);
}

/* Commands of the groups PGM and DAQ. */
static xcp_error_t execute_optional(xcp_t *xcp, const hal_t *hal, const uint8_t *command, const xcp_context_t *context,
                                    message_t *response) {
    if (command[0] < PROGRAM_RESET || command[0] >= ALLOC_ODT_ENTRY) {
        return xcp_daq_command(xcp, command, response->data, &response->length);
    }
    if (context->tables == NULL) {
        return XCP_ERROR_UNKNOWN;
    }
    if (command[0] == PROGRAM_RESET) {
        end_session(xcp);
        return XCP_ERROR_NONE;
    }
    return xcp_program_command(xcp, hal, context, command, response->data, &response->length);
}

static xcp_error_t execute(xcp_t *xcp, hal_t *hal, const uint8_t *command, unsigned bytes, const xcp_context_t *context,
                           uint32_t time_us, message_t *response) {
    if (!is_whole(command, bytes)) {
        return XCP_ERROR_SYNTAX;
    }
    switch (command[0]) {
    case CONNECT:
        return connect(xcp, context, response);
    case DISCONNECT:
        end_session(xcp);
        return XCP_ERROR_NONE;
    case GET_STATUS:
        return get_status(xcp, context, response);
    case SYNCH:
        return XCP_ERROR_SYNCHRONISED;
    case GET_COMM_MODE_INFO:
        response->data[7] = DRIVER_VERSION;
        response->length = MESSAGE_BYTES;
        return XCP_ERROR_NONE;
    case GET_ID:
        return get_id(xcp, command, response);
    case SET_REQUEST:
        return set_request(xcp, context, command);
    case GET_SEED:
        return get_seed(xcp, hal, context, command, time_us, response);
    case UNLOCK:
        return unlock(xcp, context, command, time_us, response);
    case SET_MTA:
        return set_address(xcp, command);
    case UPLOAD:
        return upload(xcp, context->parameters, command[1], response);
    case SHORT_UPLOAD:
        return short_upload(xcp, context->parameters, command, response);
    case DOWNLOAD:
        return download(xcp, context, command);
    default:
        return execute_optional(xcp, hal, command, context, response);
    }
}

/* While a command waits for the memory: those that end the session or ask for nothing. */
static bool interrupts_programming(uint8_t code) {
    return code == CONNECT || code == DISCONNECT || code == SYNCH;
}

static void write_response(hal_can_frame_t *frame, const message_t *response, xcp_error_t error) {
    const message_t refused = {.data = {ERROR, (uint8_t)error}, .length = 2};
    const message_t *sent = error == XCP_ERROR_NONE ? response : &refused;
    *frame = (hal_can_frame_t){.identifier = DRIVE_XCP_RESPONSE_FRAME_ID, .length = sent->length};
    for (unsigned i = 0; i < sent->length; i++) {
        frame->data[i] = sent->data[i];
    }
}

bool xcp_late_response(xcp_t *xcp, const table_store_t *tables, hal_can_frame_t *response) {
    xcp_error_t error;
    if (!xcp_program_done(xcp, tables, &error)) {
        return false;
    }
    write_response(response, &(message_t){.data = {RESPONSE}, .length = 1}, error);
    return true;
}

bool xcp_receive(xcp_t *xcp, hal_t *hal, const hal_can_frame_t *frame, const xcp_context_t *context, uint32_t time_us,
                 hal_can_frame_t *response_frame) {
    if (frame->length == 0 || frame->length > MESSAGE_BYTES) {
        return false;
    }
    uint8_t command[MESSAGE_BYTES] = {0};
    for (unsigned i = 0; i < frame->length; i++) {
        command[i] = frame->data[i];
    }
    const bool connects = command[0] == CONNECT && is_whole(command, frame->length);
    if (!connects && !xcp->connected) { /* silent, as the standard asks */
        return false;
    }
    xcp->received_us = time_us;
    xcp->upload_left = 0; /* of an UPLOAD that the master has given up */
    message_t response = {.data = {RESPONSE}, .length = 1};
    const xcp_error_t error = xcp->pending && !interrupts_programming(command[0])
                                  ? XCP_ERROR_BUSY
                                  : execute(xcp, hal, command, frame->length, context, time_us, &response);
    write_response(response_frame, &response, error);
    return error != XCP_ERROR_NONE || !xcp->pending;
}

void xcp_supervise(xcp_t *xcp, bool bus_off, uint32_t time_us) {
    const bool silent = time_us - xcp->received_us > XCP_SILENT_US;
    if (xcp->connected && (bus_off || (silent && !xcp->daq.running))) {
        end_session(xcp);
    } else if (silent) { /* a master that measures sends nothing else */
        xcp->unlocked &= XCP_RESOURCE_DAQ;
    }
    if (time_us - xcp->seed_us > XCP_SILENT_US) { /* its age is known modulo 2^32 us only */
        xcp->seed = 0;
    }
}

bool xcp_next_frame(xcp_t *xcp, const parameters_t *parameters, bool transmitting, hal_can_frame_t *frame) {
    *frame = (hal_can_frame_t){.identifier = DRIVE_XCP_RESPONSE_FRAME_ID};
    if (xcp->upload_left > 0) {
        const uint8_t now = xcp->upload_left < DATA_BYTES ? xcp->upload_left : DATA_BYTES;
        frame->data[0] = RESPONSE;
        frame->length = (uint8_t)(1 + now);
        xcp->upload_left = (uint8_t)(xcp->upload_left - now);
        const bool read = xcp_memory_read(xcp, parameters, xcp->address, now, frame->data + 1);
        xcp->address += now;
        return read;
    }
    return xcp->daq.running && !transmitting && xcp_daq_next_frame(xcp, frame);
}
