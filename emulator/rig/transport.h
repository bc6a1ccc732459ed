/* Connection of clients to the emulated bus: the local bus (transport_local.c) or SocketCAN (transport_socketcan.c).
 *
 * A transport only carries frames. Their meaning, their timing on the bus and the clock belong to the rig.
 */
#ifndef RIG_TRANSPORT_H
#define RIG_TRANSPORT_H

#include <poll.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "rig/transport_frame.h"

#define TRANSPORT_DESCRIPTORS_MAX 72
#define TRANSPORT_ERROR_SIZE 256

/* Origin of a frame that is sent to the clients; it determines how the frame's time is conveyed. */
typedef enum {
    TRANSPORT_FROM_EMULATOR,       /* the drive or the rig */
    TRANSPORT_FROM_OTHER,          /* another node of the emulated bus, or a client's frame once more: any identifier */
    TRANSPORT_CLOCK,               /* RIG_CLOCK, carries its time itself */
    TRANSPORT_FROM_CLIENT_ON_BUS,  /* completed on the emulated bus */
    TRANSPORT_FROM_CLIENT_OFF_BUS, /* never on the emulated bus: rig, error, flexible data rate */
} transport_origin_t;

/* Treatment of a client whose queue is full. */
typedef enum {
    TRANSPORT_WAIT,          /* time waits until the client reads or leaves */
    TRANSPORT_WAIT_FOR_READ, /* time waits as long as the client reads; one that does not is disconnected */
    TRANSPORT_DROP,          /* the frames that do not fit are lost to it and counted */
} transport_full_t;

/* Receiver of the clients' frames: the rig. Clients are numbered from 1 in the order they connected. */
typedef struct {
    void *context;
    bool (*may_read)(void *context, uint32_t client); /* the client's next frame may be taken */
    bool (*take)(void *context, uint32_t client, const transport_frame_t *frame); /* false: disconnect */
} transport_receiver_t;

typedef struct transport transport_t;

/* Base of all transports, their first member. The functions are called through transport_* below. */
struct transport {
    size_t (*descriptors)(transport_t *transport, struct pollfd *list);
    size_t (*read)(transport_t *transport, const transport_receiver_t *receiver);
    void (*send)(transport_t *transport, uint64_t time_ns, transport_origin_t origin, const transport_frame_t *frame);
    void (*flush)(transport_t *transport);
    void (*close)(transport_t *transport);
    bool (*connected)(transport_t *transport, uint32_t client);
    bool (*in_use)(transport_t *transport);
    transport_full_t full;
    bool unstamped;                 /* no frames that convey the time of others */
    bool (*give_up)(void *context); /* true: the program is to end, wait for no client; NULL: never */
    void *give_up_context;
    const char *failure; /* reason why the transport cannot continue, or NULL */
};

/* Fills in up to TRANSPORT_DESCRIPTORS_MAX entries to poll for new frames and clients; returns how many. */
static inline size_t transport_descriptors(transport_t *transport, struct pollfd *list) {
    return transport->descriptors(transport, list);
}

/* Accepts new clients and hands over their frames, one frame per client in turn, in the order of connection,
 * until a round yields none. Never waits. Returns the number of frames handed over. */
static inline size_t transport_read(transport_t *transport, const transport_receiver_t *receiver) {
    return transport->read(transport, receiver);
}

/* Sends a frame to every client, its sender included. It may stay in a batch until transport_flush. */
static inline void transport_send(transport_t *transport, uint64_t time_ns, transport_origin_t origin,
                                  const transport_frame_t *frame) {
    transport->send(transport, time_ns, origin, frame);
}

/* Hands all batches over to the system. */
static inline void transport_flush(transport_t *transport) {
    transport->flush(transport);
}

/* False when the client has left, even when frames that it sent before are still unread. Always true on a transport
 * that does not know its clients. */
static inline bool transport_connected(transport_t *transport, uint32_t client) {
    return transport->connected(transport, client);
}

/* True when a client is connected, or a new one waits to be accepted. */
static inline bool transport_in_use(transport_t *transport) {
    return transport->in_use(transport);
}

/* Disconnects all clients, removes what was created, frees the transport. */
static inline void transport_close(transport_t *transport) {
    transport->close(transport);
}

/* Opens `address`, unix:PATH or socketcan:INTERFACE. NULL with a line in `error` on failure. */
transport_t *transport_open(const char *address, char error[TRANSPORT_ERROR_SIZE]);

/* Open one kind of transport by its part of the address, without the prefix. */
transport_t *transport_local_open(const char *path, char error[TRANSPORT_ERROR_SIZE]);
transport_t *transport_socketcan_open(const char *interface, char error[TRANSPORT_ERROR_SIZE]);

/* SocketCAN over a descriptor that is open already and keeps record boundaries (for tests: one end of a socket pair
 * stands in for an interface). Takes ownership of the descriptor. */
transport_t *transport_socketcan_attach(int descriptor);

#endif
