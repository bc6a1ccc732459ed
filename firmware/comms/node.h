/* Node number: up to eight drives on one bus.
 *
 * drive.dbc describes node 0. Of node n every identifier is higher by NODE_STEP n, and so is the data ID of every
 * message with end-to-end protection. No two protected messages of any nodes have the same data ID, and the CRC-16 of
 * the same data differs for any two data IDs, which are its last 16 bits: a frame of one node is valid for no other,
 * whatever identifier it has.
 */
#ifndef COMMS_NODE_H
#define COMMS_NODE_H

#include <stdbool.h>
#include <stdint.h>

#include "hal_can.h"

#define NODE_MAX 7u
#define NODE_STEP 16u

/* Bit n: the identifiers from 0x80 n on, 16 of each node. */
#define NODE_BLOCKS 0x582Au /* 0x080, 0x180, 0x280, 0x580, 0x600, 0x700 */

/* True for a data frame of the traffic of another node than the one with this offset. */
static inline bool node_is_other(const hal_can_frame_t *frame, uint32_t offset) {
    return !frame->extended && !frame->remote && (NODE_BLOCKS >> (frame->identifier / 0x80u) & 1u) != 0 &&
           (frame->identifier & (NODE_MAX * NODE_STEP)) != offset;
}

#endif
