/* One pair of wires of the CAN bus: what becomes of a frame that several nodes send at once, or that is disturbed. */
#ifndef RIG_CAN_LINE_H
#define RIG_CAN_LINE_H

#include <stdbool.h>
#include <stdint.h>

#include "rig/can_faults.h"
#include "rig/can_length.h"
#include "rig/can_node.h"
#include "rig/can_wire.h"

#define CAN_LINE_TRANSMITTERS_MAX 64 /* nodes that transmit the same arbitration field at once; others wait */

typedef struct {
    can_node_t *node;
    can_mailbox_t *mailbox;
} can_transmitter_t;

typedef struct {
    enum { CAN_LINE_IDLE, CAN_LINE_FRAME, CAN_LINE_ERROR_FRAME } state;
    uint64_t next_event_ns;
    uint64_t frame_start_ns;
    uint64_t idle_from_ns;      /* next start of frame */
    uint64_t recessive_from_ns; /* while idle: since the last dominant bit */
    unsigned bits;              /* until the event */
    unsigned bits_to_idle;      /* after it */
    unsigned recessive_bits;    /* before it, without a dominant one */
    bool acknowledge_error;
    unsigned transmitters, remaining; /* the first `remaining` send to the end; the others have lost a bit */
    can_transmitter_t transmitter[CAN_LINE_TRANSMITTERS_MAX];
} can_line_t;

/* Outcome of the frame of the transmitters, which begins, and when. Without a node that acknowledges it, it ends
 * with an error. `wires` has room for the wires of all transmitters. */
void can_line_plan_frame(can_line_t *line, bool acknowledged, const can_length_t *lengths, can_faults_t *faults,
                         can_wire_t *wires);

/* A node falls silent after `bits` bits of the frame that is under way. When no other node sends it to the end, the
 * frame ends with an error: the receivers see a stuff error, an error flag follows. */
void can_line_fall_silent(can_line_t *line, const can_node_t *node, unsigned bits);

#endif
