#include "comms/canopen_sdo_block.h"

#include <string.h>

#include "fixed/compiler.h"

#define POLYNOMIAL 0x1021u
#define SEQUENCE_MAX 127u
#define LAST 0x80u
enum { INITIATE, END, CONFIRM, START }; /* subcommands of an upload */
enum { WITH_CRC = 0x04, SIZED = 0x02 }; /* of an initiation */
enum { INITIATED_UPLOAD = 0xC2, ENDS = 0xC1, INITIATED_DOWNLOAD = 0xA0, CONFIRMED = 0xA2, ENDED = 0xA1 };

COLD uint16_t canopen_sdo_crc(uint16_t crc, const uint8_t *data, unsigned count) {
    for (unsigned i = 0; i < count; i++) {
        crc = (uint16_t)(crc ^ (uint32_t)data[i] << 8);
        for (unsigned bit = 0; bit < 8u; bit++) {
            crc = (uint16_t)((uint32_t)crc << 1 ^ ((crc & 0x8000u) != 0 ? POLYNOMIAL : 0u));
        }
    }
    return crc;
}

/* --- upload ------------------------------------------------------------------------------------------------------ */

static bool is_block(unsigned segments) {
    return segments >= 1u && segments <= SEQUENCE_MAX;
}

static void initiate_upload(canopen_t *canopen, const canopen_context_t *context, const uint8_t *request) {
    canopen_sdo_t *sdo = &canopen->sdo;
    canopen_object_t object;
    uint32_t abort = canopen_sdo_begin(canopen, context, request, false, &object);
    if (abort == CANOPEN_DONE && !is_block(request[4])) {
        abort = CANOPEN_BLOCK_SIZE;
    }
    if (abort != CANOPEN_DONE) {
        canopen_sdo_abort(canopen, context, abort);
        return;
    }
    sdo->block_size = request[4];
    sdo->state = CANOPEN_SDO_BLOCK_START;
    sdo->check = (request[0] & WITH_CRC) != 0;
    canopen_sdo_respond(canopen, context, INITIATED_UPLOAD | WITH_CRC, sdo->size);
}

static uint16_t crc_of_upload(const canopen_t *canopen, const canopen_context_t *context) {
    uint16_t crc = 0;
    uint8_t data[CANOPEN_BLOCK_BYTES];
    unsigned count;
    for (uint32_t at = 0; (count = canopen_sdo_get(canopen, context, at, data, sizeof data)) != 0; at += count) {
        crc = canopen_sdo_crc(crc, data, count);
    }
    return crc;
}

static void end_upload(canopen_t *canopen, const canopen_context_t *context) {
    canopen_sdo_t *sdo = &canopen->sdo;
    const unsigned unused = (CANOPEN_BLOCK_BYTES - sdo->size % CANOPEN_BLOCK_BYTES) % CANOPEN_BLOCK_BYTES;
    const uint16_t crc = sdo->check ? crc_of_upload(canopen, context) : 0;
    const uint8_t response[8] = {(uint8_t)(ENDS | unused << 2), (uint8_t)crc, (uint8_t)(crc >> 8)};
    sdo->state = CANOPEN_SDO_BLOCK_END;
    canopen_sdo_send(canopen, context, response);
}

/* The client has got the segments up to one of them: the next block begins behind it. */
static void confirm_block(canopen_t *canopen, const canopen_context_t *context, const uint8_t *request) {
    canopen_sdo_t *sdo = &canopen->sdo;
    if (request[1] > sdo->sequence || !is_block(request[2])) {
        canopen_sdo_abort(canopen, context, request[1] > sdo->sequence ? CANOPEN_SEQUENCE : CANOPEN_BLOCK_SIZE);
        return;
    }
    sdo->offset += request[1] * CANOPEN_BLOCK_BYTES;
    sdo->block_size = request[2];
    sdo->sequence = 0;
    if (sdo->offset >= sdo->size) {
        end_upload(canopen, context);
    }
}

COLD void canopen_sdo_block_upload(canopen_t *canopen, const canopen_context_t *context, const uint8_t *request) {
    canopen_sdo_t *sdo = &canopen->sdo;
    const unsigned code = request[0] & 3u;
    if (code == INITIATE) {
        initiate_upload(canopen, context, request);
    } else if (code == START && sdo->state == CANOPEN_SDO_BLOCK_START) {
        sdo->state = CANOPEN_SDO_BLOCK_UPLOAD;
    } else if (code == CONFIRM && sdo->state == CANOPEN_SDO_BLOCK_UPLOAD) {
        confirm_block(canopen, context, request);
    } else if (code == END && sdo->state == CANOPEN_SDO_BLOCK_END) {
        sdo->state = CANOPEN_SDO_IDLE;
    } else {
        canopen_sdo_abort(canopen, context, CANOPEN_COMMAND);
    }
}

COLD void canopen_sdo_block_step(canopen_t *canopen, const canopen_context_t *context) {
    canopen_sdo_t *sdo = &canopen->sdo;
    while (sdo->state == CANOPEN_SDO_BLOCK_UPLOAD && sdo->sequence < sdo->block_size &&
           frame_queue_free(context->queue) > CANOPEN_QUEUE_KEPT) {
        const uint32_t at = sdo->offset + sdo->sequence * CANOPEN_BLOCK_BYTES;
        uint8_t segment[8] = {0};
        if (at >= sdo->size) { /* the last one is on its way */
            break;
        }
        if (canopen_sdo_get(canopen, context, at, segment + 1, CANOPEN_BLOCK_BYTES) == 0) { /* by a change in memory */
            canopen_sdo_abort(canopen, context, CANOPEN_NO_OBJECT);
            return;
        }
        sdo->sequence++;
        segment[0] = (uint8_t)(sdo->sequence | (at + CANOPEN_BLOCK_BYTES >= sdo->size ? LAST : 0u));
        canopen_sdo_send(canopen, context, segment);
    }
}

/* --- download ---------------------------------------------------------------------------------------------------- */

static void initiate_download(canopen_t *canopen, const canopen_context_t *context, const uint8_t *request) {
    canopen_sdo_t *sdo = &canopen->sdo;
    canopen_object_t object;
    const uint32_t announced = canopen_sdo_word(request + 4);
    uint32_t abort = canopen_sdo_begin(canopen, context, request, true, &object);
    if (abort == CANOPEN_DONE && (request[0] & SIZED) != 0 && announced != sdo->size) {
        abort = announced > sdo->size ? CANOPEN_TOO_LONG : CANOPEN_TOO_SHORT;
    }
    if (abort != CANOPEN_DONE) {
        canopen_sdo_abort(canopen, context, abort);
        return;
    }
    sdo->state = CANOPEN_SDO_BLOCK_DOWNLOAD;
    sdo->block_size = CANOPEN_DOWNLOAD_BLOCK;
    sdo->check = (request[0] & WITH_CRC) != 0;
    canopen_sdo_respond(canopen, context, INITIATED_DOWNLOAD | WITH_CRC, CANOPEN_DOWNLOAD_BLOCK);
}

/* All but the last bytes, of which the end says how many count. */
static bool append(canopen_t *canopen, const canopen_context_t *context, const uint8_t *data, unsigned count) {
    canopen->sdo.crc = canopen_sdo_crc(canopen->sdo.crc, data, count);
    return canopen_sdo_put(canopen, context, data, count);
}

COLD void canopen_sdo_block_segment(canopen_t *canopen, const canopen_context_t *context, const uint8_t *segment) {
    canopen_sdo_t *sdo = &canopen->sdo;
    const unsigned sequence = segment[0] & SEQUENCE_MAX;
    const bool last = (segment[0] & LAST) != 0, next = sequence == sdo->sequence + 1u;
    if (sequence == 0) {
        canopen_sdo_abort(canopen, context, CANOPEN_SEQUENCE);
        return;
    }
    if (next) { /* requests of others, which seem out of order, do not prolong the transfer of one that is gone */
        sdo->time_us = context->time_us;
        sdo->sequence++;
        if (last) {
            (void)memcpy(sdo->last, segment + 1, sizeof sdo->last);
            sdo->state = CANOPEN_SDO_BLOCK_LAST;
        } else if (!append(canopen, context, segment + 1, CANOPEN_BLOCK_BYTES)) {
            canopen_sdo_abort(canopen, context, CANOPEN_TOO_LONG);
            return;
        }
    }
    if (last || sequence >= sdo->block_size) { /* after a lost one the client goes on behind the last in order */
        const uint8_t response[8] = {CONFIRMED, sdo->sequence, CANOPEN_DOWNLOAD_BLOCK};
        sdo->sequence = 0;
        canopen_sdo_send(canopen, context, response);
    }
}

COLD void canopen_sdo_block_download(canopen_t *canopen, const canopen_context_t *context, const uint8_t *request) {
    canopen_sdo_t *sdo = &canopen->sdo;
    if ((request[0] & 1u) == INITIATE) {
        initiate_download(canopen, context, request);
        return;
    }
    const unsigned unused = request[0] >> 2 & 7u;
    uint32_t abort = CANOPEN_DONE;
    if (sdo->state != CANOPEN_SDO_BLOCK_LAST) {
        abort = CANOPEN_COMMAND;
    } else if (!append(canopen, context, sdo->last, CANOPEN_BLOCK_BYTES - unused)) {
        abort = CANOPEN_TOO_LONG;
    } else if (sdo->check && sdo->crc != (uint16_t)(request[1] | request[2] << 8)) {
        abort = CANOPEN_CRC;
    } else {
        abort = canopen_sdo_commit(canopen, context);
    }
    if (abort != CANOPEN_DONE) {
        canopen_sdo_abort(canopen, context, abort);
        return;
    }
    const uint8_t response[8] = {ENDED};
    canopen_sdo_send(canopen, context, response);
}
