/* The local bus: an AF_UNIX SOCK_SEQPACKET socket, one record per frame: virtual time in ns (8 bytes, little endian; 0
 * from clients), then struct can_frame or struct canfd_frame. Records of any other size, or with an impossible length
 * or identifier, are ignored and counted. An empty record ends the connection, as closing it does. The socket has mode
 * 0600: who may read and write it commands the drive.
 */
#define _GNU_SOURCE /* accept4, sendmmsg */

#include <errno.h>
#include <inttypes.h>
#include <linux/sockios.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#include "rig/transport.h"

#define CLIENTS_MAX 64
#define BATCH 256
#define SEND_BUFFER_BYTES (8 * 1024 * 1024) /* some 10,000 records; the default queue holds 278 */
#define READ_ROUNDS_MAX 65536 /* a client that never stops sending cannot hold up the others indefinitely */

/* Waiting for a client whose queue is full: rounds of a sleep of WAIT_SLEEP_MS, which the client's first read of a
 * quarter of the queue may end early, and of WAIT_BUSY_NS of this process's own processor time. */
#define WAIT_SLEEP_MS 10
#define WAIT_BUSY_NS INT64_C(1000000)
#define WAIT_ROUNDS 200 /* of TRANSPORT_WAIT_FOR_READ, without a read */

typedef struct {
    uint8_t time_ns[8];
    uint8_t frame[CANFD_MTU];
} record_t;

_Static_assert(sizeof(record_t) == 8 + CANFD_MTU, "a record has no padding");

typedef struct {
    int descriptor;
    uint32_t number;
    uint64_t malformed, dropped;
} client_t;

typedef struct {
    transport_t transport;
    int listener;
    char path[sizeof(((struct sockaddr_un *)0)->sun_path)];
    dev_t device; /* identifies the socket file, so that no other is removed */
    ino_t inode;
    uint32_t clients_ever;
    unsigned client_count;
    client_t clients[CLIENTS_MAX]; /* in the order of connection */
    unsigned batched;
    struct iovec spans[BATCH];
    struct mmsghdr messages[BATCH];
    record_t records[BATCH];
} local_t;

static void disconnect(local_t *local, unsigned index, const char *reason) {
    client_t *client = &local->clients[index];
    if (reason) {
        fprintf(stderr, "salient: client %" PRIu32 " of %s disconnected: %s\n", client->number, local->path, reason);
    }
    if (client->malformed) {
        fprintf(stderr, "salient: client %" PRIu32 " of %s sent %" PRIu64 " records that are not frames\n",
                client->number, local->path, client->malformed);
    }
    if (client->dropped) {
        fprintf(stderr, "salient: client %" PRIu32 " of %s lost %" PRIu64 " frames that it did not read in time\n",
                client->number, local->path, client->dropped);
    }
    close(client->descriptor);
    memmove(client, client + 1, (--local->client_count - index) * sizeof *client);
}

static void local_flush(transport_t *transport);

/* Polls first: accept4 allocates a file before it checks for a waiting client, and is called for every frame. */
static void accept_clients(local_t *local) {
    struct pollfd waiting = {.fd = local->listener, .events = POLLIN};
    while (poll(&waiting, 1, 0) > 0) {
        int descriptor = accept4(local->listener, NULL, NULL, SOCK_NONBLOCK | SOCK_CLOEXEC);
        if (descriptor < 0) {
            return;
        }
        if (local->client_count == CLIENTS_MAX) {
            fprintf(stderr, "salient: client rejected: %s already has %d clients\n", local->path, CLIENTS_MAX);
            close(descriptor);
            continue;
        }
        local_flush(&local->transport); /* the batch holds frames from before this client connected */
        int bytes = SEND_BUFFER_BYTES;
        if (setsockopt(descriptor, SOL_SOCKET, SO_SNDBUFFORCE, &bytes, sizeof bytes) != 0) {
            setsockopt(descriptor, SOL_SOCKET, SO_SNDBUF, &bytes, sizeof bytes);
        }
        local->clients[local->client_count++] = (client_t){.descriptor = descriptor, .number = ++local->clients_ever};
    }
}

static size_t local_descriptors(transport_t *transport, struct pollfd *list) {
    local_t *local = (local_t *)transport;
    list[0] = (struct pollfd){.fd = local->listener, .events = POLLIN};
    for (unsigned i = 0; i < local->client_count; ++i) {
        list[1 + i] = (struct pollfd){.fd = local->clients[i].descriptor, .events = POLLIN};
    }
    return 1 + local->client_count;
}

/* Index of the first client with this number or a later one. Numbers outlive a disconnection, indices do not. */
static unsigned index_from(const local_t *local, uint32_t number) {
    unsigned index = 0;
    while (index < local->client_count && local->clients[index].number < number) {
        ++index;
    }
    return index;
}

/* Without requested events, poll reports a hang-up or an error only. */
static bool hung_up(const client_t *client) {
    struct pollfd state = {.fd = client->descriptor};
    return poll(&state, 1, 0) > 0;
}

static bool local_connected(transport_t *transport, uint32_t number) {
    const local_t *local = (local_t *)transport;
    const unsigned index = index_from(local, number);
    return index < local->client_count && local->clients[index].number == number && !hung_up(&local->clients[index]);
}

static bool local_in_use(transport_t *transport) {
    const local_t *local = (local_t *)transport;
    for (unsigned i = 0; i < local->client_count; ++i) {
        if (!hung_up(&local->clients[i])) {
            return true;
        }
    }
    struct pollfd waiting = {.fd = local->listener, .events = POLLIN};
    return poll(&waiting, 1, 0) > 0;
}

/* Takes one record of a client, or its departure. */
static void read_one(local_t *local, unsigned index, const transport_receiver_t *receiver, size_t *taken) {
    client_t *client = &local->clients[index];
    record_t record;
    ssize_t size = recv(client->descriptor, &record, sizeof record, MSG_DONTWAIT | MSG_TRUNC);
    if (size < 0 && (errno == EAGAIN || errno == EINTR)) {
        return;
    }
    if (size <= 0) {
        disconnect(local, index, NULL);
        return;
    }
    transport_frame_t frame;
    size_t frame_size = (size_t)size - sizeof record.time_ns;
    if ((frame_size != CAN_MTU && frame_size != CANFD_MTU) || (size_t)size < sizeof record.time_ns) {
        ++client->malformed;
        return;
    }
    memcpy(&frame.flexible, record.frame, frame_size);
    if (!transport_frame_accept(&frame, frame_size)) {
        ++client->malformed;
        return;
    }
    ++*taken;
    uint32_t number = client->number;
    accept_clients(local); /* clients that connected before this frame was sent receive its results */
    if (!receiver->take(receiver->context, number, &frame)) {
        index = index_from(local, number); /* answering the frame may have disconnected any client */
        if (index < local->client_count && local->clients[index].number == number) {
            disconnect(local, index, "too many of its frames wait for the bus");
        }
    }
}

static size_t local_read(transport_t *transport, const transport_receiver_t *receiver) {
    local_t *local = (local_t *)transport;
    size_t taken = 0;
    for (unsigned round = 0; round < READ_ROUNDS_MAX; ++round) {
        struct pollfd list[TRANSPORT_DESCRIPTORS_MAX];
        uint32_t numbers[TRANSPORT_DESCRIPTORS_MAX];
        size_t count = local_descriptors(transport, list);
        for (size_t i = 1; i < count; ++i) {
            numbers[i] = local->clients[i - 1].number;
            if (!receiver->may_read(receiver->context, numbers[i])) {
                list[i].fd = -1;
            }
        }
        if (poll(list, count, 0) <= 0) {
            break;
        }
        for (size_t i = 1; i < count; ++i) {
            /* Answering one client may have disconnected another, or taken the last free entry of the bus queue. */
            unsigned index = index_from(local, numbers[i]);
            if (list[i].revents && index < local->client_count && local->clients[index].number == numbers[i] &&
                receiver->may_read(receiver->context, numbers[i])) {
                read_one(local, index, receiver, &taken);
            }
        }
        if (list[0].revents) {
            accept_clients(local);
        }
    }
    return taken;
}

static int64_t processor_time_ns(void) {
    struct timespec used;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &used);
    return (int64_t)used.tv_sec * 1000000000 + used.tv_nsec;
}

/* Bytes that the client has not read yet. */
static int unread_bytes(const client_t *client) {
    int bytes = 0;
    ioctl(client->descriptor, SIOCOUTQ, &bytes);
    return bytes;
}

/* Waits until the client's queue has room. False when TRANSPORT_WAIT_FOR_READ ends: the client has read nothing in
 * WAIT_ROUNDS rounds.
 *
 * The busy part of a round makes that independent of the computer's load: where processes compete for the processor,
 * this one's millisecond of processor time arrives as late as the client's. */
static bool wait_for_room(const local_t *local, const client_t *client) {
    int unread = unread_bytes(client);
    for (unsigned rounds = 0; rounds < WAIT_ROUNDS;) {
        struct pollfd writable = {.fd = client->descriptor, .events = POLLOUT};
        if (poll(&writable, 1, WAIT_SLEEP_MS) != 0) {
            return true;
        }
        if (local->transport.give_up && local->transport.give_up(local->transport.give_up_context)) {
            return true;
        }
        if (local->transport.full == TRANSPORT_WAIT) {
            continue;
        }
        for (const int64_t start_ns = processor_time_ns(); processor_time_ns() - start_ns < WAIT_BUSY_NS;) {
            sched_yield();
        }
        const int still_unread = unread_bytes(client);
        rounds = still_unread < unread ? 0 : rounds + 1;
        unread = still_unread;
    }
    return false;
}

/* Sends the batch to one client; false when the client is to be disconnected, with the reason, NULL when it left. */
static bool send_batch(local_t *local, client_t *client, const char **reason) {
    for (unsigned sent = 0; sent < local->batched;) {
        int result =
            sendmmsg(client->descriptor, local->messages + sent, local->batched - sent, MSG_DONTWAIT | MSG_NOSIGNAL);
        if (result > 0) {
            sent += (unsigned)result;
            continue;
        }
        if (errno == EINTR) {
            continue;
        }
        *reason = NULL;
        if (errno != EAGAIN && errno != ENOBUFS) {
            return false;
        }
        transport_t *transport = &local->transport;
        if (transport->full == TRANSPORT_DROP ||
            (transport->give_up && transport->give_up(transport->give_up_context))) {
            client->dropped += local->batched - sent;
            return true;
        }
        if (!wait_for_room(local, client)) {
            *reason = "its queue is full and it does not read";
            return false;
        }
    }
    return true;
}

static void local_flush(transport_t *transport) {
    local_t *local = (local_t *)transport;
    if (local->batched == 0) {
        return;
    }
    /* The first client last: in lock-step it is the test's bench as a rule, and once it has the clock's response, the
     * test's other clients read without waiting. */
    for (unsigned i = local->client_count; i-- > 0;) {
        const char *reason;
        if (!send_batch(local, &local->clients[i], &reason)) {
            disconnect(local, i, reason);
        }
    }
    local->batched = 0;
}

static void local_send(transport_t *transport, uint64_t time_ns, transport_origin_t origin,
                       const transport_frame_t *frame) {
    (void)origin; /* every record carries its time */
    local_t *local = (local_t *)transport;
    if (local->client_count == 0) {
        return;
    }
    record_t *record = &local->records[local->batched];
    for (unsigned i = 0; i < sizeof record->time_ns; ++i) {
        record->time_ns[i] = (uint8_t)(time_ns >> (8 * i));
    }
    memcpy(record->frame, &frame->flexible, frame->size);
    local->spans[local->batched].iov_len = sizeof record->time_ns + frame->size;
    if (++local->batched == BATCH) {
        local_flush(transport);
    }
}

static void local_close(transport_t *transport) {
    local_t *local = (local_t *)transport;
    local_flush(transport);
    while (local->client_count > 0) {
        disconnect(local, local->client_count - 1, NULL);
    }
    struct stat status;
    if (lstat(local->path, &status) == 0 && status.st_dev == local->device && status.st_ino == local->inode) {
        unlink(local->path);
    }
    close(local->listener);
    free(local);
}

/* Removes a socket without a server from `path`; false with a line in `error` when the path is in use. */
static bool remove_stale(const char *path, const struct sockaddr_un *address, char error[TRANSPORT_ERROR_SIZE]) {
    struct stat status;
    if (lstat(path, &status) != 0) {
        return true; /* nothing there; bind reports a missing folder */
    }
    if (!S_ISSOCK(status.st_mode)) {
        snprintf(error, TRANSPORT_ERROR_SIZE, "--can unix:%s: exists and is not a socket", path);
        return false;
    }
    int probe = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
    bool refused =
        probe >= 0 && connect(probe, (const struct sockaddr *)address, sizeof *address) != 0 && errno == ECONNREFUSED;
    if (probe >= 0) {
        close(probe);
    }
    if (!refused) {
        snprintf(error, TRANSPORT_ERROR_SIZE, "--can unix:%s: in use by another server", path);
        return false;
    }
    unlink(path);
    return true;
}

/* Binds a socket whose file only its owner can connect to, whatever the umask: its mode is the descriptor's,
 * which leaves no moment in which it is another one; the umask, of the whole process, could only take bits from it. */
static bool bind_private(int listener, const struct sockaddr_un *address) {
    return fchmod(listener, S_IRUSR | S_IWUSR) == 0 &&
           bind(listener, (const struct sockaddr *)address, sizeof *address) == 0 &&
           chmod(address->sun_path, S_IRUSR | S_IWUSR) == 0;
}

transport_t *transport_local_open(const char *path, char error[TRANSPORT_ERROR_SIZE]) {
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    if (strlen(path) >= sizeof address.sun_path) {
        snprintf(error, TRANSPORT_ERROR_SIZE, "--can unix:%.60s...: the path has %zu characters, must be at most %zu",
                 path, strlen(path), sizeof address.sun_path - 1);
        return NULL;
    }
    memcpy(address.sun_path, path, strlen(path) + 1);
    if (!remove_stale(path, &address, error)) {
        return NULL;
    }
    int listener = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    struct stat status;
    if (listener < 0 || !bind_private(listener, &address) || listen(listener, CLIENTS_MAX) != 0 ||
        lstat(path, &status) != 0) {
        snprintf(error, TRANSPORT_ERROR_SIZE, "--can unix:%s: %s", path, strerror(errno));
        if (listener >= 0) {
            close(listener);
        }
        return NULL;
    }
    local_t *local = calloc(1, sizeof *local);
    if (!local) {
        snprintf(error, TRANSPORT_ERROR_SIZE, "--can unix:%s: out of memory", path);
        close(listener);
        unlink(path);
        return NULL;
    }
    local->transport = (transport_t){.descriptors = local_descriptors,
                                     .read = local_read,
                                     .send = local_send,
                                     .flush = local_flush,
                                     .close = local_close,
                                     .connected = local_connected,
                                     .in_use = local_in_use};
    local->listener = listener;
    memcpy(local->path, path, strlen(path) + 1);
    local->device = status.st_dev;
    local->inode = status.st_ino;
    for (unsigned i = 0; i < BATCH; ++i) {
        local->spans[i].iov_base = &local->records[i];
        local->messages[i].msg_hdr.msg_iov = &local->spans[i];
        local->messages[i].msg_hdr.msg_iovlen = 1;
    }
    return &local->transport;
}
