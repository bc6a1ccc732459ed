/* [SR-32] */
#include "comms/e2e.h"

#define POLYNOMIAL 0x1021u
#define CRC_START 0xFFFFu

uint16_t e2e_crc16(uint16_t crc, const uint8_t *bytes, size_t length) {
    for (size_t i = 0; i < length; i++) {
        crc = (uint16_t)(crc ^ (unsigned)bytes[i] << 8);
        for (int bit = 0; bit < 8; bit++) {
            const unsigned subtrahend = crc & 0x8000u ? POLYNOMIAL : 0u;
            crc = (uint16_t)((unsigned)crc << 1 ^ subtrahend);
        }
    }
    return crc;
}

static uint16_t checksum(uint16_t data_id, const uint8_t *bytes, size_t length) {
    const uint8_t id[2] = {(uint8_t)(data_id & 0xFFu), (uint8_t)(data_id >> 8)};
    return e2e_crc16(e2e_crc16(CRC_START, bytes + 2, length - 2), id, sizeof id);
}

void e2e_receiver_init(e2e_receiver_t *receiver) {
    *receiver = (e2e_receiver_t){0};
}

void e2e_receiver_restart(e2e_receiver_t *receiver) {
    receiver->synchronised = false;
    receiver->locked = false;
}

static bool in_sequence(uint8_t before, uint8_t counter) {
    const uint8_t step = (uint8_t)(counter - before);
    return step >= 1 && step <= E2E_COUNTER_STEP_MAX;
}

static uint16_t checksum_of(const uint8_t *bytes) {
    return (uint16_t)(bytes[0] | bytes[1] << 8);
}

static void accept(e2e_receiver_t *receiver, const uint8_t *bytes) {
    receiver->synchronised = true;
    receiver->counter = bytes[2];
    receiver->checksum = checksum_of(bytes);
    receiver->candidate_frames = 0;
}

bool e2e_checksum_matches(uint16_t data_id, const uint8_t *bytes, size_t length) {
    return length >= E2E_HEADER_BYTES && checksum_of(bytes) == checksum(data_id, bytes, length);
}

/* [SR-32] [SR-36] */
e2e_result_t e2e_check(e2e_receiver_t *receiver, uint16_t data_id, const uint8_t *bytes, size_t length) {
    if (!e2e_checksum_matches(data_id, bytes, length)) {
        return E2E_WRONG_CHECKSUM;
    }
    const uint8_t counter = bytes[2];
    if (counter == receiver->counter && checksum_of(bytes) == receiver->checksum) {
        return E2E_REPEATED; /* of a sender that starts again by chance with this one, the next frame is accepted */
    }
    if (!receiver->synchronised || in_sequence(receiver->counter, counter)) {
        accept(receiver, bytes);
        return E2E_ACCEPTED;
    }
    if (counter == receiver->counter || receiver->locked) {
        return E2E_WRONG_SEQUENCE;
    }
    const bool continues = receiver->candidate_frames > 0 && in_sequence(receiver->candidate_counter, counter);
    receiver->candidate_frames = continues ? (uint8_t)(receiver->candidate_frames + 1) : 1;
    receiver->candidate_counter = counter;
    if (receiver->candidate_frames < E2E_RESYNCHRONISE_FRAMES) {
        return E2E_WRONG_SEQUENCE;
    }
    accept(receiver, bytes);
    return E2E_RESYNCHRONISED;
}
