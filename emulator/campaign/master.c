#include "campaign/master.h"

#include <string.h>

#include "campaign/seeded.h"
#include "campaign/sender.h"
#include "campaign/sender_frames.h"

#define CONFIGURED_FROM_US 4000 /* the drive has booted */
#define AGAIN_US 60000          /* after a command of the NMT the master begins once more */
#define NOISE_MAX 4             /* frames in a millisecond */

enum { SDO_REQUEST = 0x600, NMT = 0, SYNC = 0x80, LSS = 0x7E5, HEARTBEAT = 0x700 };

static void put(sender_t *sender, const transport_receiver_t *receiver, unsigned client, canid_t identifier,
                uint64_t value, unsigned length) {
    uint8_t data[8];
    for (unsigned i = 0; i < 8; i++) {
        data[i] = (uint8_t)(value >> 8 * i);
    }
    sender_put(sender, receiver, client, identifier, data, length);
}

/* --- Before the drive runs --- */

typedef struct {
    unsigned index, sub, bytes;
    uint32_t value;
} entry_t;

/* Writes of the setting, in order; returns their number. */
static unsigned list_entries(const world_t *world, entry_t list[48]) {
    const world_master_t *master = &world->master;
    const uint32_t speed = (uint32_t)master->speed_rpm, rate = (uint32_t)master->acceleration_rpm_s;
    const uint32_t watched = master->watch_ms, type = master->synchronous ? 1 : 255;
    const entry_t all[] = {
        {0x6060, 0, 1, master->mode},
        {0x6081, 0, 4, speed},
        {0x6083, 0, 4, rate},
        {0x6084, 0, 4, rate},
        {0x6085, 0, 4, rate},
        {0x6087, 0, 4, 5000},
        {0x605A, 0, 2, master->quick_stop_option},
        {0x6007, 0, 2, master->abort_option},
        {0x605D, 0, 2, master->halt_option},
        {0x60C2, 1, 1, master->cycle_ms},
        {0x607D, 1, 4, master->limited ? (uint32_t)(int32_t)(master->lowest_rev * MASTER_UNITS) : 0x80000000u},
        {0x607D, 2, 4, master->limited ? (uint32_t)(int32_t)(master->highest_rev * MASTER_UNITS) : 0x7FFFFFFFu},
        {0x1400, 1, 4, 0x80000200u + MASTER_NODE}, /* controlword, mode, target position */
        {0x1600, 0, 1, 0},
        {0x1600, 1, 4, 0x60400010},
        {0x1600, 2, 4, 0x60600008},
        {0x1600, 3, 4, 0x607A0020},
        {0x1600, 0, 1, 3},
        {0x1400, 2, 1, type},
        {0x1400, 5, 2, master->watch == WORLD_WATCH_PDO ? watched : 0},
        {0x1400, 1, 4, 0x200 + MASTER_NODE},
        {0x1402, 2, 1, type},
        {0x1403, 2, 1, type},
        {0x1801, 1, 4, 0xC0000280u + MASTER_NODE}, /* statusword, position */
        {0x1A01, 0, 1, 0},
        {0x1A01, 1, 4, 0x60410010},
        {0x1A01, 2, 4, 0x60640020},
        {0x1A01, 0, 1, 2},
        {0x1801, 5, 2, 5},
        {0x1801, 1, 4, 0x40000280u + MASTER_NODE},
        {0x1016, 1, 4, master->watch == WORLD_WATCH_HEARTBEAT ? MASTER_OWN << 16 | watched : 0},
        {0x100C, 0, 2, master->watch == WORLD_WATCH_GUARDING ? watched / 4 : 0},
        {0x100D, 0, 1, master->watch == WORLD_WATCH_GUARDING ? 4 : 0},
        {0x2F01, 0, 2, master->watch == WORLD_WATCH_SILENCE ? watched : 2000},
    };
    memcpy(list, all, sizeof all);
    return sizeof all / sizeof *all;
}

/* True once the setting has been written. */
static bool configure(sender_t *sender, const transport_receiver_t *receiver) {
    master_t *master = &sender->master;
    entry_t list[48];
    const unsigned count = list_entries(sender->world, list);
    if (master->written < count) {
        const entry_t *entry = &list[master->written++];
        put(sender, receiver, SENDER_HONEST, SDO_REQUEST + MASTER_NODE,
            (0x23u | (4u - entry->bytes) << 2) | (uint64_t)entry->index << 8 | (uint64_t)entry->sub << 24 |
                (uint64_t)entry->value << 32,
            8);
        return false;
    }
    if (master->started_us == 0) {
        master->started_us = sender->time_us;
        put(sender, receiver, SENDER_HONEST, NMT, 1 | MASTER_NODE << 8, 2);
        return false;
    }
    return true;
}

/* --- In a cycle --- */

static void put_watched(sender_t *sender, const transport_receiver_t *receiver) {
    master_t *master = &sender->master;
    const world_master_t *setting = &sender->world->master;
    const uint64_t period_us = setting->watch_ms * UINT64_C(1000) / 4;
    if (setting->watch == WORLD_WATCH_HEARTBEAT && sender->time_us >= master->heartbeat_us) {
        master->heartbeat_us = sender->time_us + period_us;
        put(sender, receiver, SENDER_HONEST, HEARTBEAT + MASTER_OWN, 5, 1);
    }
    if (setting->watch == WORLD_WATCH_GUARDING && sender->time_us >= master->guard_us) {
        master->guard_us = sender->time_us + period_us;
        put(sender, receiver, SENDER_HONEST, (HEARTBEAT + MASTER_NODE) | CAN_RTR_FLAG, 0, 0);
    }
}

static void put_orders(sender_t *sender, const transport_receiver_t *receiver) {
    const master_orders_t orders = master_orders(sender);
    put(sender, receiver, SENDER_HONEST, 0x200 + MASTER_NODE,
        orders.word | (uint64_t)orders.mode << 16 | (uint64_t)(uint32_t)orders.position << 24, 7);
    if (orders.mode == MODE_PV || orders.mode == MODE_CSV) {
        put(sender, receiver, SENDER_HONEST, 0x400 + MASTER_NODE,
            orders.word | (uint64_t)(uint32_t)orders.velocity << 16, 6);
    } else if (orders.mode == MODE_TQ || orders.mode == MODE_CST) {
        put(sender, receiver, SENDER_HONEST, 0x500 + MASTER_NODE, orders.word | (uint64_t)(uint16_t)orders.torque << 16,
            4);
    }
    if (sender->world->master.synchronous) {
        put(sender, receiver, SENDER_HONEST, SYNC, 0, 0);
    }
}

static void step_master(sender_t *sender, const transport_receiver_t *receiver) {
    master_t *master = &sender->master;
    const world_event_t *nmt = world_latest(sender->world, WORLD_NMT, sender->time_us, false);
    if (sender->time_us < CONFIGURED_FROM_US ||
        world_latest(sender->world, WORLD_LOST, sender->time_us, true) != NULL) {
        return;
    }
    if (nmt != NULL && sender_in_step(sender, nmt->begin_us)) {
        put(sender, receiver, SENDER_HONEST, NMT, nmt->what | MASTER_NODE << 8, 2);
        master->idle_us = sender->time_us + AGAIN_US;
        master->started_us = 0;
        master->written = nmt->what == 129 || nmt->what == 130 ? 0 : master->written;
        master->follows = false;
    }
    if (sender->time_us < master->idle_us || !configure(sender, receiver)) {
        return;
    }
    put_watched(sender, receiver);
    if (sender->time_us >= master->due_us) {
        master->due_us = sender->time_us + sender->world->master.cycle_ms * UINT64_C(1000);
        put_orders(sender, receiver);
    }
}

/* --- Others --- */

static uint64_t draw(sender_t *sender) {
    return seeded_bits(sender->world->seed, SENDER_STREAM + 1, sender->master.drawn++);
}

/* A request of SDO: of an object that there is, mostly. */
static uint64_t draw_request(sender_t *sender) {
    static const uint8_t codes[] = {0x2F, 0x2B, 0x27, 0x23, 0x22, 0x21, 0x40, 0x60, 0x70, 0x00, 0x10, 0x0F,
                                    0xA0, 0xA1, 0xA2, 0xA3, 0xC0, 0xC1, 0xC4, 0xC6, 0x80, 0x01, 0x81, 0x82};
    static const uint16_t indices[] = {0x1000, 0x1003, 0x1005, 0x1008, 0x100C, 0x1010, 0x1011, 0x1016, 0x1017, 0x1029,
                                       0x1400, 0x1401, 0x1600, 0x1601, 0x1800, 0x1A00, 0x2F00, 0x2F01, 0x6007, 0x6040,
                                       0x605A, 0x6060, 0x6064, 0x6065, 0x607A, 0x607D, 0x607E, 0x6081, 0x6083, 0x6085,
                                       0x6091, 0x6092, 0x6096, 0x6098, 0x60C2, 0x60FF, 0x6071, 0x6072};
    const uint64_t code = codes[draw(sender) % sizeof codes], random = draw(sender);
    const uint64_t index = random % 4 == 0 ? random >> 16 & 0xFFFF : indices[draw(sender) % 38];
    const uint64_t value = random % 3 == 0 ? draw(sender) & 0xFF : draw(sender) & UINT32_MAX;
    return code | index << 8 | (draw(sender) % 4) << 24 | value << 32;
}

static void put_noise(sender_t *sender, const transport_receiver_t *receiver) {
    static const unsigned identifiers[] = {0x000, SYNC,  LSS,   0x201, 0x301, 0x401, 0x501,
                                           0x601, 0x601, 0x601, 0x601, 0x701, 0x77F, 0x205};
    const unsigned identifier = identifiers[draw(sender) % 14];
    const bool remote = identifier == 0x701, right = draw(sender) % 4 != 0;
    const unsigned length = remote ? 0 : right ? (identifier == 0 ? 2 : 8) : (unsigned)(draw(sender) % 9);
    static const uint8_t commands[] = {1, 1, 1, 2, 128, 129, 130, 7};
    const uint64_t value = identifier == 0       ? commands[draw(sender) % 8] | (draw(sender) % 3) << 8
                           : identifier == 0x601 ? draw_request(sender)
                                                 : draw(sender);
    put(sender, receiver, SENDER_RIVAL, identifier | (remote ? CAN_RTR_FLAG : 0), value, length);
}

static void step_others(sender_t *sender, const transport_receiver_t *receiver) {
    if (world_latest(sender->world, WORLD_NOISE, sender->time_us, true) != NULL) {
        for (uint64_t count = draw(sender) % (NOISE_MAX + 1); count > 0; count--) {
            put_noise(sender, receiver);
        }
    }
    const world_event_t *rival = world_latest(sender->world, WORLD_MASTER, sender->time_us, true);
    if (rival != NULL && sender->time_us % 10000 == 0) {
        put(sender, receiver, SENDER_RIVAL, 0x300 + MASTER_NODE, rival->what | UINT64_C(3) << 16, 3);
    }
}

void master_step(sender_t *sender, const transport_receiver_t *receiver) {
    step_master(sender, receiver);
    step_others(sender, receiver);
}
