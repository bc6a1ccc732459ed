#include "comms/canopen_sdo_data.h"

#include <string.h>

#include "comms/canopen_send.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"

#define RESPONSE_ID 0x580u
#define ABORT 0x80u

COLD uint32_t canopen_sdo_word(const uint8_t *bytes) {
    return bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 | (uint32_t)bytes[3] << 24;
}

COLD void canopen_sdo_send(canopen_t *canopen, const canopen_context_t *context, const uint8_t response[8]) {
    canopen_send(canopen, context, RESPONSE_ID + canopen->node, response, 8);
}

COLD void canopen_sdo_respond(canopen_t *canopen, const canopen_context_t *context, unsigned command, uint32_t word) {
    const canopen_sdo_t *sdo = &canopen->sdo;
    uint8_t response[8] = {(uint8_t)command, (uint8_t)sdo->index, (uint8_t)(sdo->index >> 8), sdo->sub};
    canopen_pack(response + 4, 4, (int32_t)word);
    canopen_sdo_send(canopen, context, response);
}

COLD void canopen_sdo_abort(canopen_t *canopen, const canopen_context_t *context, uint32_t code) {
    canopen->sdo.state = CANOPEN_SDO_IDLE;
    canopen_sdo_respond(canopen, context, ABORT, code);
}

/* The object of the transfer, which a change in memory may have made another one. */
static uint32_t present(const canopen_t *canopen, canopen_object_t *object) {
    return canopen_find(canopen->sdo.index, canopen->sdo.sub, object);
}

static bool is_set(const canopen_object_t *object) {
    return object->row.type == CANOPEN_DOMAIN;
}

static uint32_t size_of(const canopen_context_t *context, const canopen_object_t *object) {
    const unsigned bytes = canopen_bytes(object);
    return bytes != 0 ? bytes : canopen_size_of_bytes(context, object);
}

COLD uint32_t canopen_sdo_begin(canopen_t *canopen, const canopen_context_t *context, const uint8_t *request,
                                bool download, canopen_object_t *object) {
    canopen_sdo_t *sdo = &canopen->sdo;
    *object = (canopen_object_t){0};
    *sdo = (canopen_sdo_t){
        .index = (uint16_t)(request[1] | request[2] << 8), .sub = request[3], .time_us = context->time_us};
    const uint32_t found = present(canopen, object);
    if (found != CANOPEN_DONE) {
        return found;
    }
    sdo->size = size_of(context, object);
    if (download && (object->row.access & CANOPEN_WRITE) == 0) {
        return CANOPEN_READ_ONLY;
    }
    if (is_set(object)) {
        return parameter_set_begin(context->set, context->parameters, false) ? CANOPEN_DONE : CANOPEN_HARDWARE;
    }
    uint32_t read = CANOPEN_DONE;
    if (!download && canopen_bytes(object) != 0) {
        int32_t value;
        read = canopen_read(canopen, context, object, &value);
        canopen_pack(sdo->buffer, canopen_bytes(object), value);
    }
    return read;
}

COLD bool canopen_sdo_put(canopen_t *canopen, const canopen_context_t *context, const uint8_t *data, unsigned count) {
    canopen_sdo_t *sdo = &canopen->sdo;
    canopen_object_t object;
    if (present(canopen, &object) != CANOPEN_DONE || sdo->offset > sdo->size || count > sdo->size - sdo->offset) {
        return false;
    }
    for (unsigned i = 0; i < count; i++, sdo->offset++) {
        if (!is_set(&object)) {
            sdo->buffer[sdo->offset % sizeof sdo->buffer] = data[i];
        } else if (sdo->offset < sizeof context->set->values) {
            parameter_set_stage_byte(context->set, sdo->offset, data[i]);
        }
    }
    return true;
}

COLD unsigned canopen_sdo_get(const canopen_t *canopen, const canopen_context_t *context, uint32_t offset,
                              uint8_t *data, unsigned count) {
    const canopen_sdo_t *sdo = &canopen->sdo;
    canopen_object_t object;
    if (present(canopen, &object) != CANOPEN_DONE) {
        return 0;
    }
    if (canopen_bytes(&object) == 0) {
        return canopen_read_bytes(context, &object, offset, data, count);
    }
    unsigned got = 0;
    for (; got < count && offset + got < fixed_min_u32(sdo->size, sizeof sdo->buffer); got++) {
        data[got] = sdo->buffer[offset + got];
    }
    return got;
}

COLD uint32_t canopen_sdo_commit(canopen_t *canopen, const canopen_context_t *context) {
    canopen_sdo_t *sdo = &canopen->sdo;
    canopen_object_t object;
    sdo->state = CANOPEN_SDO_IDLE;
    const uint32_t found = present(canopen, &object);
    if (found != CANOPEN_DONE) {
        return found;
    }
    if (sdo->offset != size_of(context, &object)) {
        return CANOPEN_TOO_SHORT;
    }
    if (is_set(&object)) {
        const parameters_verdict_t verdict =
            parameter_set_finish(context->set, context->parameters, context->conditions);
        return canopen_verdict(&verdict);
    }
    const int32_t value = canopen_unpack(&object, sdo->buffer);
    const uint32_t refused = canopen_check(canopen, &object, value);
    return refused != CANOPEN_DONE ? refused : canopen_write(canopen, context, &object, value);
}
