#include "rig/can_node.h"

#include <stdlib.h>
#include <string.h>

#define QUEUE_FIRST 64 /* frames; doubled when they are taken */
#define TRANSMIT_ERROR_STEP 8
#define RECEIVE_ERRORS_AFTER_PASSIVE 120 /* ISO 11898-1: 119 to 127 */

/* Standard: identifier, RTR, IDE 0; extended: base identifier, SRR 1, IDE 1, extension, RTR. */
uint32_t can_node_arbitration(const hal_can_frame_t *frame) {
    const uint32_t remote = frame->remote;
    if (!frame->extended) {
        return (frame->identifier & 0x7FFu) << 21 | remote << 20;
    }
    return (frame->identifier >> 18 & 0x7FFu) << 21 | UINT32_C(3) << 19 | (frame->identifier & 0x3FFFFu) << 1 | remote;
}

void can_node_init(can_node_t *node) {
    memset(node, 0, sizeof *node);
}

void can_node_close(can_node_t *node) {
    free(node->queue);
    node->queue = NULL;
    node->capacity = 0;
}

bool can_node_load(can_node_t *node, unsigned mailbox, const hal_can_frame_t *frame) {
    if (mailbox >= HAL_CAN_MAILBOXES || node->mailbox[mailbox].taken) {
        return false;
    }
    node->mailbox[mailbox] =
        (can_mailbox_t){.frame = *frame, .arbitration = can_node_arbitration(frame), .taken = true};
    return true;
}

unsigned can_node_free_mailbox(const can_node_t *node, const hal_can_frame_t *frame) {
    const uint32_t arbitration = can_node_arbitration(frame);
    unsigned lowest = HAL_CAN_MAILBOXES;
    for (unsigned i = 0; i < HAL_CAN_MAILBOXES; ++i) {
        const can_mailbox_t *mailbox = &node->mailbox[i];
        if (!mailbox->taken) {
            lowest = lowest < i ? lowest : i;
        } else if (mailbox->arbitration == arbitration) {
            lowest = HAL_CAN_MAILBOXES;
        }
    }
    return lowest;
}

static size_t queued(const can_node_t *node) {
    return (size_t)(node->pushed - node->popped);
}

static void refill(can_node_t *node) {
    if (!node->mailbox[0].taken && queued(node) > 0) {
        (void)can_node_load(node, 0, &node->queue[node->popped++ % node->capacity]);
    }
}

static bool grow(can_node_t *node) {
    const size_t capacity = node->capacity ? 2 * node->capacity : QUEUE_FIRST;
    hal_can_frame_t *queue = malloc(capacity * sizeof *queue);
    if (!queue) {
        return false;
    }
    const size_t count = queued(node);
    for (size_t i = 0; i < count; ++i) {
        queue[i] = node->queue[(node->popped + i) % node->capacity];
    }
    free(node->queue);
    node->queue = queue;
    node->capacity = capacity;
    node->popped = 0;
    node->pushed = count;
    return true;
}

size_t can_node_backlog(const can_node_t *node) {
    size_t count = queued(node);
    for (unsigned i = 0; i < HAL_CAN_MAILBOXES; ++i) {
        count += node->mailbox[i].taken;
    }
    return count;
}

bool can_node_push(can_node_t *node, const hal_can_frame_t *frame) {
    if (can_node_backlog(node) >= CAN_NODE_QUEUE_MAX || (queued(node) == node->capacity && !grow(node))) {
        return false;
    }
    node->queue[node->pushed++ % node->capacity] = *frame;
    if (!node->bus_off) {
        refill(node);
    }
    return true;
}

void can_node_complete(can_node_t *node, can_mailbox_t *mailbox) {
    mailbox->taken = false;
    refill(node);
}

static void empty_mailboxes(can_node_t *node) {
    for (unsigned i = 0; i < HAL_CAN_MAILBOXES; ++i) {
        node->mailbox[i].taken = false;
    }
}

static void go_bus_off(can_node_t *node) {
    node->bus_off = true;
    node->rejoins = false;
    empty_mailboxes(node);
}

static void become_error_active(can_node_t *node) {
    node->bus_off = node->rejoins = false;
    node->transmit_errors = node->receive_errors = 0;
    node->suspended_till_ns = 0;
}

void can_node_reset(can_node_t *node, bool under_way) {
    empty_mailboxes(node);
    become_error_active(node);
    node->integrates = under_way;
}

void can_node_transmitted(can_node_t *node) {
    node->transmit_errors -= node->transmit_errors > 0;
}

void can_node_transmit_error(can_node_t *node) {
    can_node_set_transmit_errors(node, node->transmit_errors + TRANSMIT_ERROR_STEP);
}

void can_node_received(can_node_t *node) {
    if (node->receive_errors > CAN_NODE_PASSIVE_ABOVE) {
        node->receive_errors = RECEIVE_ERRORS_AFTER_PASSIVE;
    } else {
        node->receive_errors -= node->receive_errors > 0;
    }
}

void can_node_receive_error(can_node_t *node) {
    node->receive_errors += node->receive_errors <= CAN_NODE_PASSIVE_ABOVE;
}

void can_node_set_transmit_errors(can_node_t *node, unsigned errors) {
    if (node->bus_off) {
        return;
    }
    node->transmit_errors = errors;
    if (errors > CAN_NODE_BUS_OFF_ABOVE) {
        go_bus_off(node);
    }
}

void can_node_rejoin(can_node_t *node, uint64_t now_ns) {
    if (node->bus_off && !node->rejoins) {
        node->rejoins = true;
        node->rejoins_from_ns = now_ns;
        node->sequences_left = CAN_NODE_REJOIN_SEQUENCES;
    }
}

void can_node_count_recessive(can_node_t *node, uint64_t sequences) {
    if (!node->rejoins) {
        return;
    }
    if (sequences < node->sequences_left) {
        node->sequences_left -= (unsigned)sequences;
        return;
    }
    become_error_active(node);
    refill(node);
}
