/* Bits of a classic CAN frame on the wire and lengths of error flags (ISO 11898-1). For frames that are disturbed: the
 * length of one that is not follows faster from can_length.h. */
#ifndef RIG_CAN_WIRE_H
#define RIG_CAN_WIRE_H

#include <stdbool.h>
#include <stdint.h>

#include "rig/can_length.h"

#define CAN_WIRE_STUFFED_MAX 150 /* start of frame to CRC with stuff bits: 118 + 29, extended and eight bytes */
#define CAN_WIRE_FLAG_BITS 6u    /* error flag of one node; as many equal bits are a stuff error */
#define CAN_WIRE_ERROR_DELIMITER_BITS 8
/* Error in the last bit of the end of frame: the transmitter's flag, one bit before the receivers' overload flags. */
#define CAN_WIRE_LAST_BIT_FLAG_BITS 7
#define CAN_WIRE_AFTER_ACKNOWLEDGE_BITS 8 /* acknowledge delimiter and end of frame */

typedef struct {
    uint8_t
        bit[CAN_WIRE_STUFFED_MAX]; /* 0 dominant, 1 recessive; start of frame to last CRC bit, stuff bits included */
    unsigned bits;
    unsigned arbitration_bits; /* of these, up to the last bit in which a node may lose arbitration */
} can_wire_t;

void can_wire_of(const can_length_t *tables, const hal_can_frame_t *frame, can_wire_t *wire);

/* First bit in which two frames differ; the smaller of their lengths when none does. */
unsigned can_wire_first_difference(const can_wire_t *left, const can_wire_t *right);

/* Bits of the superposed error flags after an error at bit `index`, at which the bus had `level`. The node that
 * detects it there begins its flag with the next bit: six dominant ones, or recessive ones of an error-passive node
 * (`passive`). The receivers begin theirs when they see six equal bits: 6 to 12 bits in all. */
unsigned can_wire_error_flag_bits(const can_wire_t *wire, unsigned index, unsigned level, bool passive);

#endif
