#include "comms/canopen_pdo.h"

#include <string.h>

#include "comms/canopen_drive.h"
#include "comms/canopen_mapping.h"
#include "comms/canopen_objects.h"
#include "comms/canopen_send.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"

#define US_PER_INHIBIT 100u
#define US_PER_MS 1000u

/* Error codes. */
#define LENGTH_SHORT 0x8210u
#define LENGTH_LONG 0x8220u

static unsigned mapped_count(const canopen_t *canopen, unsigned value, unsigned pdo) {
    return fixed_min_u32((uint32_t)canopen->values[value + pdo], CANOPEN_MAPPED_MAX);
}

typedef enum { CHECK, WRITE, CONTROL, STOP } pass_t;

/* Handles a value of a receive PDO in one of the passes; false: it cannot be written. */
static bool take_value(canopen_t *canopen, const canopen_context_t *context, const canopen_object_t *object,
                       int32_t value, pass_t pass) {
    if ((object->row.access & CANOPEN_CONSTANT) != 0) { /* bytes without effect */
        return true;
    }
    const bool control = canopen_slot(object) == CANOPEN_VALUE_CONTROLWORD;
    if (pass == CHECK) {
        return canopen_check(canopen, object, value) == CANOPEN_DONE;
    }
    if (pass == STOP ? control && canopen_drive_is_stop(canopen, (uint32_t)value) : control == (pass == CONTROL)) {
        (void)canopen_write(canopen, context, object, value);
    }
    return true;
}

/* A pass over the values of a frame; false: one of them cannot be written. */
static bool pass_over(canopen_t *canopen, const canopen_context_t *context, unsigned pdo, pass_t pass) {
    const canopen_rpdo_t *rpdo = &canopen->rpdo[pdo];
    const int32_t *map = &canopen->values[CANOPEN_VALUE_RPDO_MAP + pdo * CANOPEN_MAPPED_MAX];
    const unsigned count = mapped_count(canopen, CANOPEN_VALUE_RPDO_COUNT, pdo);
    unsigned at = 0;
    for (unsigned i = 0; i < count; i++) {
        canopen_object_t object;
        if (canopen_mapping_find(map[i], CANOPEN_RPDO, &object) != CANOPEN_DONE ||
            at + canopen_bytes(&object) > rpdo->length ||
            !take_value(canopen, context, &object, canopen_unpack(&object, rpdo->data + at), pass)) {
            return false;
        }
        at += canopen_bytes(&object);
    }
    return true;
}

/* Checks all values of the frames of some PDOs, a bit each, and writes them, the controlwords last: a controlword finds
 * mode and references of its frame, and of its SYNC. A value that is refused takes no other with it that stops. */
static void take(canopen_t *canopen, const canopen_context_t *context, unsigned pdos) {
    unsigned refused = 0;
    for (unsigned pdo = 0; pdo < CANOPEN_PDOS; pdo++) {
        if ((pdos >> pdo & 1u) == 0) {
            continue;
        }
        if (pass_over(canopen, context, pdo, CHECK)) {
            (void)pass_over(canopen, context, pdo, WRITE);
        } else {
            refused |= 1u << pdo;
        }
    }
    for (unsigned pdo = 0; pdo < CANOPEN_PDOS; pdo++) {
        if ((pdos >> pdo & 1u) != 0) {
            (void)pass_over(canopen, context, pdo, (refused >> pdo & 1u) != 0 ? STOP : CONTROL);
        }
    }
}

static unsigned mapped_bytes(const canopen_t *canopen, unsigned pdo) {
    unsigned bytes = 0;
    for (unsigned i = 0; i < mapped_count(canopen, CANOPEN_VALUE_RPDO_COUNT, pdo); i++) {
        bytes += ((uint32_t)canopen->values[CANOPEN_VALUE_RPDO_MAP + pdo * CANOPEN_MAPPED_MAX + i] & UINT8_MAX) / 8u;
    }
    return bytes;
}

static void receive(canopen_t *canopen, const canopen_context_t *context, unsigned pdo, const hal_can_frame_t *frame) {
    canopen_rpdo_t *rpdo = &canopen->rpdo[pdo];
    const unsigned bytes = mapped_bytes(canopen, pdo), length = fixed_min_u32(frame->length, sizeof rpdo->data);
    if (length != bytes && !rpdo->misfits) { /* once: a master sends its PDO again and again */
        canopen_emergency(canopen, length < bytes ? LENGTH_SHORT : LENGTH_LONG, FAULT_NONE);
    }
    rpdo->misfits = length != bytes;
    if (length < bytes) {
        return;
    }
    rpdo->seen = true;
    rpdo->time_us = context->time_us;
    rpdo->length = (uint8_t)length;
    (void)memcpy(rpdo->data, frame->data, length);
    rpdo->waiting = canopen->values[CANOPEN_VALUE_RPDO_TYPE + pdo] <= CANOPEN_PDO_SYNC_MAX;
    if (!rpdo->waiting) {
        take(canopen, context, 1u << pdo);
    }
}

COLD bool canopen_pdo_receive(canopen_t *canopen, const canopen_context_t *context, const hal_can_frame_t *frame) {
    for (unsigned pdo = 0; pdo < CANOPEN_PDOS && canopen->nmt == CANOPEN_NMT_OPERATIONAL; pdo++) {
        const uint32_t id = canopen_mapping_id(canopen, CANOPEN_VALUE_RPDO_ID, pdo);
        if ((id & CANOPEN_PDO_NOT_VALID) == 0 && (id & CANOPEN_PDO_ID) == frame->identifier &&
            mapped_count(canopen, CANOPEN_VALUE_RPDO_COUNT, pdo) != 0) {
            receive(canopen, context, pdo, frame);
            return true;
        }
    }
    return false;
}

/* Bytes of the present values of what is mapped. */
static unsigned present(const canopen_t *canopen, const canopen_context_t *context, unsigned pdo, uint8_t data[8]) {
    unsigned bytes = 0;
    for (unsigned i = 0; i < mapped_count(canopen, CANOPEN_VALUE_TPDO_COUNT, pdo); i++) {
        canopen_object_t object;
        int32_t value = 0;
        const int32_t mapped = canopen->values[CANOPEN_VALUE_TPDO_MAP + pdo * CANOPEN_MAPPED_MAX + i];
        if (canopen_mapping_find(mapped, CANOPEN_TPDO, &object) != CANOPEN_DONE ||
            bytes + canopen_bytes(&object) > 8u) {
            break;
        }
        (void)canopen_read(canopen, context, &object, &value);
        canopen_pack(data + bytes, canopen_bytes(&object), value);
        bytes += canopen_bytes(&object);
    }
    return bytes;
}

static void transmit(canopen_t *canopen, const canopen_context_t *context, unsigned pdo, const uint8_t data[8],
                     unsigned bytes) {
    canopen_tpdo_t *tpdo = &canopen->tpdo[pdo];
    tpdo->sent = true;
    tpdo->event = false;
    tpdo->syncs = 0;
    tpdo->time_us = context->time_us;
    (void)memcpy(tpdo->data, data, 8);
    if (bytes != 0) { /* else the mapping is empty, and there is no PDO */
        canopen_send(canopen, context, canopen_mapping_id(canopen, CANOPEN_VALUE_TPDO_ID, pdo) & CANOPEN_PDO_ID, data,
                     bytes);
    }
}

COLD void canopen_pdo_sync(canopen_t *canopen, const canopen_context_t *context) {
    unsigned waiting = 0;
    for (unsigned pdo = 0; pdo < CANOPEN_PDOS; pdo++) {
        if (canopen->rpdo[pdo].waiting && canopen_mapping_is_valid(canopen, CANOPEN_VALUE_RPDO_ID, pdo)) {
            canopen->rpdo[pdo].waiting = false;
            waiting |= 1u << pdo;
        }
    }
    take(canopen, context, waiting);
    for (unsigned pdo = 0; pdo < CANOPEN_PDOS; pdo++) {
        const int32_t type = canopen->values[CANOPEN_VALUE_TPDO_TYPE + pdo];
        canopen_tpdo_t *tpdo = &canopen->tpdo[pdo];
        tpdo->syncs = (uint8_t)fixed_min_u32(tpdo->syncs + 1u, UINT8_MAX);
        if (canopen_mapping_is_valid(canopen, CANOPEN_VALUE_TPDO_ID, pdo) && type <= CANOPEN_PDO_SYNC_MAX &&
            (type == 0 ? tpdo->event : tpdo->syncs >= type)) {
            uint8_t data[8] = {0};
            const unsigned bytes = present(canopen, context, pdo, data);
            transmit(canopen, context, pdo, data, bytes);
        }
    }
}

static bool differ(const uint8_t a[8], const uint8_t b[8]) {
    unsigned differing = 0;
    for (unsigned i = 0; i < 8u; i++) {
        differing |= (unsigned)(a[i] ^ b[i]);
    }
    return differing != 0;
}

static void step_transmit(canopen_t *canopen, const canopen_context_t *context, unsigned pdo) {
    canopen_tpdo_t *tpdo = &canopen->tpdo[pdo];
    const int32_t type = canopen->values[CANOPEN_VALUE_TPDO_TYPE + pdo];
    const uint32_t age_us = context->time_us - tpdo->time_us;
    const uint32_t inhibit_us = (uint32_t)canopen->values[CANOPEN_VALUE_TPDO_INHIBIT + pdo] * US_PER_INHIBIT;
    const uint32_t timer_us = (uint32_t)canopen->values[CANOPEN_VALUE_TPDO_TIMER + pdo] * US_PER_MS;
    if (!canopen_mapping_is_valid(canopen, CANOPEN_VALUE_TPDO_ID, pdo) || (type > 0 && type <= CANOPEN_PDO_SYNC_MAX)) {
        return;
    }
    uint8_t data[8] = {0};
    const unsigned bytes = present(canopen, context, pdo, data);
    const bool changed = !tpdo->sent || differ(data, tpdo->data);
    if (type == 0) {
        tpdo->event |= changed;
    } else if ((!tpdo->sent || age_us >= inhibit_us) && (changed || (timer_us != 0 && age_us >= timer_us))) {
        transmit(canopen, context, pdo, data, bytes);
    }
}

COLD void canopen_pdo_step(canopen_t *canopen, const canopen_context_t *context) {
    for (unsigned pdo = 0; pdo < CANOPEN_PDOS; pdo++) {
        canopen_rpdo_t *rpdo = &canopen->rpdo[pdo];
        const uint32_t timer_us = (uint32_t)canopen->values[CANOPEN_VALUE_RPDO_TIMER + pdo] * US_PER_MS;
        if (rpdo->seen && timer_us != 0 && context->time_us - rpdo->time_us > timer_us) {
            rpdo->seen = false;
            canopen_drive_lose_master(canopen, context, CANOPEN_RPDO_TIMEOUT);
        }
        step_transmit(canopen, context, pdo);
    }
}
