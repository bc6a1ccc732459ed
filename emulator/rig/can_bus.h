/* Emulated CAN bus: bit rate, exact frame lengths, arbitration by identifier.
 *
 * Two nodes send: the drive through three mailboxes (lowest identifier first, equal ones in the order of their
 * requests), and all clients together through one controller that sends in the order of arrival. The node with the
 * lower identifier wins arbitration; the drive on equal identifiers. There are no bit errors and every frame is
 * acknowledged. All times are arguments; the module has no clock.
 *
 * A frame is complete, and delivered, at the last bit of its end of frame; the next one starts three bits later.
 */
#ifndef RIG_CAN_BUS_H
#define RIG_CAN_BUS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "hal_can.h"
#include "rig/can_length.h"

#define CAN_BUS_CLIENT_QUEUE 65536 /* a power of two */
#define CAN_BUS_BIT_RATE_MIN 10000
#define CAN_BUS_BIT_RATE_MAX 1000000
#define CAN_BUS_NEVER UINT64_MAX

typedef struct {
    hal_can_frame_t frame;
    bool from_drive;
} can_bus_delivery_t;

typedef struct {
    /* Time at which can_bus_step is due, CAN_BUS_NEVER while nothing is to be sent. */
    uint64_t next_event_ns;
    /* A frame was queued on an idle bus: can_bus_start is due. */
    bool start_requested;

    /* Private to can_bus.c. */
    can_length_t lengths;
    uint32_t bit_rate;
    uint64_t frame_start_ns, idle_from_ns;
    enum { CAN_BUS_IDLE, CAN_BUS_DRIVE_SENDS, CAN_BUS_CLIENT_SENDS } sender;
    unsigned sending_mailbox, sending_bits;
    struct {
        hal_can_frame_t frame;
        bool taken;
        uint64_t request; /* sequence number of the request */
    } mailbox[HAL_CAN_MAILBOXES];
    uint64_t requests;
    hal_can_frame_t client_queue[CAN_BUS_CLIENT_QUEUE];
    uint64_t client_pushed, client_popped;
} can_bus_t;

/* Initialises an idle bus at time 0. bit_rate in bit/s, CAN_BUS_BIT_RATE_MIN..CAN_BUS_BIT_RATE_MAX. */
void can_bus_init(can_bus_t *bus, uint32_t bit_rate);

/* Drive: puts a frame into a free mailbox; false when all three are taken. A mailbox is free again when its frame is
 * complete. */
bool can_bus_transmit(can_bus_t *bus, const hal_can_frame_t *frame);

/* Clients: queues a frame; false when CAN_BUS_CLIENT_QUEUE frames wait. */
bool can_bus_push(can_bus_t *bus, const hal_can_frame_t *frame);

/* Number of client frames that are not complete yet. */
size_t can_bus_client_backlog(const can_bus_t *bus);

/* Starts arbitration on an idle bus; call it when all frames that are ready to send at `now_ns` are queued. */
void can_bus_start(can_bus_t *bus, uint64_t now_ns);

/* Processes the event due at next_event_ns. True when a frame is complete, in `delivery`. */
bool can_bus_step(can_bus_t *bus, can_bus_delivery_t *delivery);

#endif
