#include "rig/can_bus.h"

#include <stdlib.h>
#include <string.h>

#include "plant/min_max.h"
#include "rig/can_wire.h"

#define NS_PER_S UINT64_C(1000000000)
#define SUSPEND_BITS 8 /* of an error-passive transmitter, after the interframe space */
#define RECESSIVE_SEQUENCE_BITS 11

/* End of the bit `bits` after `start_ns`. */
static uint64_t bits_later(const can_bus_t *bus, uint64_t start_ns, uint64_t bits) {
    return start_ns + bits * NS_PER_S / bus->bit_rate;
}

static uint64_t bits_between(const can_bus_t *bus, uint64_t from_ns, uint64_t to_ns) {
    return ((to_ns - from_ns) * bus->bit_rate + NS_PER_S / 2) / NS_PER_S;
}

void can_bus_init(can_bus_t *bus, uint32_t bit_rate, uint64_t seed) {
    memset(bus, 0, sizeof *bus);
    can_length_init(&bus->lengths);
    bus->bit_rate = bit_rate;
    bus->next_event_ns = bus->shared.next_event_ns = CAN_BUS_NEVER;
    can_faults_init(&bus->faults, seed);
    can_bus_add_drive(bus);
    can_node_init(&bus->babbler);
    bus->babble.length = 8;
}

unsigned can_bus_add_drive(can_bus_t *bus) {
    can_bus_drive_t *drive = &bus->drives[bus->drive_count];
    can_node_init(&drive->node);
    drive->alone.next_event_ns = CAN_BUS_NEVER;
    return bus->drive_count++;
}

void can_bus_close(can_bus_t *bus) {
    for (unsigned i = 0; i < bus->client_count; ++i) {
        can_node_close(&bus->clients[i]->node);
        free(bus->clients[i]);
    }
    free(bus->clients);
    bus->clients = NULL;
    bus->client_count = bus->client_capacity = 0;
}

static can_line_t *drive_line(can_bus_t *bus, can_bus_drive_t *drive) {
    return drive->disconnected ? &drive->alone : &bus->shared;
}

/* The drive whose controller a node is, or NULL. */
static const can_bus_drive_t *drive_of(const can_bus_t *bus, const can_node_t *node) {
    for (unsigned i = 0; i < bus->drive_count; ++i) {
        if (node == &bus->drives[i].node) {
            return &bus->drives[i];
        }
    }
    return NULL;
}

/* A change on an idle line: its next event is to be found anew. */
static void request_start(can_bus_t *bus, const can_line_t *line) {
    bus->start_requested = bus->start_requested || line->state == CAN_LINE_IDLE;
}

bool can_bus_transmit(can_bus_t *bus, unsigned drive, const hal_can_frame_t *frame) {
    return can_bus_transmit_from(bus, drive, can_node_free_mailbox(&bus->drives[drive].node, frame), frame);
}

bool can_bus_transmit_from(can_bus_t *bus, unsigned drive, unsigned mailbox, const hal_can_frame_t *frame) {
    can_node_t *node = &bus->drives[drive].node;
    if (node->bus_off || !can_node_load(node, mailbox, frame)) {
        return false;
    }
    request_start(bus, drive_line(bus, &bus->drives[drive]));
    return true;
}

void can_bus_rejoin(can_bus_t *bus, unsigned drive, uint64_t now_ns) {
    can_node_rejoin(&bus->drives[drive].node, now_ns);
    request_start(bus, drive_line(bus, &bus->drives[drive]));
}

void can_bus_reset_drive(can_bus_t *bus, unsigned drive, uint64_t now_ns) {
    can_node_t *node = &bus->drives[drive].node;
    can_line_t *line = drive_line(bus, &bus->drives[drive]);
    const bool under_way = line->state != CAN_LINE_IDLE;
    bus->drives[drive].errors_set = false;
    can_node_reset(node, under_way);
    if (under_way) {
        can_line_fall_silent(line, node, (unsigned)bits_between(bus, line->frame_start_ns, now_ns));
        line->next_event_ns = bits_later(bus, line->frame_start_ns, line->bits);
    }
    bus->start_requested = true;
}

static can_bus_client_t *find_client(const can_bus_t *bus, uint32_t number) {
    for (unsigned i = 0; i < bus->client_count; ++i) {
        if (bus->clients[i]->number == number) {
            return bus->clients[i];
        }
    }
    return NULL;
}

static can_bus_client_t *add_client(can_bus_t *bus, uint32_t number) {
    if (bus->client_count == bus->client_capacity) {
        const unsigned capacity = bus->client_capacity ? 2 * bus->client_capacity : 8;
        can_bus_client_t **clients = realloc(bus->clients, capacity * sizeof(void *));
        if (!clients) {
            return NULL;
        }
        bus->clients = clients;
        bus->client_capacity = capacity;
    }
    can_bus_client_t *client = malloc(sizeof *client);
    if (client) {
        can_node_init(&client->node);
        client->number = number;
        bus->clients[bus->client_count++] = client;
    }
    return client;
}

size_t can_bus_client_backlog(const can_bus_t *bus, uint32_t number) {
    const can_bus_client_t *client = find_client(bus, number);
    return client ? can_node_backlog(&client->node) : 0;
}

bool can_bus_push(can_bus_t *bus, uint32_t number, const hal_can_frame_t *frame) {
    can_bus_client_t *client = find_client(bus, number);
    if (!client) {
        client = add_client(bus, number);
    }
    if (!client || !can_node_push(&client->node, frame)) {
        return false;
    }
    request_start(bus, &bus->shared);
    return true;
}

void can_bus_remove_clients(can_bus_t *bus, bool (*connected)(void *context, uint32_t client), void *context) {
    unsigned kept = 0;
    for (unsigned i = 0; i < bus->client_count; ++i) {
        can_bus_client_t *client = bus->clients[i];
        if (can_node_backlog(&client->node) > 0 || connected(context, client->number)) {
            bus->clients[kept++] = client;
        } else {
            can_node_close(&client->node);
            free(client);
        }
    }
    bus->client_count = kept;
}

bool can_bus_has_client(const can_bus_t *bus, uint32_t number) {
    return find_client(bus, number) != NULL;
}

/* Forced counters and connection of a drive, while no frame is under way on its line. True when it changes lines. */
static bool apply_changes(can_bus_t *bus, can_bus_drive_t *drive) {
    if (drive_line(bus, drive)->state != CAN_LINE_IDLE) {
        return false;
    }
    if (drive->errors_set) {
        can_node_set_transmit_errors(&drive->node, drive->errors_to_set);
        drive->errors_set = false;
    }
    const bool changes = drive->disconnected != drive->disconnect;
    drive->disconnected = drive->disconnect;
    return changes;
}

void can_bus_set_transmit_errors(can_bus_t *bus, unsigned drive, unsigned errors) {
    bus->drives[drive].errors_set = true;
    bus->drives[drive].errors_to_set = errors;
    apply_changes(bus, &bus->drives[drive]);
    bus->start_requested = true;
}

void can_bus_disconnect(can_bus_t *bus, unsigned drive, bool disconnect) {
    bus->drives[drive].disconnect = disconnect;
    apply_changes(bus, &bus->drives[drive]);
    bus->start_requested = true;
}

static void fill_babbler(can_bus_t *bus, uint64_t not_before_ns) {
    can_mailbox_t *mailbox = &bus->babbler.mailbox[0];
    if (bus->babbler.bus_off || bus->babble.load <= 0 || mailbox->taken) {
        return;
    }
    hal_can_frame_t frame = {.identifier = bus->babble.identifier, .length = bus->babble.length};
    for (unsigned i = 0; i < frame.length && i < sizeof frame.data; ++i) {
        frame.data[i] = (uint8_t)(bus->babbled >> (8 * i));
    }
    ++bus->babbled;
    (void)can_node_load(&bus->babbler, 0, &frame);
    mailbox->not_before_ns = not_before_ns;
}

void can_bus_babble(can_bus_t *bus, uint64_t now_ns) {
    const can_line_t *line = &bus->shared;
    bool under_way = false;
    for (unsigned i = 0; line->state != CAN_LINE_IDLE && i < line->transmitters; ++i) {
        under_way = under_way || line->transmitter[i].node == &bus->babbler;
    }
    if (!under_way) {
        bus->babbler.mailbox[0].taken = false;
        fill_babbler(bus, now_ns);
    }
    request_start(bus, line);
}

/* Runs through the nodes of a line that may transmit. */
#define FOR_EACH_NODE(bus, line, node)                                                                                 \
    for (unsigned node##_index = 0; ((node) = node_of(bus, line, node##_index)) != NULL; ++node##_index)

/* Nodes of a line by index: the drives on it, then the others of the shared line; NULL after the last. */
static can_node_t *node_of(can_bus_t *bus, const can_line_t *line, unsigned index) {
    for (unsigned i = 0; i < bus->drive_count; ++i) {
        if (line == drive_line(bus, &bus->drives[i]) && index-- == 0) {
            return &bus->drives[i].node;
        }
    }
    if (line != &bus->shared) {
        return NULL;
    }
    if (index == 0) {
        return &bus->babbler;
    }
    return index - 1 < bus->client_count ? &bus->clients[index - 1]->node : NULL;
}

/* Draws the fault of a frame that is about to take part in arbitration for the first time. */
static void draw_fault(can_bus_t *bus, const can_node_t *node, can_mailbox_t *mailbox, uint64_t now_ns) {
    mailbox->drawn = true;
    mailbox->fault = can_faults_draw(&bus->faults, drive_of(bus, node) != NULL);
    if (mailbox->fault == CAN_FAULT_DELAYED) {
        mailbox->not_before_ns = now_ns + bus->faults.delay_ns;
    }
}

/* Mailbox that a node sends next, of equal ones the first, or NULL; *wake_ns: when another one may, if earlier. */
static can_mailbox_t *best_mailbox(can_bus_t *bus, can_node_t *node, uint64_t now_ns, uint64_t *wake_ns) {
    can_mailbox_t *best = NULL;
    for (unsigned i = 0; i < HAL_CAN_MAILBOXES; ++i) {
        can_mailbox_t *mailbox = &node->mailbox[i];
        if (!mailbox->taken) {
            continue;
        }
        if (!mailbox->drawn && mailbox->not_before_ns <= now_ns) {
            draw_fault(bus, node, mailbox, now_ns);
        }
        const uint64_t not_before_ns = max_u64(mailbox->not_before_ns, node->suspended_till_ns);
        if (not_before_ns > now_ns) {
            *wake_ns = min_u64(*wake_ns, not_before_ns);
        } else if (!best || mailbox->arbitration < best->arbitration) {
            best = mailbox;
        }
    }
    return best;
}

/* Counts the recessive bits that have passed on an idle line, for nodes in bus-off; *wake_ns as in best_mailbox. */
static void count_recessive(const can_bus_t *bus, const can_line_t *line, can_node_t *node, uint64_t now_ns,
                            uint64_t *wake_ns) {
    if (!node->rejoins) {
        return;
    }
    const uint64_t from_ns = max_u64(line->recessive_from_ns, node->rejoins_from_ns);
    const uint64_t done_ns = bits_later(bus, from_ns, (uint64_t)node->sequences_left * RECESSIVE_SEQUENCE_BITS);
    if (done_ns <= now_ns) {
        can_node_count_recessive(node, node->sequences_left);
    } else {
        *wake_ns = min_u64(*wake_ns, done_ns);
    }
}

/* A frame starts: what has been counted of the recessive bits before it is kept. */
static void keep_recessive(const can_bus_t *bus, const can_line_t *line, can_node_t *node, uint64_t now_ns) {
    const uint64_t from_ns = max_u64(line->recessive_from_ns, node->rejoins_from_ns);
    if (node->rejoins && from_ns < now_ns) {
        can_node_count_recessive(node, bits_between(bus, from_ns, now_ns) / RECESSIVE_SEQUENCE_BITS);
    }
}

/* Nodes that transmit, all with the lowest arbitration field; none: *wake_ns is the time of the next attempt. */
static void find_transmitters(can_bus_t *bus, can_line_t *line, uint64_t now_ns, uint64_t *wake_ns) {
    can_node_t *node;
    line->transmitters = 0;
    FOR_EACH_NODE(bus, line, node) {
        count_recessive(bus, line, node, now_ns, wake_ns);
        if (node == &bus->babbler) {
            fill_babbler(bus, now_ns);
        }
        can_mailbox_t *mailbox = node->bus_off ? NULL : best_mailbox(bus, node, now_ns, wake_ns);
        if (!mailbox) {
            continue;
        }
        const can_mailbox_t *leader = line->transmitters ? line->transmitter[0].mailbox : NULL;
        if (leader && mailbox->arbitration < leader->arbitration) {
            line->transmitters = 0;
        }
        if (line->transmitters == 0 ||
            (mailbox->arbitration == leader->arbitration && line->transmitters < CAN_LINE_TRANSMITTERS_MAX)) {
            line->transmitter[line->transmitters++] = (can_transmitter_t){node, mailbox};
        }
    }
    line->remaining = line->transmitters;
}

static void arbitrate(can_bus_t *bus, can_line_t *line, uint64_t now_ns) {
    uint64_t wake_ns = CAN_BUS_NEVER;
    find_transmitters(bus, line, now_ns, &wake_ns);
    if (line->transmitters == 0) {
        line->next_event_ns = wake_ns;
        return;
    }
    can_node_t *node;
    FOR_EACH_NODE(bus, line, node) {
        keep_recessive(bus, line, node, now_ns);
    }
    line->frame_start_ns = now_ns;
    can_line_plan_frame(line, line == &bus->shared, &bus->lengths, &bus->faults, bus->wires);
    line->next_event_ns = bits_later(bus, now_ns, line->bits);
}

static void start_line(can_bus_t *bus, can_line_t *line, uint64_t now_ns) {
    if (line->state != CAN_LINE_IDLE) {
        return;
    }
    if (now_ns < line->idle_from_ns) {
        line->next_event_ns = line->idle_from_ns;
    } else {
        arbitrate(bus, line, now_ns);
    }
}

/* The line whose event is next. */
static can_line_t *next_line(can_bus_t *bus) {
    can_line_t *next = &bus->shared;
    for (unsigned i = 0; i < bus->drive_count; ++i) {
        can_line_t *alone = &bus->drives[i].alone;
        next = alone->next_event_ns < next->next_event_ns ? alone : next;
    }
    return next;
}

void can_bus_start(can_bus_t *bus, uint64_t now_ns) {
    bus->start_requested = false;
    start_line(bus, &bus->shared, now_ns);
    for (unsigned i = 0; i < bus->drive_count; ++i) {
        can_bus_drive_t *drive = &bus->drives[i];
        if (drive->disconnected || drive->alone.next_event_ns != CAN_BUS_NEVER) {
            start_line(bus, &drive->alone, now_ns);
        }
    }
    bus->next_event_ns = next_line(bus)->next_event_ns;
}

static bool transmits(const can_line_t *line, const can_node_t *node) {
    for (unsigned i = 0; i < line->transmitters; ++i) {
        if (line->transmitter[i].node == node) {
            return true;
        }
    }
    return false;
}

static void suspend(const can_bus_t *bus, const can_line_t *line, can_node_t *node) {
    if (can_node_is_passive(node)) {
        node->suspended_till_ns = bits_later(bus, line->idle_from_ns, SUSPEND_BITS);
    }
}

static void transmission_failed(can_bus_t *bus, can_line_t *line, can_node_t *node, uint64_t now_ns) {
    can_node_transmit_error(node);
    suspend(bus, line, node);
    if (!drive_of(bus, node)) {
        can_node_rejoin(node, now_ns);
    }
}

/* Error confinement of the receivers. */
static void count_reception(can_bus_t *bus, const can_line_t *line, bool disturbed) {
    can_node_t *node;
    FOR_EACH_NODE(bus, line, node) {
        const bool integrates = node->integrates;
        node->integrates = false;
        if (node->bus_off || integrates || (!disturbed && node->receive_errors == 0) || transmits(line, node)) {
            continue;
        }
        if (disturbed) {
            can_node_receive_error(node);
        } else {
            can_node_received(node);
        }
    }
}

static void end_error_frame(can_bus_t *bus, can_line_t *line, uint64_t now_ns) {
    for (unsigned i = 0; i < line->transmitters; ++i) {
        can_node_t *node = line->transmitter[i].node;
        /* An error-passive node alone on its line does not count: it would else be bus-off when alone. */
        if (line->acknowledge_error && can_node_is_passive(node)) {
            suspend(bus, line, node);
        } else {
            transmission_failed(bus, line, node, now_ns);
        }
    }
    count_reception(bus, line, true);
}

/* The babbling node's next frame, `load` per cent of the time from the start of this one to the start of the next. */
static uint64_t next_babble_ns(const can_bus_t *bus, const can_line_t *line) {
    const double bits = (line->bits + CAN_LENGTH_INTERFRAME_BITS) * 100.0 / bus->babble.load;
    return bits_later(bus, line->frame_start_ns, (uint64_t)(bits + 0.5));
}

static void deliver(can_bus_t *bus, const can_line_t *line, can_bus_delivery_t *delivery) {
    const can_mailbox_t *mailbox = line->transmitter[0].mailbox;
    *delivery = (can_bus_delivery_t){.frame = mailbox->frame, .to_clients = true};
    unsigned senders = 0;
    for (unsigned i = 0; i < line->remaining; ++i) {
        const can_node_t *node = line->transmitter[i].node;
        const can_bus_drive_t *drive = drive_of(bus, node);
        senders |= drive ? 1u << (drive - bus->drives) : 0;
        delivery->from_client = delivery->from_client || (!drive && node != &bus->babbler);
    }
    delivery->from_drive = senders != 0;
    delivery->from_client = delivery->from_client && mailbox->fault != CAN_FAULT_DUPLICATED;
    if (mailbox->fault == CAN_FAULT_LOST) {
        delivery->to_clients = !delivery->from_drive;
        return;
    }
    for (unsigned i = 0; i < bus->drive_count; ++i) {
        const can_node_t *node = &bus->drives[i].node;
        const bool listens = !bus->drives[i].disconnected && !node->bus_off && !node->integrates;
        delivery->to_drives |= (uint8_t)((listens && !(senders >> i & 1u)) << i);
    }
}

static void end_frame(can_bus_t *bus, can_line_t *line, can_bus_delivery_t *delivery, uint64_t now_ns) {
    deliver(bus, line, delivery);
    const bool again = line->transmitter[0].mailbox->fault == CAN_FAULT_DUPLICATED;
    for (unsigned i = 0; i < line->transmitters; ++i) {
        can_node_t *node = line->transmitter[i].node;
        if (i >= line->remaining || again) {
            line->transmitter[i].mailbox->fault = CAN_FAULT_NONE;
            transmission_failed(bus, line, node, now_ns);
            continue;
        }
        can_node_transmitted(node);
        suspend(bus, line, node);
        can_node_complete(node, line->transmitter[i].mailbox);
        if (node == &bus->babbler && bus->babble.load > 0) {
            fill_babbler(bus, next_babble_ns(bus, line));
        }
    }
    count_reception(bus, line, false);
}

/* True when a frame is complete. */
static bool step_line(can_bus_t *bus, can_line_t *line, can_bus_delivery_t *delivery) {
    const uint64_t now_ns = line->next_event_ns;
    if (line->state == CAN_LINE_IDLE) {
        arbitrate(bus, line, now_ns);
        return false;
    }
    const bool complete = line->state == CAN_LINE_FRAME;
    line->recessive_from_ns = bits_later(bus, line->frame_start_ns, line->bits - line->recessive_bits);
    line->idle_from_ns = bits_later(bus, line->frame_start_ns, line->bits + line->bits_to_idle);
    if (complete) {
        if (line->bits_to_idle != CAN_LENGTH_INTERFRAME_BITS) { /* error flag after the last bit */
            line->recessive_from_ns = bits_later(bus, line->frame_start_ns, line->bits + CAN_WIRE_LAST_BIT_FLAG_BITS);
        }
        end_frame(bus, line, delivery, now_ns);
    } else {
        end_error_frame(bus, line, now_ns);
    }
    line->state = CAN_LINE_IDLE;
    line->next_event_ns = line->idle_from_ns;
    for (unsigned i = 0; i < bus->drive_count; ++i) {
        if (apply_changes(bus, &bus->drives[i])) {
            can_line_t *other = drive_line(bus, &bus->drives[i]);
            other->next_event_ns =
                other->state == CAN_LINE_IDLE ? max_u64(now_ns, other->idle_from_ns) : other->next_event_ns;
        }
    }
    return complete;
}

bool can_bus_step(can_bus_t *bus, can_bus_delivery_t *delivery) {
    const bool complete = step_line(bus, next_line(bus), delivery);
    bus->next_event_ns = next_line(bus)->next_event_ns;
    return complete;
}
