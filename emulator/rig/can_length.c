#include "rig/can_length.h"

#include <stddef.h>

#define CRC_POLYNOMIAL 0x4599u
#define UNSTUFFED_BITS 10u /* CRC delimiter, acknowledge slot and delimiter, seven bits end of frame */

/* State of a run of `length` (1..5) bits of `level`. */
static unsigned run_state(unsigned level, unsigned length) {
    return level * 5 + length - 1;
}

/* State after one more bit; counts the stuff bit that it causes. */
static unsigned stuff_step(unsigned state, unsigned bit, uint8_t *stuff_bits) {
    unsigned level = state / 5, length = state % 5 + 1;
    length = bit == level ? length + 1 : 1;
    if (length == 5) {
        ++*stuff_bits;
        return run_state(!bit, 1);
    }
    return run_state(bit, length);
}

void can_length_init(can_length_t *tables) {
    for (unsigned byte = 0; byte < 256; ++byte) {
        unsigned crc = byte << 7;
        for (int bit = 0; bit < 8; ++bit) {
            crc = (crc << 1) ^ (crc & 0x4000u ? CRC_POLYNOMIAL : 0);
        }
        tables->crc[byte] = (uint16_t)(crc & 0x7FFFu);
        for (unsigned start = 0; start < CAN_LENGTH_STUFF_STATES; ++start) {
            unsigned state = start;
            uint8_t stuff_bits = 0;
            for (int bit = 7; bit >= 0; --bit) {
                state = stuff_step(state, byte >> bit & 1u, &stuff_bits);
            }
            tables->stuff_state[start][byte] = (uint8_t)state;
            tables->stuff_bits[start][byte] = stuff_bits;
        }
    }
}

static unsigned data_bytes(const hal_can_frame_t *frame) {
    return frame->remote ? 0 : frame->length < 8 ? frame->length : 8;
}

/* Start of frame to length code, right-aligned; *bits is 19 or 39. */
static uint64_t header(const hal_can_frame_t *frame, unsigned *bits) {
    uint64_t remote = frame->remote, length = frame->length & 0xFu;
    if (!frame->extended) {
        *bits = 19; /* SOF, identifier, RTR, IDE 0, r0, length */
        return (uint64_t)(frame->identifier & 0x7FFu) << 7 | remote << 6 | length;
    }
    *bits = 39; /* SOF, base identifier, SRR 1, IDE 1, identifier extension, RTR, r1, r0, length */
    uint64_t base = frame->identifier >> 18 & 0x7FFu, extension = frame->identifier & 0x3FFFFu;
    return base << 27 | UINT64_C(3) << 25 | extension << 7 | remote << 6 | length;
}

uint16_t can_length_crc(const can_length_t *tables, const hal_can_frame_t *frame) {
    /* Leading zeros do not change a CRC that begins with zero, so the header may be processed in whole bytes. */
    unsigned bits;
    uint64_t head = header(frame, &bits);
    unsigned crc = 0;
    for (int shift = bits == 19 ? 16 : 32; shift >= 0; shift -= 8) {
        crc = ((crc << 8) & 0x7FFFu) ^ tables->crc[((crc >> 7) ^ (unsigned)(head >> shift)) & 0xFFu];
    }
    for (unsigned i = 0; i < data_bytes(frame); ++i) {
        crc = ((crc << 8) & 0x7FFFu) ^ tables->crc[((crc >> 7) ^ frame->data[i]) & 0xFFu];
    }
    return (uint16_t)crc;
}

unsigned can_length_bits(const can_length_t *tables, const hal_can_frame_t *frame) {
    unsigned bits, stuff_bits = 0;
    uint64_t head = header(frame, &bits);
    unsigned crc = can_length_crc(tables, frame);

    /* Padding to whole bytes with bits that cause no stuffing: alternating bits that end recessive before start of
     * frame (which is dominant), and after the CRC the complement of its last bit. */
    uint64_t padded = bits == 19 ? head | UINT64_C(0x15) << 19 : head | UINT64_C(1) << 39;
    unsigned tail = crc << 1 | (~crc & 1u);

    unsigned state = run_state(0, 1);
    for (int shift = bits == 19 ? 16 : 32; shift >= 0; shift -= 8) {
        unsigned byte = (unsigned)(padded >> shift) & 0xFFu;
        stuff_bits += tables->stuff_bits[state][byte];
        state = tables->stuff_state[state][byte];
    }
    for (unsigned i = 0; i < data_bytes(frame); ++i) {
        stuff_bits += tables->stuff_bits[state][frame->data[i]];
        state = tables->stuff_state[state][frame->data[i]];
    }
    stuff_bits += tables->stuff_bits[state][tail >> 8];
    state = tables->stuff_state[state][tail >> 8];
    stuff_bits += tables->stuff_bits[state][tail & 0xFFu];

    return bits + 8 * data_bytes(frame) + 15 + stuff_bits + UNSTUFFED_BITS;
}
