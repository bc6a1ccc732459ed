#include "comms/canopen_sdo.h"

#include <string.h>

#include "comms/canopen_sdo_block.h"
#include "comms/canopen_sdo_data.h"
#include "fixed/compiler.h"

/* Client command specifiers, the upper three bits. */
enum { DOWNLOAD_SEGMENT, DOWNLOAD, UPLOAD, UPLOAD_SEGMENT, ABORT, BLOCK_UPLOAD, BLOCK_DOWNLOAD };
enum { EXPEDITED = 0x02, SIZED = 0x01, TOGGLE = 0x10, LAST = 0x01 };
#define SEGMENT_BYTES 7u

static void start_download(canopen_t *canopen, const canopen_context_t *context, const uint8_t *request) {
    canopen_sdo_t *sdo = &canopen->sdo;
    canopen_object_t object;
    const uint32_t announced = canopen_sdo_word(request + 4);
    uint32_t abort = canopen_sdo_begin(canopen, context, request, true, &object);
    const unsigned bytes = canopen_bytes(&object);
    if (abort == CANOPEN_DONE && (request[0] & EXPEDITED) != 0) {
        const unsigned given = (request[0] & SIZED) != 0 ? 4u - (request[0] >> 2 & 3u) : bytes;
        abort = given > sdo->size ? CANOPEN_TOO_LONG : given < sdo->size ? CANOPEN_TOO_SHORT : CANOPEN_DONE;
        if (abort == CANOPEN_DONE) {
            (void)memcpy(sdo->buffer, request + 4, sizeof sdo->buffer);
            sdo->offset = bytes;
            abort = canopen_sdo_commit(canopen, context);
        }
    } else if (abort == CANOPEN_DONE) {
        if ((request[0] & SIZED) != 0 && announced != sdo->size) {
            abort = announced > sdo->size ? CANOPEN_TOO_LONG : CANOPEN_TOO_SHORT;
        }
        sdo->state = CANOPEN_SDO_DOWNLOAD;
    }
    if (abort != CANOPEN_DONE) {
        canopen_sdo_abort(canopen, context, abort);
        return;
    }
    canopen_sdo_respond(canopen, context, 0x60, 0);
}

static void start_upload(canopen_t *canopen, const canopen_context_t *context, const uint8_t *request) {
    canopen_sdo_t *sdo = &canopen->sdo;
    canopen_object_t object;
    const uint32_t abort = canopen_sdo_begin(canopen, context, request, false, &object);
    if (abort != CANOPEN_DONE) {
        canopen_sdo_abort(canopen, context, abort);
        return;
    }
    const unsigned bytes = canopen_bytes(&object);
    if (bytes != 0) {
        canopen_sdo_respond(canopen, context, 0x43u | (4u - bytes) << 2, canopen_sdo_word(sdo->buffer));
        return;
    }
    sdo->state = CANOPEN_SDO_UPLOAD;
    canopen_sdo_respond(canopen, context, 0x41, sdo->size);
}

static void download_segment(canopen_t *canopen, const canopen_context_t *context, const uint8_t *request) {
    canopen_sdo_t *sdo = &canopen->sdo;
    const unsigned count = SEGMENT_BYTES - (request[0] >> 1 & 7u);
    uint32_t abort = sdo->state != CANOPEN_SDO_DOWNLOAD                       ? CANOPEN_COMMAND
                     : ((request[0] & TOGGLE) != 0) != sdo->toggle            ? CANOPEN_TOGGLE
                     : !canopen_sdo_put(canopen, context, request + 1, count) ? CANOPEN_TOO_LONG
                                                                              : CANOPEN_DONE;
    if (abort == CANOPEN_DONE && (request[0] & LAST) != 0) {
        abort = canopen_sdo_commit(canopen, context);
    }
    if (abort != CANOPEN_DONE) {
        canopen_sdo_abort(canopen, context, abort);
        return;
    }
    sdo->toggle = !sdo->toggle;
    const uint8_t response[8] = {(uint8_t)(0x20u | (request[0] & TOGGLE))};
    canopen_sdo_send(canopen, context, response);
}

static void upload_segment(canopen_t *canopen, const canopen_context_t *context, const uint8_t *request) {
    canopen_sdo_t *sdo = &canopen->sdo;
    if (sdo->state != CANOPEN_SDO_UPLOAD || ((request[0] & TOGGLE) != 0) != sdo->toggle) {
        canopen_sdo_abort(canopen, context, sdo->state != CANOPEN_SDO_UPLOAD ? CANOPEN_COMMAND : CANOPEN_TOGGLE);
        return;
    }
    uint8_t response[8] = {0};
    const unsigned count = canopen_sdo_get(canopen, context, sdo->offset, response + 1, SEGMENT_BYTES);
    if (count == 0) { /* by a change in memory: segments without an end */
        canopen_sdo_abort(canopen, context, CANOPEN_NO_OBJECT);
        return;
    }
    sdo->offset += count;
    const bool last = sdo->offset >= sdo->size;
    response[0] = (uint8_t)((request[0] & TOGGLE) | (SEGMENT_BYTES - count) << 1 | (last ? LAST : 0));
    sdo->toggle = !sdo->toggle;
    if (last) {
        sdo->state = CANOPEN_SDO_IDLE;
    }
    canopen_sdo_send(canopen, context, response);
}

COLD void canopen_sdo_receive(canopen_t *canopen, const canopen_context_t *context, const hal_can_frame_t *frame) {
    const uint8_t *request = frame->data;
    if (frame->length != 8u) {
        return;
    }
    if (context->time_us - canopen->sdo.time_us > CANOPEN_SDO_SILENT_US) {
        canopen->sdo.state = CANOPEN_SDO_IDLE;
    }
    if (request[0] == ABORT << 5) {
        canopen->sdo.state = CANOPEN_SDO_IDLE;
        return;
    }
    if (canopen->sdo.state == CANOPEN_SDO_BLOCK_DOWNLOAD) { /* every other frame is one of its segments */
        canopen_sdo_block_segment(canopen, context, request);
        return;
    }
    canopen->sdo.time_us = context->time_us;
    switch (request[0] >> 5) {
    case DOWNLOAD_SEGMENT:
        download_segment(canopen, context, request);
        break;
    case DOWNLOAD:
        start_download(canopen, context, request);
        break;
    case UPLOAD:
        start_upload(canopen, context, request);
        break;
    case UPLOAD_SEGMENT:
        upload_segment(canopen, context, request);
        break;
    case BLOCK_UPLOAD:
        canopen_sdo_block_upload(canopen, context, request);
        break;
    case BLOCK_DOWNLOAD:
        canopen_sdo_block_download(canopen, context, request);
        break;
    default:
        canopen_sdo_abort(canopen, context, CANOPEN_COMMAND);
        break;
    }
}

COLD void canopen_sdo_step(canopen_t *canopen, const canopen_context_t *context) {
    if (canopen->nmt != CANOPEN_NMT_STOPPED) {
        canopen_sdo_block_step(canopen, context);
    }
}
