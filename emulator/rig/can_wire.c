#include "rig/can_wire.h"

#define STUFF_LIMIT 5u

typedef struct {
    can_wire_t *wire;
    unsigned run; /* equal bits at the end */
} writer_t;

static void put_bit(writer_t *writer, unsigned bit) {
    can_wire_t *wire = writer->wire;
    const bool equal = wire->bits > 0 && wire->bit[wire->bits - 1] == bit;
    writer->run = equal ? writer->run + 1 : 1;
    wire->bit[wire->bits++] = (uint8_t)bit;
    if (writer->run == STUFF_LIMIT) {
        wire->bit[wire->bits++] = !bit;
        writer->run = 1;
    }
}

static void put(writer_t *writer, uint32_t value, unsigned count) {
    while (count-- > 0) {
        put_bit(writer, value >> count & 1u);
    }
}

void can_wire_of(const can_length_t *tables, const hal_can_frame_t *frame, can_wire_t *wire) {
    writer_t writer = {.wire = wire};
    wire->bits = 0;
    put(&writer, 0, 1);
    if (frame->extended) {
        put(&writer, frame->identifier >> 18, 11);
        put(&writer, 3, 2);
        put(&writer, frame->identifier, 18);
        put(&writer, frame->remote, 1);
        wire->arbitration_bits = wire->bits;
        put(&writer, 0, 2);
    } else {
        put(&writer, frame->identifier, 11);
        put(&writer, frame->remote, 1);
        put(&writer, 0, 1); /* IDE, against an extended frame */
        wire->arbitration_bits = wire->bits;
        put(&writer, 0, 1);
    }
    put(&writer, frame->length, 4);
    const unsigned bytes = frame->remote ? 0 : frame->length < 8 ? frame->length : 8;
    for (unsigned i = 0; i < bytes; ++i) {
        put(&writer, frame->data[i], 8);
    }
    put(&writer, can_length_crc(tables, frame), 15);
}

unsigned can_wire_first_difference(const can_wire_t *left, const can_wire_t *right) {
    const unsigned bits = left->bits < right->bits ? left->bits : right->bits;
    unsigned index = 0;
    while (index < bits && left->bit[index] == right->bit[index]) {
        ++index;
    }
    return index;
}

unsigned can_wire_error_flag_bits(const can_wire_t *wire, unsigned index, unsigned level, bool passive) {
    unsigned run = 1;
    while (run < CAN_WIRE_FLAG_BITS && run <= index && wire->bit[index - run] == level) {
        ++run;
    }
    const unsigned flag_level = passive;
    const unsigned equal_before = level == flag_level ? run : 0;
    const unsigned until_receivers = run == CAN_WIRE_FLAG_BITS ? 0 : CAN_WIRE_FLAG_BITS - equal_before;
    return until_receivers + CAN_WIRE_FLAG_BITS;
}
