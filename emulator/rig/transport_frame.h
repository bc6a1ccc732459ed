/* Frames as the transports carry them, and as the CAN controller of the drive has them. */
#ifndef RIG_TRANSPORT_FRAME_H
#define RIG_TRANSPORT_FRAME_H

#include <linux/can.h>
#include <stdbool.h>
#include <stddef.h>

#include "hal_can.h"

/* One frame in Linux's layout; `size` selects the member. */
typedef struct {
    size_t size; /* CAN_MTU (classic) or CANFD_MTU (flexible data rate) */
    union {
        struct can_frame classic;
        struct canfd_frame flexible;
    };
} transport_frame_t;

/* Validates a frame of `received` bytes; false when it is no frame. Zeroes reserved fields and data beyond the length,
 * so that equal frames have equal bytes. A classic length of 9 to 15 becomes length 8 with len8_dlc. */
bool transport_frame_accept(transport_frame_t *frame, size_t received);

/* Bits of the identifiers of a rig that have the node number of its drive; not messages of time, which all drives of
 * a bus share (RIG_RUN_UNTIL, RIG_CLOCK, RIG_STAMP). */
#define TRANSPORT_NODE_SHIFT 8
#define TRANSPORT_NODE_MASK (7u << TRANSPORT_NODE_SHIFT)

/* Node number in the identifier of a frame of the rig. */
static inline unsigned transport_frame_node(const transport_frame_t *frame) {
    return (frame->classic.can_id & TRANSPORT_NODE_MASK) >> TRANSPORT_NODE_SHIFT;
}

/* The identifier of node 0 becomes another node's. */
static inline void transport_frame_set_node(transport_frame_t *frame, unsigned node) {
    frame->classic.can_id |= node << TRANSPORT_NODE_SHIFT;
}

/* Frames that never appear on the emulated bus: flexible data rate, error frames and the identifiers of the rigs
 * (0x1F0000xx to 0x1F0007xx, 29 bits). */
bool transport_frame_is_rig(const transport_frame_t *frame);
bool transport_frame_is_off_bus(const transport_frame_t *frame);

/* Convert between the formats of Linux and the HAL; classic data and remote frames only. */
void transport_frame_to_hal(const transport_frame_t *frame, hal_can_frame_t *hal);
void transport_frame_from_hal(const hal_can_frame_t *hal, transport_frame_t *frame);

#endif
