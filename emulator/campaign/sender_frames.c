#include "campaign/sender_frames.h"

#include <inttypes.h>
#include <math.h>
#include <string.h>

#include "campaign/drive_numbers.h"
#include "fault_kinds.h"
#include "rig_codec.h"

#define SEQUENCE_STEP_MAX 8 /* of the counter: frames that a receiver may take for lost ones */

/* AUTOSAR E2E profile 5; not the firmware's. */
static uint16_t checksum(uint16_t crc, uint8_t byte) {
    crc = (uint16_t)(crc ^ byte << 8);
    for (unsigned bit = 0; bit < 8; bit++) {
        crc = (uint16_t)(crc & 0x8000u ? (unsigned)crc << 1 ^ 0x1021u : (unsigned)crc << 1);
    }
    return crc;
}

void sender_protect(uint8_t *data, unsigned length, uint16_t data_id, uint8_t counter) {
    data[2] = counter;
    uint16_t crc = 0xFFFF;
    for (unsigned i = 2; i < length; i++) {
        crc = checksum(crc, data[i]);
    }
    crc = checksum(checksum(crc, (uint8_t)data_id), (uint8_t)(data_id >> 8));
    data[0] = (uint8_t)crc;
    data[1] = (uint8_t)(crc >> 8);
}

void sender_put(sender_t *sender, const transport_receiver_t *receiver, unsigned client, canid_t identifier,
                const uint8_t *data, unsigned length) {
    transport_frame_t frame;
    memset(&frame, 0, sizeof frame);
    frame.size = CAN_MTU;
    frame.classic.can_id = identifier;
    frame.classic.len = (uint8_t)length;
    memcpy(frame.classic.data, data, length);
    if (sender->record) {
        fprintf(sender->record, "%" PRIu64 " %u %x ", sender->time_us * 1000, client, (unsigned)identifier);
        for (unsigned i = 0; i < length; i++) {
            fprintf(sender->record, "%02x", data[i]);
        }
        fputc('\n', sender->record);
    }
    receiver->take(receiver->context, client, &frame);
}

bool sender_is_motion_command(unsigned identifier) {
    return identifier == DRIVE_COMMAND_FRAME_ID || identifier == DRIVE_TORQUE_COMMAND_FRAME_ID ||
           identifier == DRIVE_POSITION_COMMAND_FRAME_ID;
}

void sender_put_genuine(sender_t *sender, const transport_receiver_t *receiver, unsigned client, unsigned identifier,
                        const uint8_t *data, unsigned length) {
    sender_frame_t *kept = &sender->history[sender->sent++ % SENDER_HISTORY];
    const bool motion = sender_is_motion_command(identifier);
    const bool in_sequence = client == SENDER_HONEST || (uint8_t)(data[2] - sender->followed - 1u) < SEQUENCE_STEP_MAX;
    sender->followed = motion && in_sequence ? data[2] : sender->followed;
    *kept = (sender_frame_t){.length = (uint8_t)length,
                             .identifier = (uint16_t)identifier,
                             .sent_us = sender->time_us,
                             .other = client == SENDER_RIVAL,
                             .in_sequence = in_sequence};
    memcpy(kept->data, data, length);
    sender_put(sender, receiver, client, identifier, data, length);
}

void sender_put_command(sender_t *sender, const transport_receiver_t *receiver, unsigned client, uint8_t counter,
                        bool torque_mode, sender_request_t request, int32_t reference) {
    uint8_t data[7] = {[3] = (uint8_t)request};
    for (unsigned i = 0; i < 3; i++) {
        data[4 + i] = (uint8_t)((uint32_t)reference >> 8 * i);
    }
    sender_protect(data, sizeof data, torque_mode ? DRIVE_TORQUE_COMMAND_E2E_DATA_ID : DRIVE_COMMAND_E2E_DATA_ID,
                   counter);
    sender_put_genuine(sender, receiver, client, torque_mode ? DRIVE_TORQUE_COMMAND_FRAME_ID : DRIVE_COMMAND_FRAME_ID,
                       data, sizeof data);
}

void sender_put_position(sender_t *sender, const transport_receiver_t *receiver, uint8_t counter,
                         sender_request_t request, bool moves, double position_rev) {
    const struct drive_position_command_t command = {
        .request = (uint8_t)request,
        .order = moves ? DRIVE_POSITION_COMMAND_ORDER_PROFILE_CHOICE : DRIVE_POSITION_COMMAND_ORDER_HALT_CHOICE,
        .position_deg = (int32_t)floor(position_rev * SENDER_POSITIONS_PER_REV + 0.5),
    };
    uint8_t data[DRIVE_POSITION_COMMAND_LENGTH];
    drive_position_command_pack(data, &command, sizeof data);
    sender_protect(data, sizeof data, DRIVE_POSITION_COMMAND_E2E_DATA_ID, counter);
    sender_put_genuine(sender, receiver, SENDER_HONEST, DRIVE_POSITION_COMMAND_FRAME_ID, data, sizeof data);
}

void sender_put_arm(sender_t *sender, const transport_receiver_t *receiver, unsigned step, uint32_t response) {
    uint8_t data[8] = {[3] = (uint8_t)step};
    for (unsigned i = 0; i < 4; i++) {
        data[4 + i] = (uint8_t)(response >> 8 * i);
    }
    sender_protect(data, sizeof data, DRIVE_ARM_E2E_DATA_ID, sender->arm_counter++);
    sender_put_genuine(sender, receiver, SENDER_HONEST, DRIVE_ARM_FRAME_ID, data, sizeof data);
}

void sender_put_set(sender_t *sender, const transport_receiver_t *receiver, unsigned identifier, uint16_t data_id,
                    uint8_t head, uint32_t value) {
    uint8_t data[8] = {[3] = head};
    for (unsigned i = 0; i < 4; i++) {
        data[4 + i] = (uint8_t)(value >> 8 * i);
    }
    sender_protect(data, sizeof data, data_id, sender->arm_counter++);
    sender_put_genuine(sender, receiver, SENDER_HONEST, identifier, data, sizeof data);
}

uint32_t sender_check_of_set(uint8_t index, uint32_t value) {
    uint32_t crc = UINT32_MAX;
    for (unsigned i = 0; i < 5; i++) {
        crc ^= i == 0 ? index : value >> 8 * (i - 1) & 0xFFu;
        for (unsigned bit = 0; bit < 8; bit++) {
            crc = crc >> 1 ^ (crc & 1u ? UINT32_C(0xEDB88320) : 0);
        }
    }
    return ~crc;
}

/* --- The bench --- */

static void put_bench(sender_t *sender, const transport_receiver_t *receiver, canid_t identifier, uint8_t head,
                      uint32_t bits, uint64_t at_us) {
    uint8_t data[8] = {head, (uint8_t)bits, (uint8_t)(bits >> 8), (uint8_t)(bits >> 16)};
    for (unsigned i = 0; i < 4; i++) {
        data[4 + i] = (uint8_t)((at_us == sender->time_us ? 0 : at_us) >> 8 * i);
    }
    sender_put(sender, receiver, SENDER_HONEST, identifier | CAN_EFF_FLAG, data, sizeof data);
}

bool sender_in_step(const sender_t *sender, uint64_t at_us) {
    return at_us >= sender->time_us && at_us < sender->time_us + SENDER_STEP_US;
}

void sender_put_events(sender_t *sender, const transport_receiver_t *receiver) {
    const world_t *world = sender->world;
    for (unsigned i = 0; i < world->events; i++) {
        const world_event_t *event = world_begun(world, i, UINT64_MAX);
        if (event == NULL || (event->kind != WORLD_SET && event->kind != WORLD_FAULT)) {
            continue;
        }
        for (unsigned end = 0; end < 2; end++) {
            const uint64_t at_us = end ? event->end_us : event->begin_us;
            if (!sender_in_step(sender, at_us) || (end && event->end_us == 0)) {
                continue;
            }
            if (event->kind == WORLD_SET) {
                put_bench(sender, receiver, RIG_SET_FRAME_ID, (uint8_t)event->what,
                          (uint32_t)(end ? event->raw_end : event->raw), at_us);
            } else {
                const uint32_t bits = fault_request_bits(&(fault_request_t){
                    .kind = (uint8_t)event->what,
                    .phase = (uint8_t)event->phase,
                    .leg = (uint8_t)event->leg,
                    .begins = !end,
                    .raw = event->raw,
                });
                put_bench(sender, receiver, RIG_FAULT_FRAME_ID, (uint8_t)bits, bits >> 8, at_us);
            }
        }
    }
}
