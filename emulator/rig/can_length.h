/* Length of a classic CAN frame on the wire in bits (ISO 11898-1), stuff bits included. */
#ifndef RIG_CAN_LENGTH_H
#define RIG_CAN_LENGTH_H

#include <stdint.h>

#include "hal_can.h"

/* Bits between the end of a frame and the next start of frame. */
#define CAN_LENGTH_INTERFRAME_BITS 3

/* States of bit stuffing: a run of 1 to 5 equal bits of either level. */
#define CAN_LENGTH_STUFF_STATES 10

/* Lookup tables, eight bits at a time; read only after can_length_init. */
typedef struct {
    uint16_t crc[256];
    uint8_t stuff_state[CAN_LENGTH_STUFF_STATES][256]; /* state after these eight bits */
    uint8_t stuff_bits[CAN_LENGTH_STUFF_STATES][256];  /* stuff bits they cause, 0..2 */
} can_length_t;

void can_length_init(can_length_t *tables);

/* Bits from start of frame to the last bit of end of frame, without the interframe space: 44 to 160.
 *
 * Stuffing runs from start of frame to the last CRC bit: after five equal bits comes one of the other level, which
 * itself begins the next run. CRC delimiter, acknowledge slot, its delimiter and end of frame (10 bits) are not
 * stuffed. Length codes 9 to 15 are transmitted unchanged and mean 8 bytes; remote frames carry no data. */
unsigned can_length_bits(const can_length_t *tables, const hal_can_frame_t *frame);

/* CRC-15-CAN (polynomial 0x4599) over start of frame to the last data bit, as on the wire. */
uint16_t can_length_crc(const can_length_t *tables, const hal_can_frame_t *frame);

#endif
