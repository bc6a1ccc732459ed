#include "rig/transport_frame.h"

#include <string.h>

#define RIG_IDENTIFIER_MASK (0x1FFFFF00u & ~TRANSPORT_NODE_MASK)
#define RIG_IDENTIFIER_BASE 0x1F000000u

bool transport_frame_accept(transport_frame_t *frame, size_t received) {
    /* Both forms begin with the same fields: identifier with flags, length, flags or padding. */
    canid_t id = frame->classic.can_id;
    if (!(id & (CAN_EFF_FLAG | CAN_ERR_FLAG)) && (id & CAN_EFF_MASK) > CAN_SFF_MASK) {
        return false;
    }
    if (received == CANFD_MTU) {
        struct canfd_frame *flexible = &frame->flexible;
        if (flexible->len > CANFD_MAX_DLEN) {
            return false;
        }
        flexible->__res0 = flexible->__res1 = 0;
        memset(flexible->data + flexible->len, 0, (size_t)(CANFD_MAX_DLEN - flexible->len));
    } else if (received == CAN_MTU) {
        struct can_frame *classic = &frame->classic;
        if (classic->len > 15) {
            return false;
        }
        if (classic->len > CAN_MAX_DLEN) {
            classic->len8_dlc = classic->len;
            classic->len = CAN_MAX_DLEN;
        } else if (classic->len < CAN_MAX_DLEN || classic->len8_dlc < 9 || classic->len8_dlc > 15) {
            classic->len8_dlc = 0;
        }
        classic->__pad = classic->__res0 = 0;
        if (id & CAN_RTR_FLAG && !(id & CAN_ERR_FLAG)) {
            memset(classic->data, 0, sizeof classic->data);
        } else {
            memset(classic->data + classic->len, 0, (size_t)(CAN_MAX_DLEN - classic->len));
        }
    } else {
        return false;
    }
    frame->size = received;
    return true;
}

bool transport_frame_is_rig(const transport_frame_t *frame) {
    canid_t id = frame->classic.can_id;
    return id & CAN_EFF_FLAG && !(id & CAN_ERR_FLAG) && (id & RIG_IDENTIFIER_MASK) == RIG_IDENTIFIER_BASE;
}

bool transport_frame_is_off_bus(const transport_frame_t *frame) {
    return frame->size != CAN_MTU || frame->classic.can_id & CAN_ERR_FLAG || transport_frame_is_rig(frame);
}

void transport_frame_to_hal(const transport_frame_t *frame, hal_can_frame_t *hal) {
    canid_t id = frame->classic.can_id;
    hal->extended = id & CAN_EFF_FLAG;
    hal->remote = id & CAN_RTR_FLAG;
    hal->identifier = id & (hal->extended ? CAN_EFF_MASK : CAN_SFF_MASK);
    hal->length = frame->classic.len8_dlc ? frame->classic.len8_dlc : frame->classic.len;
    memcpy(hal->data, frame->classic.data, sizeof hal->data);
}

void transport_frame_from_hal(const hal_can_frame_t *hal, transport_frame_t *frame) {
    frame->size = CAN_MTU;
    memset(&frame->classic, 0, sizeof frame->classic);
    frame->classic.can_id = hal->identifier | (hal->extended ? CAN_EFF_FLAG : 0) | (hal->remote ? CAN_RTR_FLAG : 0);
    frame->classic.len = hal->length < CAN_MAX_DLEN ? hal->length : CAN_MAX_DLEN;
    frame->classic.len8_dlc = hal->length > CAN_MAX_DLEN ? hal->length : 0;
    if (!hal->remote) {
        memcpy(frame->classic.data, hal->data, frame->classic.len);
    }
}
