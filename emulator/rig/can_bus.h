/* Emulated CAN bus: bit rate, exact frame lengths, arbitration by identifier, error frames, error confinement.
 *
 * Nodes: each drive with three mailboxes (lowest identifier first, equal ones in the order of their requests), each
 * client with a queue in the order of arrival, a babbling node, and the bench's own interface, which only listens and
 * therefore acknowledges every frame. The node with the lowest arbitration field transmits. When several transmit the
 * same one, the first bit that differs is a bit error of those that sent it recessive; frames that are equal in every
 * bit are one frame. The counters change at the end of a frame or of an error frame.
 *
 * A drive can be disconnected: it is then alone on a line of its own, and no other node acknowledges its frames.
 *
 * A drive leaves bus-off on request (can_bus_rejoin); clients and babbling node do so by themselves. An error flag is
 * as long as with a receiver that is error active. Changes of a drive's counter and connection act when the frame
 * that is under way has ended. All times are arguments; the module has no clock.
 *
 * A frame is complete, and delivered, at the last bit of its end of frame; the next one starts three bits later.
 */
#ifndef RIG_CAN_BUS_H
#define RIG_CAN_BUS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "hal_can.h"
#include "rig/can_faults.h"
#include "rig/can_length.h"
#include "rig/can_line.h"
#include "rig/can_node.h"
#include "rig/can_wire.h"

#define CAN_BUS_CLIENT_QUEUE CAN_NODE_QUEUE_MAX
#define CAN_BUS_BIT_RATE_MIN 10000
#define CAN_BUS_BIT_RATE_MAX 1000000
#define CAN_BUS_NEVER UINT64_MAX
#define CAN_BUS_DRIVES_MAX 8

typedef struct {
    hal_can_frame_t frame;
    bool from_drive;
    bool from_client;  /* its first delivery: it completes a frame that a client sent */
    uint8_t to_drives; /* bit n: drive n receives it */
    bool to_clients;
} can_bus_delivery_t;

typedef struct {
    can_node_t node;
    uint32_t number; /* of the client */
} can_bus_client_t;

typedef struct {
    double load;         /* per cent of the bus, 0: off */
    uint32_t identifier; /* 11 bits */
    uint8_t length;      /* 0..8 bytes of data, which number the frames */
} can_babble_t;

typedef struct {
    can_node_t node;
    can_line_t alone;              /* its line while it is disconnected */
    bool disconnected, disconnect; /* now, and from the end of the present frame on */
    bool errors_set;
    unsigned errors_to_set;
} can_bus_drive_t;

typedef struct {
    /* Time at which can_bus_step is due, CAN_BUS_NEVER while nothing is to be sent. */
    uint64_t next_event_ns;
    /* A frame was queued on an idle bus, or a line has changed: can_bus_start is due. */
    bool start_requested;

    /* Settings. A change of `babble` requires can_bus_babble. */
    can_faults_t faults;
    can_babble_t babble;

    /* Private to can_bus.c. */
    can_length_t lengths;
    can_wire_t wires[CAN_LINE_TRANSMITTERS_MAX]; /* of a collision */
    uint32_t bit_rate;
    can_line_t shared;
    can_bus_drive_t drives[CAN_BUS_DRIVES_MAX];
    unsigned drive_count;
    can_node_t babbler;
    uint64_t babbled;
    can_bus_client_t **clients;
    unsigned client_count, client_capacity;
} can_bus_t;

/* Initialises an idle bus with one drive at time 0. bit_rate in bit/s, CAN_BUS_BIT_RATE_MIN..CAN_BUS_BIT_RATE_MAX.
 * seed: of faults. */
void can_bus_init(can_bus_t *bus, uint32_t bit_rate, uint64_t seed);

/* Adds a drive, whose number it returns, while there are fewer than CAN_BUS_DRIVES_MAX. */
unsigned can_bus_add_drive(can_bus_t *bus);

/* Frees the clients. */
void can_bus_close(can_bus_t *bus);

/* A drive puts a frame into a mailbox, as hal_can_transmit() of hal_can.h; false when that refuses it. A mailbox is
 * free again when its frame is complete. */
bool can_bus_transmit(can_bus_t *bus, unsigned drive, const hal_can_frame_t *frame);

/* A drive whose port chooses the mailbox (0..HAL_CAN_MAILBOXES - 1); false when it is taken, or in bus-off. */
bool can_bus_transmit_from(can_bus_t *bus, unsigned drive, unsigned mailbox, const hal_can_frame_t *frame);

/* Reset of a drive's controller at now_ns: error active, mailboxes empty. A frame that it transmits ends with an error;
 * one that another node transmits it does not receive. */
void can_bus_reset_drive(can_bus_t *bus, unsigned drive, uint64_t now_ns);

/* A drive leaves bus-off once 128 times 11 recessive bits have passed from now_ns on. */
void can_bus_rejoin(can_bus_t *bus, unsigned drive, uint64_t now_ns);

/* Queues a frame of a client, by its number; false when CAN_BUS_CLIENT_QUEUE of its frames wait. */
bool can_bus_push(can_bus_t *bus, uint32_t number, const hal_can_frame_t *frame);

/* Frames of a client that are not complete yet. */
size_t can_bus_client_backlog(const can_bus_t *bus, uint32_t number);

/* Removes the clients that have no frame left and are not connected. */
void can_bus_remove_clients(can_bus_t *bus, bool (*connected)(void *context, uint32_t client), void *context);

/* True when the client has a node on the bus: from its first frame on. */
bool can_bus_has_client(const can_bus_t *bus, uint32_t number);

/* Sets a drive's transmit error counter, 0..256; 256 is bus-off. */
void can_bus_set_transmit_errors(can_bus_t *bus, unsigned drive, unsigned errors);

/* Disconnects or connects a drive. */
void can_bus_disconnect(can_bus_t *bus, unsigned drive, bool disconnect);

/* Takes new settings of `babble` at now_ns. */
void can_bus_babble(can_bus_t *bus, uint64_t now_ns);

/* Starts arbitration on an idle bus; call it when all frames that are ready to send at `now_ns` are queued. */
void can_bus_start(can_bus_t *bus, uint64_t now_ns);

/* Processes the event due at next_event_ns. True when a frame is complete, in `delivery`. */
bool can_bus_step(can_bus_t *bus, can_bus_delivery_t *delivery);

#endif
