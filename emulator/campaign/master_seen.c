#include "campaign/master.h"
#include "campaign/sender.h"

enum { DISABLE_VOLTAGE, QUICK_STOP, SHUTDOWN, DISABLE_OPERATION, ENABLE };
enum { NMT_START = 1, NMT_STOP = 2, NMT_PRE_OPERATIONAL = 128, NMT_RESET_NODE = 129, NMT_RESET_COMMUNICATION = 130 };

#define ORDER 0x10u
#define RELATIVE 0x40u
#define PLACED_BYTES 6

static unsigned decode(unsigned word) {
    return !(word & 2u)   ? DISABLE_VOLTAGE
           : !(word & 4u) ? QUICK_STOP
           : !(word & 1u) ? SHUTDOWN
           : !(word & 8u) ? DISABLE_OPERATION
                          : ENABLE;
}

static void withdraw(master_wish_t *wish, uint64_t time_ns) {
    wish->withdrawn_ns = wish->enabled ? time_ns : wish->withdrawn_ns;
    wish->enabled = false;
    wish->stop = MASTER_GOES_ON;
    wish->aimed = false;
    wish->targets = 0;
}

static void stop(master_wish_t *wish, master_stop_t how, uint64_t time_ns) {
    if (wish->enabled && wish->stop != how) {
        wish->stop = how;
        wish->stop_ns = time_ns;
    }
}

static void enable(master_wish_t *wish, uint64_t time_ns) {
    if (wish->prepared && wish->operational) {
        wish->enabled_ns = wish->enabled ? wish->enabled_ns : time_ns;
        wish->enabled = true;
        wish->stop = MASTER_GOES_ON;
    }
}

static void take_word(sender_t *sender, uint64_t time_ns, unsigned word) {
    master_wish_t *wish = &sender->master.wish;
    const unsigned option = sender->world->master.quick_stop_option;
    switch (decode(word)) {
    case DISABLE_VOLTAGE:
        wish->prepared = false;
        withdraw(wish, time_ns);
        break;
    case QUICK_STOP:
        wish->prepared = wish->prepared && wish->enabled && option >= 5;
        if (option == 0) {
            withdraw(wish, time_ns);
        } else {
            stop(wish, option >= 5 ? MASTER_HOLDS : MASTER_STOPS, time_ns);
        }
        break;
    case SHUTDOWN:
        wish->prepared = true;
        if (wish->stop == MASTER_GOES_ON) { /* otherwise the drive is in its quick stop, or still stops */
            withdraw(wish, time_ns);
        }
        break;
    case DISABLE_OPERATION:
        stop(wish, wish->stop == MASTER_HOLDS ? MASTER_HOLDS : MASTER_STOPS, time_ns);
        break;
    default:
        enable(wish, time_ns);
        break;
    }
    wish->word = (uint16_t)word;
}

static void take_nmt(sender_t *sender, uint64_t time_ns, const struct can_frame *frame) {
    master_wish_t *wish = &sender->master.wish;
    if (frame->len != 2 || (frame->data[1] != 0 && frame->data[1] != MASTER_NODE)) {
        return;
    }
    switch (frame->data[0]) {
    case NMT_START:
        wish->operational = true;
        break;
    case NMT_STOP:
    case NMT_PRE_OPERATIONAL:
        wish->operational = wish->prepared = false;
        if (sender->world->master.abort_option == 2) {
            withdraw(wish, time_ns);
        } else {
            stop(wish, MASTER_STOPS, time_ns);
        }
        break;
    case NMT_RESET_NODE:
    case NMT_RESET_COMMUNICATION:
        wish->operational = wish->prepared = false;
        withdraw(wish, time_ns);
        break;
    default:
        break;
    }
}

static int32_t number(const uint8_t *data) {
    return (int32_t)(data[0] | (uint32_t)data[1] << 8 | (uint32_t)data[2] << 16 | (uint32_t)data[3] << 24);
}

/* A set-point of profile position: a rise of bit 4 in operation enabled, before which bit 12 was low. */
static void take_target(sender_t *sender, uint64_t time_ns, const uint8_t *data, unsigned before) {
    master_t *master = &sender->master;
    master_wish_t *wish = &master->wish;
    const double value = number(&data[3]) / MASTER_UNITS;
    const bool enabled = wish->enabled && (master->drive.status & 0x6Fu) == 0x27;
    if (data[2] == MODE_PP && enabled && (wish->word & ORDER) && !(before & ORDER)) {
        const double from = wish->aimed ? wish->target_rev : master->drive.position / MASTER_UNITS;
        wish->target_rev = wish->word & RELATIVE ? from + value : value;
        wish->aimed = true;
        wish->targets++;
        wish->target_ns = time_ns;
    }
    wish->mode = data[2];
}

static void take_pdo(sender_t *sender, uint64_t time_ns, const struct can_frame *frame) {
    const unsigned before = sender->master.wish.word;
    take_word(sender, time_ns, frame->data[0] | (unsigned)frame->data[1] << 8);
    if (frame->can_id == 0x200 + MASTER_NODE && frame->len >= 7) {
        take_target(sender, time_ns, frame->data, before);
    }
}

/* A sign of the master by what the drive watches. */
static bool is_sign(const sender_t *sender, const struct can_frame *frame) {
    switch (sender->world->master.watch) {
    case WORLD_WATCH_HEARTBEAT:
        return frame->can_id == 0x700 + MASTER_OWN;
    case WORLD_WATCH_GUARDING:
        return frame->can_id == ((0x700 + MASTER_NODE) | CAN_RTR_FLAG);
    case WORLD_WATCH_PDO:
        return frame->can_id == 0x200 + MASTER_NODE && frame->len >= 7;
    default:
        return true;
    }
}

/* An expedited write of the controlword. */
static bool is_controlword(const struct can_frame *frame) {
    return frame->len == 8 && frame->data[1] == 0x40 && frame->data[2] == 0x60 && frame->data[0] >> 5 == 1;
}

void master_on_bus(sender_t *sender, uint64_t time_ns, const struct can_frame *frame) {
    master_wish_t *wish = &sender->master.wish;
    if (frame->can_id & CAN_EFF_FLAG) {
        return;
    }
    wish->unsure = wish->unsure || world_latest(sender->world, WORLD_NOISE, sender->time_us, true) != NULL;
    wish->sign_ns = is_sign(sender, frame) ? time_ns : wish->sign_ns;
    const unsigned base = frame->can_id & 0x780u;
    const bool own = (frame->can_id & 0x7Fu) == MASTER_NODE;
    if (frame->can_id == 0) {
        take_nmt(sender, time_ns, frame);
    } else if (own && base >= 0x200 && base <= 0x500 && (base & 0x80u) == 0 && frame->len >= 2) {
        take_pdo(sender, time_ns, frame);
    } else if (own && base == 0x600 && is_controlword(frame)) {
        take_word(sender, time_ns, frame->data[4] | (unsigned)frame->data[5] << 8);
    }
}

void master_on_frame(sender_t *sender, uint64_t time_ns, const struct can_frame *frame) {
    master_drive_t *drive = &sender->master.drive;
    master_wish_t *wish = &sender->master.wish;
    const bool second = frame->can_id == 0x280 + MASTER_NODE;
    if ((frame->can_id != 0x180 + MASTER_NODE && !second) || frame->len < 2) {
        return;
    }
    drive->heard = true;
    drive->status = (uint16_t)(frame->data[0] | (unsigned)frame->data[1] << 8);
    drive->status_ns = time_ns;
    if (second && frame->len == PLACED_BYTES) {
        drive->placed = true;
        drive->placed_ns = time_ns;
        drive->position = number(&frame->data[2]);
    }
    if ((drive->status & 0x4Fu) == 0x08 || ((drive->status & 0x4Fu) == 0x40 && wish->stop == MASTER_STOPS)) {
        wish->prepared = wish->prepared && (drive->status & 0x4Fu) != 0x08;
        withdraw(wish, time_ns);
    }
}
