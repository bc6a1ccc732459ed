#include "comms/canopen_send.h"

#include <string.h>

#include "comms/counter.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"

#define EMERGENCY_ID 0x80u
#define US_PER_INHIBIT 100u

COLD void canopen_send(canopen_t *canopen, const canopen_context_t *context, uint32_t identifier, const uint8_t *data,
                       unsigned length) {
    if (frame_queue_free(context->queue) == 0) {
        counter_add(&canopen->dropped, 1);
        return;
    }
    hal_can_frame_t frame = {.identifier = identifier, .length = (uint8_t)fixed_min_u32(length, sizeof frame.data)};
    (void)memcpy(frame.data, data, frame.length);
    frame_queue_push(context->queue, &frame);
}

static void remove_oldest(canopen_t *canopen) {
    canopen->emergencies = (uint8_t)(fixed_min_u32(canopen->emergencies, CANOPEN_EMERGENCIES) - 1u);
    for (unsigned i = 0; i < canopen->emergencies; i++) {
        canopen->emergency[i] = canopen->emergency[i + 1u];
    }
}

/* The newest are kept: the last one tells the state that lasts. */
COLD void canopen_emergency(canopen_t *canopen, unsigned code, unsigned fault) {
    if (canopen->emergencies >= CANOPEN_EMERGENCIES) {
        remove_oldest(canopen);
    }
    canopen->emergency[canopen->emergencies++] = (canopen_emergency_t){(uint16_t)code, (uint8_t)fault};
}

COLD void canopen_send_emergencies(canopen_t *canopen, const canopen_context_t *context, uint8_t error_register) {
    const uint32_t inhibit_us = (uint32_t)canopen->values[CANOPEN_VALUE_EMERGENCY_INHIBIT] * US_PER_INHIBIT;
    const bool may = canopen->nmt == CANOPEN_NMT_OPERATIONAL || canopen->nmt == CANOPEN_NMT_PRE_OPERATIONAL;
    if (canopen->emergencies == 0 || !may || context->time_us - canopen->emergency_us < inhibit_us) {
        return;
    }
    const canopen_emergency_t *oldest = &canopen->emergency[0];
    const uint8_t data[8] = {(uint8_t)oldest->code, (uint8_t)(oldest->code >> 8), error_register, oldest->fault};
    canopen_send(canopen, context, EMERGENCY_ID + canopen->node, data, sizeof data);
    canopen->emergency_us = context->time_us;
    remove_oldest(canopen);
}
