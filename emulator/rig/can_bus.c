#include "rig/can_bus.h"

#include <string.h>

#define NS_PER_S UINT64_C(1000000000)

/* Arbitration field as transmitted, first bit highest; the lowest value wins. Standard: identifier, RTR, IDE 0;
 * extended: base identifier, SRR 1, IDE 1, extension, RTR. */
static uint32_t arbitration_field(const hal_can_frame_t *frame) {
    uint32_t remote = frame->remote;
    if (!frame->extended) {
        return (frame->identifier & 0x7FFu) << 21 | remote << 20;
    }
    return (frame->identifier >> 18 & 0x7FFu) << 21 | UINT32_C(3) << 19 | (frame->identifier & 0x3FFFFu) << 1 | remote;
}

/* End of the bit `bits` after `start_ns`. */
static uint64_t bits_later(const can_bus_t *bus, uint64_t start_ns, unsigned bits) {
    return start_ns + bits * NS_PER_S / bus->bit_rate;
}

void can_bus_init(can_bus_t *bus, uint32_t bit_rate) {
    memset(bus, 0, offsetof(can_bus_t, client_queue));
    bus->client_pushed = bus->client_popped = 0;
    can_length_init(&bus->lengths);
    bus->bit_rate = bit_rate;
    bus->next_event_ns = CAN_BUS_NEVER;
}

bool can_bus_transmit(can_bus_t *bus, const hal_can_frame_t *frame) {
    for (unsigned i = 0; i < HAL_CAN_MAILBOXES; ++i) {
        if (!bus->mailbox[i].taken) {
            bus->mailbox[i].frame = *frame;
            bus->mailbox[i].taken = true;
            bus->mailbox[i].request = bus->requests++;
            bus->start_requested = bus->start_requested || bus->sender == CAN_BUS_IDLE;
            return true;
        }
    }
    return false;
}

size_t can_bus_client_backlog(const can_bus_t *bus) {
    return (size_t)(bus->client_pushed - bus->client_popped);
}

bool can_bus_push(can_bus_t *bus, const hal_can_frame_t *frame) {
    if (can_bus_client_backlog(bus) == CAN_BUS_CLIENT_QUEUE) {
        return false;
    }
    bus->client_queue[bus->client_pushed++ % CAN_BUS_CLIENT_QUEUE] = *frame;
    bus->start_requested = bus->start_requested || bus->sender == CAN_BUS_IDLE;
    return true;
}

/* Mailbox that the CAN controller of the drive sends next, or HAL_CAN_MAILBOXES. */
static unsigned best_mailbox(const can_bus_t *bus) {
    unsigned best = HAL_CAN_MAILBOXES;
    for (unsigned i = 0; i < HAL_CAN_MAILBOXES; ++i) {
        if (!bus->mailbox[i].taken) {
            continue;
        }
        if (best == HAL_CAN_MAILBOXES) {
            best = i;
            continue;
        }
        uint32_t candidate = arbitration_field(&bus->mailbox[i].frame);
        uint32_t present = arbitration_field(&bus->mailbox[best].frame);
        if (candidate < present || (candidate == present && bus->mailbox[i].request < bus->mailbox[best].request)) {
            best = i;
        }
    }
    return best;
}

static void arbitrate(can_bus_t *bus, uint64_t now_ns) {
    unsigned mailbox = best_mailbox(bus);
    bool drive = mailbox < HAL_CAN_MAILBOXES;
    bool client = can_bus_client_backlog(bus) > 0;
    if (!drive && !client) {
        bus->next_event_ns = CAN_BUS_NEVER;
        return;
    }
    const hal_can_frame_t *frame = drive ? &bus->mailbox[mailbox].frame : NULL;
    const hal_can_frame_t *head = client ? &bus->client_queue[bus->client_popped % CAN_BUS_CLIENT_QUEUE] : NULL;
    if (!drive || (client && arbitration_field(head) < arbitration_field(frame))) {
        bus->sender = CAN_BUS_CLIENT_SENDS;
        frame = head;
    } else {
        bus->sender = CAN_BUS_DRIVE_SENDS;
        bus->sending_mailbox = mailbox;
    }
    bus->frame_start_ns = now_ns;
    bus->sending_bits = can_length_bits(&bus->lengths, frame);
    bus->next_event_ns = bits_later(bus, now_ns, bus->sending_bits);
}

void can_bus_start(can_bus_t *bus, uint64_t now_ns) {
    bus->start_requested = false;
    if (bus->sender != CAN_BUS_IDLE) {
        return;
    }
    if (now_ns < bus->idle_from_ns) {
        bus->next_event_ns = bus->idle_from_ns;
    } else {
        arbitrate(bus, now_ns);
    }
}

bool can_bus_step(can_bus_t *bus, can_bus_delivery_t *delivery) {
    if (bus->sender == CAN_BUS_IDLE) {
        arbitrate(bus, bus->next_event_ns);
        return false;
    }
    delivery->from_drive = bus->sender == CAN_BUS_DRIVE_SENDS;
    if (delivery->from_drive) {
        delivery->frame = bus->mailbox[bus->sending_mailbox].frame;
        bus->mailbox[bus->sending_mailbox].taken = false;
    } else {
        delivery->frame = bus->client_queue[bus->client_popped++ % CAN_BUS_CLIENT_QUEUE];
    }
    bus->sender = CAN_BUS_IDLE;
    bus->start_requested = false;
    bus->idle_from_ns = bits_later(bus, bus->frame_start_ns, bus->sending_bits + CAN_LENGTH_INTERFRAME_BITS);
    bus->next_event_ns = bus->idle_from_ns;
    return true;
}
