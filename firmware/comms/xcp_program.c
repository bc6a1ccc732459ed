/* [SR-61] */
#include "comms/xcp_program.h"

#include <stddef.h>

#include "comms/xcp_code.h"

enum { MESSAGE_BYTES = 8, ABSOLUTE = 0 };

static xcp_error_t start(xcp_t *xcp, const xcp_context_t *context, uint8_t *response, uint8_t *length) {
    if (xcp->daq.running) {
        return XCP_ERROR_DAQ_ACTIVE;
    }
    if (context->conditions->running) {
        return XCP_ERROR_GENERIC; /* as the standard has it */
    }
    xcp->programming = true;
    for (unsigned i = 1; i < MESSAGE_BYTES - 1u; i++) {
        response[i] = 0;
    }
    response[3] = MESSAGE_BYTES; /* neither blocks nor a queue */
    *length = MESSAGE_BYTES - 1u;
    return XCP_ERROR_NONE;
}

static xcp_error_t clear(xcp_t *xcp, const hal_t *hal, table_store_t *tables, const uint8_t *command) {
    if (command[1] != ABSOLUTE || xcp->address != XCP_AREA_TABLES || xcp_get_word(command + 4) != TABLE_STORE_BYTES) {
        return XCP_ERROR_OUT_OF_RANGE;
    }
    table_store_begin(tables, hal);
    xcp->pending = true;
    return XCP_ERROR_NONE;
}

static xcp_error_t program(xcp_t *xcp, table_store_t *tables, const uint8_t *command) {
    const unsigned bytes = command[1];
    if (bytes == 0) {
        xcp->pending = table_store_end(tables);
        return xcp->pending ? XCP_ERROR_NONE : XCP_ERROR_SEQUENCE;
    }
    if (xcp->address != XCP_AREA_TABLES + tables->taken) {
        return XCP_ERROR_OUT_OF_RANGE;
    }
    if (!table_store_take(tables, command + 2, bytes)) {
        return tables->state == TABLE_STORE_TAKING ? XCP_ERROR_OUT_OF_RANGE : XCP_ERROR_SEQUENCE;
    }
    xcp->address += bytes;
    xcp->pending = table_store_busy(tables);
    return XCP_ERROR_NONE;
}

xcp_error_t xcp_program_command(xcp_t *xcp, const hal_t *hal, const xcp_context_t *context, const uint8_t *command,
                                uint8_t *response, uint8_t *length) {
    if ((xcp->unlocked & XCP_RESOURCE_PROGRAMMING) == 0) {
        return XCP_ERROR_ACCESS_LOCKED;
    }
    if (command[0] == PROGRAM_START) {
        return start(xcp, context, response, length);
    }
    if (!xcp->programming) {
        return XCP_ERROR_SEQUENCE;
    }
    return command[0] == PROGRAM_CLEAR ? clear(xcp, hal, context->tables, command)
                                       : program(xcp, context->tables, command);
}

bool xcp_program_done(xcp_t *xcp, const table_store_t *tables, xcp_error_t *error) {
    if (!xcp->pending || tables == NULL || table_store_busy(tables)) {
        return false;
    }
    xcp->pending = false;
    *error = tables->state == TABLE_STORE_FAILED ? XCP_ERROR_GENERIC : XCP_ERROR_NONE;
    return true;
}
