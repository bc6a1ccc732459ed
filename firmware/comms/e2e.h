/* End-to-end protection of frames as AUTOSAR E2E profile 5: CRC-16 and an 8-bit counter.
 *
 * Layout: bytes 0 and 1 the checksum (low byte first), byte 2 the counter, data from byte 3. The checksum covers bytes
 * 2 to the end and then the data ID, low byte first, which is known to both sides and never sent: a frame that was
 * meant for something else fails. (AUTOSAR Foundation, E2E Protocol Specification, profile 5.)
 */
#ifndef COMMS_E2E_H
#define COMMS_E2E_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define E2E_HEADER_BYTES 3

/* Steps of the counter that are accepted: up to two frames may be lost in a row. */
#define E2E_COUNTER_STEP_MAX 3

/* Good frames in sequence after which a sender whose counter jumped is believed; the last of them is accepted. */
#define E2E_RESYNCHRONISE_FRAMES 3

typedef enum {
    E2E_ACCEPTED,
    E2E_WRONG_CHECKSUM, /* or shorter than the header */
    E2E_REPEATED,       /* the counter of the frame accepted last */
    E2E_WRONG_SEQUENCE, /* any other step than 1 to E2E_COUNTER_STEP_MAX */
} e2e_result_t;

typedef struct {
    uint16_t data_id;
    bool synchronised;         /* false: the next frame with a good checksum is accepted whatever its counter */
    uint8_t counter;           /* of the frame accepted last */
    uint8_t candidate_frames;  /* frames of another sequence seen in a row, none of the accepted sequence between */
    uint8_t candidate_counter; /* of the last of them */
} e2e_receiver_t;

/* CRC-16/CCITT-FALSE (polynomial 0x1021, most significant bit first, nothing inverted) of `length` bytes, continued
 * from `crc`; the first call passes 0xFFFF. "123456789" gives 0x29B1. */
uint16_t e2e_crc16(uint16_t crc, const uint8_t *bytes, size_t length);

/* Writes counter and checksum into a frame of `length` >= E2E_HEADER_BYTES bytes whose data is in place. */
void e2e_protect(uint16_t data_id, uint8_t counter, uint8_t *bytes, size_t length);

/* A receiver that accepts the next good frame whatever its counter. */
void e2e_receiver_init(e2e_receiver_t *receiver, uint16_t data_id);

/* Forgets the sequence: call it when the sender was silent too long, so that a sender that starts again is heard. */
void e2e_receiver_restart(e2e_receiver_t *receiver);

/* Checks a received frame. Only E2E_ACCEPTED allows its data to be used. A frame with a wrong checksum changes nothing;
 * one out of sequence can only count towards a resynchronisation, which an accepted frame of the true sender undoes. */
e2e_result_t e2e_check(e2e_receiver_t *receiver, const uint8_t *bytes, size_t length);

#endif
