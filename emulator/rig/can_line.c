#include "rig/can_line.h"

#define CRC_MARGIN_BITS 6 /* a disturbed bit is not among the last of the CRC: its error flag ends in stuffed bits */

/* The present frame ends with an error flag of `flag_bits` after `bits` bits. */
static void plan_error(can_line_t *line, unsigned bits, unsigned flag_bits) {
    line->state = CAN_LINE_ERROR_FRAME;
    line->bits = bits + flag_bits + CAN_WIRE_ERROR_DELIMITER_BITS;
    line->bits_to_idle = CAN_LENGTH_INTERFRAME_BITS;
    line->recessive_bits = CAN_WIRE_ERROR_DELIMITER_BITS;
}

/* Several nodes transmit the same arbitration field. Those that send the first different bit recessive have a bit
 * error. One that is error active destroys the frame by its flag; those that are error passive stop, and the others
 * continue. */
static void collide(can_line_t *line, const can_length_t *lengths, can_wire_t *wires) {
    can_wire_t *wire[CAN_LINE_TRANSMITTERS_MAX];
    for (unsigned i = 0; i < line->transmitters; ++i) {
        wire[i] = &wires[i];
        can_wire_of(lengths, &line->transmitter[i].mailbox->frame, wire[i]);
    }
    for (;;) {
        unsigned index = wire[0]->bits;
        for (unsigned i = 1; i < line->remaining; ++i) {
            const unsigned difference = can_wire_first_difference(wire[0], wire[i]);
            index = difference < index ? difference : index;
        }
        if (index == wire[0]->bits) {
            return;
        }
        bool active = false;
        unsigned kept = 0;
        for (unsigned i = 0; i < line->remaining; ++i) {
            const bool recessive = wire[i]->bit[index];
            active = active || (recessive && !can_node_is_passive(line->transmitter[i].node));
        }
        if (active) {
            const can_wire_t *dominant = wire[0];
            for (unsigned i = 0; i < line->remaining; ++i) {
                dominant = wire[i]->bit[index] ? dominant : wire[i];
            }
            plan_error(line, index + 1, can_wire_error_flag_bits(dominant, index, 0, false));
            return;
        }
        for (unsigned i = 0; i < line->remaining; ++i) {
            if (!wire[i]->bit[index]) {
                const can_transmitter_t transmitter = line->transmitter[kept];
                can_wire_t *const other = wire[kept];
                line->transmitter[kept] = line->transmitter[i];
                wire[kept] = wire[i];
                line->transmitter[i] = transmitter;
                wire[i] = other;
                ++kept;
            }
        }
        line->remaining = kept;
    }
}

/* One bit between arbitration field and end of the CRC is inverted for all nodes; the transmitters detect it first. */
static void corrupt(can_line_t *line, const can_length_t *lengths, can_faults_t *faults) {
    can_wire_t wire;
    can_wire_of(lengths, &line->transmitter[0].mailbox->frame, &wire);
    const unsigned span = wire.bits - CRC_MARGIN_BITS - wire.arbitration_bits;
    const unsigned index = wire.arbitration_bits + can_faults_random(faults, span);
    const bool passive = can_node_is_passive(line->transmitter[0].node);
    plan_error(line, index + 1, can_wire_error_flag_bits(&wire, index, !wire.bit[index], passive));
}

void can_line_plan_frame(can_line_t *line, bool acknowledged, const can_length_t *lengths, can_faults_t *faults,
                         can_wire_t *wires) {
    can_mailbox_t *mailbox = line->transmitter[0].mailbox;
    line->state = CAN_LINE_FRAME;
    line->acknowledge_error = false;
    line->bits_to_idle = CAN_LENGTH_INTERFRAME_BITS;
    line->recessive_bits = CAN_WIRE_AFTER_ACKNOWLEDGE_BITS;
    if (line->transmitters > 1) {
        collide(line, lengths, wires);
        mailbox = line->transmitter[0].mailbox;
    }
    if (line->state == CAN_LINE_FRAME && mailbox->fault == CAN_FAULT_CORRUPTED) {
        mailbox->fault = CAN_FAULT_NONE;
        corrupt(line, lengths, faults);
    }
    if (line->state == CAN_LINE_ERROR_FRAME) {
        return;
    }
    line->bits = can_length_bits(lengths, &mailbox->frame);
    if (!acknowledged) {
        /* No other node superposes a flag. */
        plan_error(line, line->bits - CAN_WIRE_AFTER_ACKNOWLEDGE_BITS, CAN_WIRE_FLAG_BITS);
        line->acknowledge_error = true;
    } else if (mailbox->fault == CAN_FAULT_DUPLICATED) {
        line->bits_to_idle += CAN_WIRE_LAST_BIT_FLAG_BITS + CAN_WIRE_ERROR_DELIMITER_BITS;
    }
}

void can_line_fall_silent(can_line_t *line, const can_node_t *node, unsigned bits) {
    unsigned index = 0;
    while (index < line->transmitters && line->transmitter[index].node != node) {
        ++index;
    }
    if (index == line->transmitters) {
        return;
    }
    const bool sends = index < line->remaining;
    line->remaining -= sends;
    for (--line->transmitters; index < line->transmitters; ++index) {
        line->transmitter[index] = line->transmitter[index + 1];
    }
    if (sends && line->remaining == 0) {
        line->acknowledge_error = false;
        plan_error(line, bits + CAN_WIRE_FLAG_BITS, CAN_WIRE_FLAG_BITS);
    }
}
