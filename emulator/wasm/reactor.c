/* The drive and its bench as a WebAssembly module, for a page and for Node: firmware, host port and emulator without a
 * socket, a file or a clock of the system.
 *
 * The caller is the one client of the bench, in lock-step. It speaks as a client of the local bus does, in frames of
 * Linux's layout; a RIG_RUN_UNTIL returns when its time has come. What the module gives back it hands to functions that
 * it imports from "bench", in parts of any size: records of 64-bit time and frame as on the local bus, and, where
 * asked for, compare values and rows of the true state as the host executable records them.
 *
 * The linear memory is the whole state: a copy of it is a snapshot. */
#include <stdlib.h>
#include <string.h>

#include "host/host_drive.h"
#include "host/machine_image.h"
#include "host/options.h"
#include "plant/recorder.h"
#include "rig/rig.h"
#include "rig/transport.h"

#define EXPORT(name) __attribute__((export_name(#name), used))
#define IMPORT(name) __attribute__((import_module("bench"), import_name(#name)))

#define ARGUMENTS_MAX 64
#define BATCH_BYTES 65536
#define CLIENT 1

IMPORT(frames) void bench_frames(const void *records, size_t bytes);
IMPORT(compare_values) void bench_compare_values(const void *values, size_t bytes);
IMPORT(rows) void bench_rows(const void *rows, size_t bytes);

/* Large: static. */
static rig_t rig;
static host_drive_t drive;
static machine_image_t image;
static recorder_t recorder; /* without a file: its rows are handed over */
static options_t options;
machine_tables_t machine_tables;

static transport_frame_t received; /* from the caller; size 0: none */
static uint8_t batch[BATCH_BYTES];
static size_t batched;
static uint64_t hash = UINT64_C(0xCBF29CE484222325);

/* FNV-1a over words instead of bytes. */
static void mix(uint64_t word) {
    hash = (hash ^ word) * UINT64_C(0x100000001B3);
    hash ^= hash >> 29; /* otherwise high bits would reach no low ones */
}

static void mix_number(double number) {
    uint64_t word;
    memcpy(&word, &number, sizeof word);
    mix(word);
}

static void mix_frame(uint64_t time_ns, const struct can_frame *frame) {
    uint64_t data;
    memcpy(&data, frame->data, sizeof data);
    mix(time_ns);
    mix((uint64_t)frame->can_id << 8 | frame->len);
    mix(data);
}

/* --- Transport to the caller --- */

static size_t no_descriptors(transport_t *transport, struct pollfd *list) {
    (void)transport;
    (void)list;
    return 0;
}

static size_t read_frame(transport_t *transport, const transport_receiver_t *receiver) {
    if (received.size == 0 || !receiver->may_read(receiver->context, CLIENT)) {
        return 0;
    }
    if (!receiver->take(receiver->context, CLIENT, &received)) {
        transport->failure = "too many frames wait for the bus";
    }
    received.size = 0;
    return 1;
}

static void flush(transport_t *transport) {
    (void)transport;
    if (batched > 0) {
        bench_frames(batch, batched);
        batched = 0;
    }
}

static void send(transport_t *transport, uint64_t time_ns, transport_origin_t origin, const transport_frame_t *frame) {
    /* The bits of a run do not depend on the steps in which the caller lets time pass. */
    if (origin != TRANSPORT_CLOCK && origin != TRANSPORT_FROM_CLIENT_OFF_BUS) {
        mix_frame(time_ns, &frame->classic);
    }
    if (batched + sizeof time_ns + frame->size > sizeof batch) {
        flush(transport);
    }
    memcpy(batch + batched, &time_ns, sizeof time_ns);
    memcpy(batch + batched + sizeof time_ns, &frame->flexible, frame->size);
    batched += sizeof time_ns + frame->size;
}

static bool always_connected(transport_t *transport, uint32_t client) {
    (void)transport;
    (void)client;
    return true;
}

static bool always_in_use(transport_t *transport) {
    (void)transport;
    return true;
}

static transport_t transport = {.descriptors = no_descriptors,
                                .read = read_frame,
                                .send = send,
                                .flush = flush,
                                .close = flush,
                                .connected = always_connected,
                                .in_use = always_in_use};

/* --- Observation --- */

static void after_interrupt(void *context) {
    (void)context;
    mix_number(rig.plant.rotor_angle_rad);
    mix_number(rig.plant.speed_rad_s);
    for (unsigned phase = 0; phase < rig.plant.machine->phases; ++phase) {
        mix_number(rig.plant.current_A[phase]);
    }
    if (options.record_switches) {
        bench_compare_values(&rig.board.active, sizeof rig.board.active);
    }
}

static void hand_over_row(void *context, const plant_t *plant) {
    recorder_sample(context, plant);
    bench_rows(recorder.buffer, recorder.buffered_bytes);
    recorder.buffered_bytes = 0;
}

/* --- Exports --- */

/* Memory for the arguments of start and take. */
EXPORT(allocate) void *allocate(size_t bytes) {
    return malloc(bytes);
}

/* Starts the bench at time 0. arguments: of the host executable, its name first, each ended by a zero; files of
 * recordings are not opened, they only ask for them. machine: a machine image, taken over. False after one line on
 * stderr. Once. */
EXPORT(start) bool start(char *arguments, size_t arguments_bytes, uint8_t *machine, size_t machine_bytes) {
    static char *list[ARGUMENTS_MAX + 1];
    int count = 0;
    for (size_t at = 0; at < arguments_bytes && count < ARGUMENTS_MAX; at += strlen(arguments + at) + 1) {
        list[count++] = arguments + at;
    }
    if (options_parse(&options, count, list) != OPTIONS_RUN ||
        !machine_image_take(&image, options.machine_image, machine, machine_bytes) ||
        !machine_image_tables(&image, &machine_tables_structure, &machine_tables)) {
        return false;
    }
    rig_config_t config = options_rig(&options, &image.machine);
    pacing_parse(&config.pacing, "lockstep");
    config.stop = (rig_stop_t){.descriptors = {-1, -1}};
    config.transport = &transport;
    rig_init(&rig, &config);
    if (options.record) {
        recorder.phases = image.machine.phases;
        plant_observe(&rig.plant, options.record_from_us * 1000, options.record_step_ns, hand_over_row, &recorder);
    }
    const drive_config_t drive_config = host_drive_config(&options, 0);
    rig_firmware_t firmware;
    if (options.drives != 1 || !host_drive_start(&drive, &rig.board, &drive_config, &firmware)) {
        return false;
    }
    rig.observer.after_interrupt = after_interrupt;
    rig_join(&rig, &firmware);
    return true;
}

/* Where the caller writes a frame for take. */
EXPORT(slot) void *slot(void) {
    return &received.flexible;
}

/* Takes the frame in the slot, of CAN_MTU or CANFD_MTU bytes; after a RIG_RUN_UNTIL time has passed. False for what is
 * no frame, and when too many of them wait for the bus. */
EXPORT(take) bool take(size_t bytes) {
    received.size = 0;
    return transport_frame_accept(&received, bytes) && rig_serve(&rig, 0);
}

EXPORT(time_ns) double time_ns(void) {
    return (double)rig.board.time_ns; /* exact for a hundred days */
}

/* Hash of the true state at each control interrupt and of each frame with its time, since the start. */
EXPORT(hash_high) uint32_t hash_high(void) {
    return (uint32_t)(hash >> 32);
}

EXPORT(hash_low) uint32_t hash_low(void) {
    return (uint32_t)hash;
}

/* Ends the recording: the last rows are handed over. Returns the header of their file, RECORDER_HEADER_BYTES. */
EXPORT(finish) const void *finish(void) {
    static char header[RECORDER_HEADER_BYTES];
    rig_finish(&rig);
    recorder_header(&recorder, header);
    return header;
}
