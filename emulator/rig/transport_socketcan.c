/* SocketCAN: one raw socket on an interface, which all clients share.
 *
 * The interface carries no virtual time, so RIG_STAMP frames do (rig.dbc): before each frame of the emulator one with
 * subject "next" ("next_of_any_node" when it is not one of drive or rig), and one with "oldest_on_bus" or
 * "oldest_at_once" when a frame of a client completes on the emulated bus or was taken immediately. Clients' frames are
 * on the interface already and are not sent again.
 */
#define _GNU_SOURCE /* SO_SNDBUFFORCE */

#include <errno.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "rig/transport.h"
#include "rig_codec.h"

#define BUFFER_BYTES (8 * 1024 * 1024)
#define FULL_WAITS 2000 /* of 1 ms */
#define ALL_CLIENTS 1   /* the interface does not report the sender of a frame */
#define READ_MAX 65536

typedef struct {
    transport_t transport;
    int descriptor;
    uint64_t dropped, rejected;
    char failure[TRANSPORT_ERROR_SIZE];
} socketcan_t;

static size_t socketcan_descriptors(transport_t *transport, struct pollfd *list) {
    list[0] = (struct pollfd){.fd = ((socketcan_t *)transport)->descriptor, .events = POLLIN};
    return 1;
}

/* The interface does not report its clients. */
static bool socketcan_connected(transport_t *transport, uint32_t client) {
    (void)transport;
    (void)client;
    return true;
}

static bool socketcan_in_use(transport_t *transport) {
    (void)transport;
    return true;
}

static void fail(socketcan_t *can) {
    snprintf(can->failure, sizeof can->failure, "CAN interface: %s", strerror(errno));
    can->transport.failure = can->failure;
}

static size_t socketcan_read(transport_t *transport, const transport_receiver_t *receiver) {
    socketcan_t *can = (socketcan_t *)transport;
    size_t taken = 0;
    while (taken < READ_MAX && receiver->may_read(receiver->context, ALL_CLIENTS)) {
        transport_frame_t frame;
        ssize_t size = recv(can->descriptor, &frame.flexible, sizeof frame.flexible, MSG_DONTWAIT);
        if (size <= 0) {
            if (size == 0 || (errno != EAGAIN && errno != EINTR)) {
                errno = size == 0 ? ENOTCONN : errno;
                fail(can);
            }
            break;
        }
        if (!transport_frame_accept(&frame, (size_t)size)) {
            continue;
        }
        ++taken;
        if (!receiver->take(receiver->context, ALL_CLIENTS, &frame) && can->rejected++ == 0) {
            fprintf(stderr, "salient: frames on the CAN interface are lost: too many wait for the emulated bus\n");
        }
    }
    return taken;
}

static void send_frame(socketcan_t *can, const transport_frame_t *frame) {
    for (unsigned waits = 0; !can->transport.failure;) {
        if (send(can->descriptor, &frame->flexible, frame->size, MSG_DONTWAIT | MSG_NOSIGNAL) >= 0) {
            return;
        }
        if (errno == EINTR) {
            continue;
        }
        if (errno != EAGAIN && errno != ENOBUFS) {
            fail(can);
            return;
        }
        if (can->transport.full == TRANSPORT_DROP || waits >= FULL_WAITS) {
            ++can->dropped;
            return;
        }
        /* A full device queue (ENOBUFS) does not show in poll. */
        nanosleep(&(struct timespec){.tv_nsec = 1000000}, NULL);
        ++waits;
    }
}

static void send_timestamp(socketcan_t *can, uint64_t time_ns, uint8_t subject) {
    if (can->transport.unstamped) {
        return;
    }
    struct rig_stamp_t timestamp;
    rig_stamp_set_time_ns(&timestamp, (int64_t)time_ns);
    timestamp.subject = subject;
    transport_frame_t frame = {.size = CAN_MTU,
                               .classic = {.can_id = RIG_STAMP_FRAME_ID | CAN_EFF_FLAG, .len = RIG_STAMP_LENGTH}};
    rig_stamp_pack(frame.classic.data, &timestamp, RIG_STAMP_LENGTH);
    send_frame(can, &frame);
}

static void socketcan_send(transport_t *transport, uint64_t time_ns, transport_origin_t origin,
                           const transport_frame_t *frame) {
    socketcan_t *can = (socketcan_t *)transport;
    switch (origin) {
    case TRANSPORT_FROM_EMULATOR:
        send_timestamp(can, time_ns, RIG_STAMP_SUBJECT_NEXT_CHOICE);
        send_frame(can, frame);
        break;
    case TRANSPORT_FROM_OTHER:
        send_timestamp(can, time_ns, RIG_STAMP_SUBJECT_NEXT_OF_ANY_NODE_CHOICE);
        send_frame(can, frame);
        break;
    case TRANSPORT_CLOCK:
        send_frame(can, frame);
        break;
    case TRANSPORT_FROM_CLIENT_ON_BUS:
        send_timestamp(can, time_ns, RIG_STAMP_SUBJECT_OLDEST_ON_BUS_CHOICE);
        break;
    case TRANSPORT_FROM_CLIENT_OFF_BUS:
        send_timestamp(can, time_ns, RIG_STAMP_SUBJECT_OLDEST_AT_ONCE_CHOICE);
        break;
    }
}

static void socketcan_flush(transport_t *transport) {
    (void)transport; /* frames are sent one by one */
}

static void socketcan_close(transport_t *transport) {
    socketcan_t *can = (socketcan_t *)transport;
    if (can->dropped) {
        fprintf(stderr, "salient: %llu frames did not fit into the CAN interface's queue\n",
                (unsigned long long)can->dropped);
    }
    close(can->descriptor);
    free(can);
}

transport_t *transport_socketcan_attach(int descriptor) {
    socketcan_t *can = calloc(1, sizeof *can);
    if (!can) {
        close(descriptor);
        return NULL;
    }
    can->transport = (transport_t){.descriptors = socketcan_descriptors,
                                   .read = socketcan_read,
                                   .send = socketcan_send,
                                   .flush = socketcan_flush,
                                   .close = socketcan_close,
                                   .connected = socketcan_connected,
                                   .in_use = socketcan_in_use};
    can->descriptor = descriptor;
    return &can->transport;
}

transport_t *transport_socketcan_open(const char *interface, char error[TRANSPORT_ERROR_SIZE]) {
    struct ifreq request = {0};
    if (strlen(interface) >= sizeof request.ifr_name) {
        snprintf(error, TRANSPORT_ERROR_SIZE, "--can socketcan:%.40s: an interface name has at most %zu characters",
                 interface, sizeof request.ifr_name - 1);
        return NULL;
    }
    int descriptor = socket(PF_CAN, SOCK_RAW | SOCK_CLOEXEC, CAN_RAW);
    if (descriptor < 0) {
        snprintf(error, TRANSPORT_ERROR_SIZE, "--can socketcan:%s: %s", interface,
                 errno == EAFNOSUPPORT ? "this kernel has no CAN (PF_CAN); use unix:PATH" : strerror(errno));
        return NULL;
    }
    memcpy(request.ifr_name, interface, strlen(interface));
    bool found = ioctl(descriptor, SIOCGIFINDEX, &request) == 0;
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = request.ifr_ifindex};
    if (!found || bind(descriptor, (struct sockaddr *)&address, sizeof address) != 0) {
        snprintf(error, TRANSPORT_ERROR_SIZE, "--can socketcan:%s: %s", interface,
                 !found && errno == ENODEV ? "no such interface" : strerror(errno));
        close(descriptor);
        return NULL;
    }
    if (ioctl(descriptor, SIOCGIFFLAGS, &request) != 0 || !(request.ifr_flags & IFF_UP)) {
        snprintf(error, TRANSPORT_ERROR_SIZE, "--can socketcan:%s: the interface is down (ip link set %s up)",
                 interface, interface);
        close(descriptor);
        return NULL;
    }
    int on = 1, bytes = BUFFER_BYTES;
    can_err_mask_t errors = CAN_ERR_MASK;
    setsockopt(descriptor, SOL_CAN_RAW, CAN_RAW_FD_FRAMES, &on, sizeof on);
    setsockopt(descriptor, SOL_CAN_RAW, CAN_RAW_ERR_FILTER, &errors, sizeof errors);
    const int force[] = {SO_SNDBUFFORCE, SO_RCVBUFFORCE}, plain[] = {SO_SNDBUF, SO_RCVBUF};
    for (unsigned i = 0; i < 2; ++i) {
        if (setsockopt(descriptor, SOL_SOCKET, force[i], &bytes, sizeof bytes) != 0) {
            setsockopt(descriptor, SOL_SOCKET, plain[i], &bytes, sizeof bytes);
        }
    }
    transport_t *transport = transport_socketcan_attach(descriptor);
    if (!transport) {
        snprintf(error, TRANSPORT_ERROR_SIZE, "--can socketcan:%s: out of memory", interface);
    }
    return transport;
}
