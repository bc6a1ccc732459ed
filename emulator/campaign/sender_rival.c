#include "campaign/sender_rival.h"

#include <string.h>

#include "campaign/drive_numbers.h"
#include "campaign/seeded.h"
#include "campaign/sender_frames.h"

static uint64_t draw(sender_t *sender) {
    return seeded_bits(sender->world->seed, SENDER_STREAM, sender->drawn++);
}

static void put_random(sender_t *sender, const transport_receiver_t *receiver, unsigned identifier, unsigned length) {
    uint8_t data[8];
    const uint64_t bits = draw(sender);
    memcpy(data, &bits, sizeof data);
    sender_put(sender, receiver, SENDER_RIVAL, identifier, data, length);
}

static void put_replay(sender_t *sender, const transport_receiver_t *receiver) {
    const uint64_t back = 5 + draw(sender) % (SENDER_HISTORY - 6);
    if (sender->sent > back) {
        const sender_frame_t *old = &sender->history[(sender->sent - back) % SENDER_HISTORY];
        sender_put(sender, receiver, SENDER_RIVAL, old->identifier, old->data, old->length);
    }
}

static void put_repeated(sender_t *sender, const transport_receiver_t *receiver) {
    if (sender->sent > 0) {
        const sender_frame_t *last = &sender->history[(sender->sent - 1) % SENDER_HISTORY];
        sender_put(sender, receiver, SENDER_RIVAL, last->identifier, last->data, last->length);
    }
}

/* A command of any kind with the next counter, its checksum off by a bit. */
static void put_forged(sender_t *sender, const transport_receiver_t *receiver) {
    uint8_t data[7] = {[3] = (uint8_t)(draw(sender) % 4)};
    sender_protect(data, sizeof data, DRIVE_COMMAND_E2E_DATA_ID, sender->counter);
    data[0] ^= (uint8_t)(1u << draw(sender) % 8);
    sender_put(sender, receiver, SENDER_RIVAL, DRIVE_COMMAND_FRAME_ID, data, sizeof data);
}

static void step_hostile(sender_t *sender, const transport_receiver_t *receiver, world_hostile_t sort) {
    static const unsigned commands[] = {DRIVE_COMMAND_FRAME_ID, DRIVE_TORQUE_COMMAND_FRAME_ID, DRIVE_ARM_FRAME_ID,
                                        DRIVE_PARAMETER_WRITE_FRAME_ID, DRIVE_PARAMETER_SET_CONTROL_FRAME_ID};
    const unsigned identifier = commands[draw(sender) % 5];
    switch (sort) {
    case WORLD_HOSTILE_NOISE:
        put_random(sender, receiver, identifier, identifier == DRIVE_COMMAND_FRAME_ID ? 7 : 8);
        break;
    case WORLD_HOSTILE_REPLAY:
        put_replay(sender, receiver);
        break;
    case WORLD_HOSTILE_LENGTH:
        put_random(sender, receiver, identifier, (unsigned)(draw(sender) % 9));
        break;
    case WORLD_HOSTILE_FORGED:
        put_forged(sender, receiver);
        break;
    case WORLD_HOSTILE_REPEAT:
        put_repeated(sender, receiver);
        break;
    case WORLD_HOSTILE_FLOOD:
        for (unsigned i = 0; i < 5; i++) {
            put_random(sender, receiver, (unsigned)(draw(sender) % 0x600), (unsigned)(draw(sender) % 9));
        }
        break;
    default:
        put_random(sender, receiver, DRIVE_STATUS_FRAME_ID + (unsigned)(draw(sender) % 16), 8);
        break;
    }
}

void sender_step_rival(sender_t *sender, const transport_receiver_t *receiver) {
    const world_t *world = sender->world;
    for (unsigned i = 0; i < world->events; i++) {
        const world_event_t *event = &world->event[i];
        if (event->kind == WORLD_HOSTILE && world_active(world, i, sender->time_us)) {
            step_hostile(sender, receiver, (world_hostile_t)event->what);
        }
        if (event->kind == WORLD_SECOND && world_active(world, i, sender->time_us) &&
            sender->time_us >= sender->second_due_us) {
            sender->second_due_us = sender->time_us + SENDER_COMMAND_PERIOD_US;
            sender_put_command(sender, receiver, SENDER_RIVAL, sender->second_counter++, false, SENDER_RUN,
                               -sender->reference / 2);
        }
    }
}
