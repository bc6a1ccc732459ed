/* End-to-end protection of frames as AUTOSAR E2E profile 5: CRC-16 and an 8-bit counter.
 *
 * Layout: bytes 0 and 1 the checksum (low byte first), byte 2 the counter, data from byte 3. The checksum covers bytes
 * 2 to the end and then the data ID, low byte first, which is known to both sides and not transmitted: a frame of
 * another kind fails. (AUTOSAR Foundation, E2E Protocol Specification, profile 5.)
 */
#ifndef COMMS_E2E_H
#define COMMS_E2E_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define E2E_HEADER_BYTES 3

/* Largest accepted increment of the counter: up to two consecutive frames may be lost. */
#define E2E_COUNTER_STEP_MAX 3

/* Consecutive valid frames after which a sender whose counter jumped is accepted, with the last of them; never by a
 * locked receiver, which thereby stays with one sender. */
#define E2E_RESYNCHRONISE_FRAMES 3

typedef enum {
    E2E_ACCEPTED,
    E2E_RESYNCHRONISED, /* accepted: with it another sequence has taken the place of the present one */
    E2E_WRONG_CHECKSUM, /* or shorter than the header */
    E2E_REPEATED,       /* counter and checksum of the last accepted frame: the same frame once more */
    E2E_WRONG_SEQUENCE, /* any other increment than 1 to E2E_COUNTER_STEP_MAX, 0 with another checksum included */
} e2e_result_t;

typedef struct {
    bool locked;               /* set by the caller: no resynchronisation */
    bool synchronised;         /* false: the next frame with a valid checksum is accepted with any counter, but not the
                                  last accepted one once more */
    uint8_t counter;           /* of the last accepted frame */
    uint16_t checksum;         /* likewise */
    uint8_t candidate_frames;  /* consecutive frames of another sequence, none of the accepted sequence between */
    uint8_t candidate_counter; /* counter of the last of these frames */
} e2e_receiver_t;

/* CRC-16/CCITT-FALSE (polynomial 0x1021, most significant bit first, nothing inverted) of `length` bytes, continued
 * from `crc`; the first call passes 0xFFFF. The CRC of "123456789" is 0x29B1. */
uint16_t e2e_crc16(uint16_t crc, const uint8_t *bytes, size_t length);

/* Initialises a receiver that accepts the next valid frame with any counter. */
void e2e_receiver_init(e2e_receiver_t *receiver);

/* Forgets the sequence: call it after a timeout, so that a sender that starts again is accepted. Not the last frame: a
 * gateway that hangs, and sends it for ever, is no sender that starts again. */
void e2e_receiver_restart(e2e_receiver_t *receiver);

/* True when a frame's checksum matches its data and data ID; false for one shorter than the header. */
bool e2e_checksum_matches(uint16_t data_id, const uint8_t *bytes, size_t length);

/* Checks a received frame of a message; messages with one sequence counter share a receiver. Its data may be used only
 * after E2E_ACCEPTED or E2E_RESYNCHRONISED. A frame with a wrong checksum changes nothing; one out of sequence can only
 * count towards a resynchronisation, which an accepted frame of the present sender resets.
 */
e2e_result_t e2e_check(e2e_receiver_t *receiver, uint16_t data_id, const uint8_t *bytes, size_t length);

#endif
