/* Frames of the bus: end-to-end protection, counters, units. */
#include "comms/counter.h"
#include "comms/e2e.c"
#include "comms/units.c"
#include "proof.h"

void prove_counter(uint16_t counter, unsigned events) {
    const uint64_t sum = (uint64_t)counter + events;
    counter_add(&counter, events);
    CLAIM(counter == (sum > UINT16_MAX ? UINT16_MAX : sum));
}

typedef struct {
    uint8_t byte[8];
} payload_t;

/* The result of any frame to any receiver. candidate_frames: prove_e2e_check() itself keeps it. */
void prove_e2e_check(e2e_receiver_t receiver, payload_t frame, size_t length, uint16_t data_id) {
    ASSUME(length <= 4); /* as many as decide; a longer one has a longer checksum only */
    ASSUME(receiver.candidate_frames < E2E_RESYNCHRONISE_FRAMES);
    const e2e_receiver_t before = receiver;
    const bool matches = e2e_checksum_matches(data_id, frame.byte, length);
    const uint8_t step = (uint8_t)(frame.byte[2] - before.counter);
    const e2e_result_t result = e2e_check(&receiver, data_id, frame.byte, length);
    CLAIM(matches == (result != E2E_WRONG_CHECKSUM) && IMPLIES(length < E2E_HEADER_BYTES, !matches));
    CLAIM(receiver.candidate_frames < E2E_RESYNCHRONISE_FRAMES && receiver.locked == before.locked);
    CLAIM(IMPLIES(result == E2E_ACCEPTED, !before.synchronised || (step >= 1 && step <= E2E_COUNTER_STEP_MAX)));
    CLAIM(IMPLIES(result == E2E_RESYNCHRONISED, !before.locked && before.synchronised && step != 0 &&
                                                    before.candidate_frames == E2E_RESYNCHRONISE_FRAMES - 1));
    if (result == E2E_ACCEPTED || result == E2E_RESYNCHRONISED) {
        CLAIM(receiver.synchronised && receiver.counter == frame.byte[2] && receiver.candidate_frames == 0);
    } else {
        CLAIM(receiver.counter == before.counter && receiver.checksum == before.checksum);
        CLAIM(receiver.synchronised == before.synchronised);
    }
    CLAIM(IMPLIES(result == E2E_WRONG_CHECKSUM || result == E2E_REPEATED,
                  receiver.candidate_frames == before.candidate_frames));
    CLAIM(IMPLIES(matches && before.synchronised && step >= 1 && step <= E2E_COUNTER_STEP_MAX, result == E2E_ACCEPTED));
}

void prove_e2e_receiver(e2e_receiver_t receiver) {
    const e2e_receiver_t before = receiver;
    e2e_receiver_restart(&receiver);
    CLAIM(!receiver.synchronised && !receiver.locked);
    CLAIM(receiver.counter == before.counter && receiver.checksum == before.checksum);
    e2e_receiver_init(&receiver);
    CLAIM(!receiver.synchronised && !receiver.locked && receiver.candidate_frames == 0);
}

/* An error of up to sixteen bits in succession changes the CRC. */
void prove_e2e_crc16(uint16_t crc, uint8_t first, uint8_t second, uint16_t burst) {
    ASSUME(burst != 0);
    static const uint8_t digits[9] = "123456789";
    CLAIM(e2e_crc16(0xFFFFu, digits, sizeof digits) == 0x29B1u); /* the header */
    const uint8_t bytes[2] = {first, second};
    const uint8_t changed[2] = {(uint8_t)(first ^ burst >> 8), (uint8_t)(second ^ burst)};
    CLAIM(e2e_crc16(crc, bytes, 2) != e2e_crc16(crc, changed, 2));
}

/* Ranges of the header, over the whole range of each argument. */
void prove_units_speed(int32_t speed_q22, int32_t milli_rpm) {
    const int32_t shown = units_milli_rpm(speed_q22);
    CLAIM(shown >= -4889240 && shown <= 4889240);
    const int32_t taken_q22 = units_speed_q22(milli_rpm);
    CLAIM(IMPLIES(milli_rpm > 4889239, taken_q22 == INT32_MAX) &&
          IMPLIES(milli_rpm < -4889239, taken_q22 == INT32_MIN));
    CLAIM(IMPLIES(milli_rpm > 0, taken_q22 > 0) && IMPLIES(milli_rpm < 0, taken_q22 < 0));
}

void prove_units_quarter_rpm(int32_t milli_rpm) {
    units_quarter_rpm(milli_rpm);
    ASSUME(milli_rpm >= INT16_MIN && milli_rpm <= INT16_MAX); /* more is too much for a solver */
    const int32_t quarters = units_quarter_rpm(milli_rpm);
    const int64_t error = milli_rpm - quarters * INT64_C(250);
    CLAIM(error >= -125 && error < 125); /* to nearest, halves upwards */
}

void prove_units(uint32_t angle, int32_t value, int64_t position) {
    CLAIM((uint32_t)(angle - ((uint32_t)units_angle_u16(angle) << 16) + 0x8000u) < 0x10000u);
    CLAIM(units_deviation_q20(value) >= -(1 << 19) && units_deviation_q20(value) <= 1 << 19);
    CLAIM(units_torque_q8(value) >= -32768 && units_torque_q8(value) <= 32768);
    CLAIM((int64_t)value - units_torque_q8(value) * INT64_C(65536) < 32768);
    CLAIM((int64_t)value - units_torque_q8(value) * INT64_C(65536) >= -32768);
    CLAIM(units_position_q18(units_position(value)) == value);
    ASSUME(position < INT64_C(1) << 62 && position > -(INT64_C(1) << 62)); /* the header */
    units_position_q18(position);
    ASSUME(value >= -(1 << 23) && value < 1 << 23); /* the signal's 24 bits */
    CLAIM(units_torque_q24(value) / 256 == value);
}
