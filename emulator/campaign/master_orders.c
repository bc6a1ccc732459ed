#include <math.h>

#include "campaign/master.h"
#include "campaign/sender.h"

#define STATE_BITS 0x6Fu
#define NO_FLAG_BITS 0x4Fu
#define EAGER_US 20000 /* half a period of the fault reset */

enum { ORDER = 0x10, IMMEDIATELY = 0x20, RELATIVE = 0x40, ENABLED = 0x0F };

/* Next step towards operation enabled. */
static uint16_t towards_enabled(const sender_t *sender, uint16_t status) {
    const world_master_t *setting = &sender->world->master;
    const bool eager = world_latest(sender->world, WORLD_EAGER, sender->time_us, true) != NULL;
    if ((status & NO_FLAG_BITS) == 0x40) {
        return 0x06;
    }
    if ((status & NO_FLAG_BITS) == 0x08) {
        return eager && sender->time_us / EAGER_US % 2 ? 0x80 : 0x00;
    }
    switch (status & STATE_BITS) {
    case 0x21:
        return 0x07;
    case 0x23:
    case 0x27:
        return ENABLED;
    case 0x07:
        return setting->quick_stop_option >= 5 ? ENABLED : 0x06;
    default:
        return 0x00;
    }
}

/* The n-th target that has begun; NULL: it has not. */
static const world_event_t *target(const sender_t *sender, unsigned number) {
    const world_t *world = sender->world;
    for (unsigned i = 0; i < world->events; i++) {
        const world_event_t *event = world_begun(world, i, sender->time_us);
        if (event != NULL && event->kind == WORLD_TARGET && number-- == 0) {
            return event;
        }
    }
    return NULL;
}

/* Bit 4 and what goes with it, until the drive has acknowledged. */
static uint16_t order_move(sender_t *sender, int32_t *position) {
    master_t *master = &sender->master;
    const bool acknowledged = (master->drive.status & STATUS_ACKNOWLEDGED) != 0;
    if (master->ordered && acknowledged) {
        master->ordered = false;
        master->taken++;
    }
    const world_event_t *next = target(sender, master->taken);
    if (next == NULL) {
        return 0;
    }
    *position = (int32_t)floor(next->value * MASTER_UNITS + 0.5);
    const uint16_t bits = (uint16_t)((next->what & WORLD_TARGET_IMMEDIATELY ? IMMEDIATELY : 0) |
                                     (next->what & WORLD_TARGET_RELATIVE ? RELATIVE : 0));
    master->ordered = master->ordered || !acknowledged;
    return master->ordered ? bits | ORDER : bits;
}

/* A cyclic target on its way to the last one, by half of the acceleration. */
static int32_t lead(sender_t *sender) {
    master_t *master = &sender->master;
    const world_master_t *setting = &sender->world->master;
    const world_event_t *to = world_latest(sender->world, WORLD_TARGET, sender->time_us, false);
    if (!master->follows) {
        master->follows = master->drive.placed;
        master->place_rev = master->drive.position / MASTER_UNITS;
        master->speed_rev_s = 0.0;
    }
    const double cycle_s = 1e-3 * setting->cycle_ms, rate = 0.5 * setting->acceleration_rpm_s / 60.0;
    const double way = (to == NULL ? master->place_rev : to->value) - master->place_rev;
    const double most = fmin(0.5 * setting->speed_rpm / 60.0, sqrt(1.5 * rate * fabs(way)));
    const double wanted = fabs(way) < 0.5 * rate * cycle_s * cycle_s ? way / cycle_s : copysign(most, way);
    const double change = fmin(fmax(wanted - master->speed_rev_s, -rate * cycle_s), rate * cycle_s);
    master->speed_rev_s += change;
    master->place_rev += master->speed_rev_s * cycle_s;
    return (int32_t)floor(master->place_rev * MASTER_UNITS + 0.5);
}

master_orders_t master_orders(sender_t *sender) {
    master_t *master = &sender->master;
    const world_master_t *setting = &sender->world->master;
    const world_event_t *mode = world_latest(sender->world, WORLD_MODE, sender->time_us, false),
                        *control = world_latest(sender->world, WORLD_CONTROL, sender->time_us, true),
                        *aim = world_latest(sender->world, WORLD_TARGET, sender->time_us, false);
    const double sign = aim == NULL ? 0.0 : copysign(1.0, aim->value);
    master_orders_t orders = {
        .mode = (uint8_t)(mode != NULL ? mode->what : setting->mode),
        .word = master->drive.heard ? towards_enabled(sender, master->drive.status) : 0,
        .velocity = (int32_t)(sign * setting->speed_rpm),
        .torque = (int16_t)(sign * setting->torque * 1000.0),
        .position = master->drive.position,
    };
    const bool enabled = orders.word == ENABLED && (master->drive.status & STATE_BITS) == 0x27;
    if (orders.mode == MODE_CSP && enabled && control == NULL) {
        orders.position = lead(sender);
    } else {
        master->follows = false;
    }
    if (orders.mode == MODE_PP && enabled && control == NULL) {
        orders.word |= order_move(sender, &orders.position);
    } else {
        master->ordered = false;
    }
    if (orders.mode == MODE_HM && enabled && aim != NULL) {
        orders.word |= ORDER;
    }
    orders.word = control != NULL ? (uint16_t)control->what : orders.word;
    return orders;
}
