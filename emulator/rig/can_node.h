/* CAN controller of one node: transmit mailboxes, a queue behind them, and error confinement (ISO 11898-1). */
#ifndef RIG_CAN_NODE_H
#define RIG_CAN_NODE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "hal_can.h"
#include "rig/can_faults.h"

#define CAN_NODE_QUEUE_MAX 65536 /* frames; a power of two */
#define CAN_NODE_PASSIVE_ABOVE 127
#define CAN_NODE_BUS_OFF_ABOVE 255
#define CAN_NODE_REJOIN_SEQUENCES 128 /* of 11 recessive bits */

typedef struct {
    hal_can_frame_t frame;
    uint32_t arbitration; /* can_node_arbitration of the frame */
    bool taken;
    bool drawn; /* `fault` is this frame's */
    can_fault_t fault;
    uint64_t not_before_ns; /* takes no part in arbitration earlier */
} can_mailbox_t;

typedef struct {
    /* Error confinement. */
    unsigned transmit_errors; /* up to 256 and a little more, which is bus-off (reported as 256) */
    unsigned receive_errors;  /* 0..128 */
    bool bus_off;
    bool rejoins;               /* counts recessive bits to leave bus-off */
    unsigned sequences_left;    /* while it rejoins */
    uint64_t rejoins_from_ns;   /* bits before do not count */
    uint64_t suspended_till_ns; /* suspend transmission of an error-passive transmitter */
    bool integrates;            /* after a reset: takes no part in the frame that is under way */

    can_mailbox_t mailbox[HAL_CAN_MAILBOXES];

    /* Frames that wait for a mailbox. */
    hal_can_frame_t *queue;
    size_t capacity;
    uint64_t pushed, popped;
} can_node_t;

/* Arbitration field as transmitted, first bit highest; the lowest value wins. */
uint32_t can_node_arbitration(const hal_can_frame_t *frame);

/* Error active, all empty; no memory is allocated. */
void can_node_init(can_node_t *node);

/* Frees the queue. */
void can_node_close(can_node_t *node);

/* Number of the lowest free mailbox in which a frame does not overtake one of its arbitration field, else
 * HAL_CAN_MAILBOXES. Frames of one field are sent by the number of their mailbox. */
unsigned can_node_free_mailbox(const can_node_t *node, const hal_can_frame_t *frame);

/* Puts a frame into a mailbox; false when it is taken, or does not exist. */
bool can_node_load(can_node_t *node, unsigned mailbox, const hal_can_frame_t *frame);

/* Queues a frame; false when CAN_NODE_QUEUE_MAX frames wait or memory is exhausted. The queue sends in the order of
 * arrival, through one mailbox. */
bool can_node_push(can_node_t *node, const hal_can_frame_t *frame);

/* Frames that are not complete. */
size_t can_node_backlog(const can_node_t *node);

/* Empties a mailbox whose frame is complete; the queue's next frame follows. */
void can_node_complete(can_node_t *node, can_mailbox_t *mailbox);

static inline bool can_node_is_passive(const can_node_t *node) {
    return node->transmit_errors > CAN_NODE_PASSIVE_ABOVE || node->receive_errors > CAN_NODE_PASSIVE_ABOVE;
}

/* Fault confinement: a frame transmitted, a transmission disturbed, a frame received, a reception disturbed. A node
 * whose transmit error counter exceeds 255 is bus-off, and the frames in its mailboxes are lost; its queue stays. */
void can_node_transmitted(can_node_t *node);
void can_node_transmit_error(can_node_t *node);
void can_node_received(can_node_t *node);
void can_node_receive_error(can_node_t *node);

/* Reset of its controller: error active, mailboxes empty. under_way: a frame is, on its line. */
void can_node_reset(can_node_t *node, bool under_way);

/* Sets the transmit error counter; above 255 the node is bus-off. */
void can_node_set_transmit_errors(can_node_t *node, unsigned errors);

/* Bus-off: begins to count recessive bits at now_ns. No effect in other states and while it counts. */
void can_node_rejoin(can_node_t *node, uint64_t now_ns);

/* `sequences` of 11 recessive bits have passed; the node is error active again after the last of them. */
void can_node_count_recessive(can_node_t *node, uint64_t sequences);

#endif
