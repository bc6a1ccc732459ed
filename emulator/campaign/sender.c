#include "campaign/sender.h"

#include <inttypes.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "bench_variables.h"
#include "campaign/drive_numbers.h"
#include "campaign/seeded.h"
#include "rig_codec.h"

#define HASH_START UINT64_C(14695981039346656037)
#define HASH_PRIME UINT64_C(1099511628211)
#define COMMAND_PERIOD_US 10000
#define ARM_RETRY_US 20000
#define CONFIGURED_US 60000 /* then the client runs the drive, configured or not, */
#define LIMITED_US 200000   /* with several sessions */
#define SAVING_US 30000     /* in which a set is written */
#define SEQUENCE_STEP_MAX 8 /* of the counter: frames that a receiver may take for lost ones */
#define RECOVERY_OFF_US 25000
#define DUPLICATE_MAX_NS UINT64_C(20000000) /* of a frame, by a disturbed acknowledgement */
#define STREAM_HOSTILE 200

enum { HONEST = 1, OTHER = 2 };

static void mix(sender_t *sender, const void *bytes, size_t count) {
    const uint8_t *each = bytes;
    for (size_t i = 0; i < count; i++) {
        sender->hash = (sender->hash ^ each[i]) * HASH_PRIME;
    }
}

/* --- Frames --- */

/* AUTOSAR E2E profile 5; not the firmware's. */
static uint16_t checksum(uint16_t crc, uint8_t byte) {
    crc = (uint16_t)(crc ^ byte << 8);
    for (unsigned bit = 0; bit < 8; bit++) {
        crc = (uint16_t)(crc & 0x8000u ? (unsigned)crc << 1 ^ 0x1021u : (unsigned)crc << 1);
    }
    return crc;
}

static void protect(uint8_t *data, unsigned length, uint16_t data_id, uint8_t counter) {
    data[2] = counter;
    uint16_t crc = 0xFFFF;
    for (unsigned i = 2; i < length; i++) {
        crc = checksum(crc, data[i]);
    }
    crc = checksum(checksum(crc, (uint8_t)data_id), (uint8_t)(data_id >> 8));
    data[0] = (uint8_t)crc;
    data[1] = (uint8_t)(crc >> 8);
}

static void put(sender_t *sender, const transport_receiver_t *receiver, unsigned client, canid_t identifier,
                const uint8_t *data, unsigned length) {
    transport_frame_t frame;
    memset(&frame, 0, sizeof frame);
    frame.size = CAN_MTU;
    frame.classic.can_id = identifier;
    frame.classic.len = (uint8_t)length;
    memcpy(frame.classic.data, data, length);
    if (sender->record) {
        fprintf(sender->record, "%" PRIu64 " %u %x ", sender->time_us * 1000, client, (unsigned)identifier);
        for (unsigned i = 0; i < length; i++) {
            fprintf(sender->record, "%02x", data[i]);
        }
        fputc('\n', sender->record);
    }
    receiver->take(receiver->context, client, &frame);
}

static bool is_motion_command(unsigned identifier) {
    return identifier == DRIVE_COMMAND_FRAME_ID || identifier == DRIVE_TORQUE_COMMAND_FRAME_ID;
}

static void put_genuine(sender_t *sender, const transport_receiver_t *receiver, unsigned client, unsigned identifier,
                        const uint8_t *data, unsigned length) {
    sender_frame_t *kept = &sender->history[sender->sent++ % SENDER_HISTORY];
    const bool motion = is_motion_command(identifier);
    const bool in_sequence = client == HONEST || (uint8_t)(data[2] - sender->followed - 1u) < SEQUENCE_STEP_MAX;
    sender->followed = motion && in_sequence ? data[2] : sender->followed;
    *kept = (sender_frame_t){.length = (uint8_t)length,
                             .identifier = (uint16_t)identifier,
                             .sent_us = sender->time_us,
                             .other = client == OTHER,
                             .in_sequence = in_sequence};
    memcpy(kept->data, data, length);
    put(sender, receiver, client, identifier, data, length);
}

/* reference: LSBs of the speed or, in torque mode, of the torque. */
static void put_command(sender_t *sender, const transport_receiver_t *receiver, unsigned client, uint8_t counter,
                        bool torque_mode, sender_request_t request, int32_t reference) {
    uint8_t data[7] = {[3] = (uint8_t)request};
    for (unsigned i = 0; i < 3; i++) {
        data[4 + i] = (uint8_t)((uint32_t)reference >> 8 * i);
    }
    protect(data, sizeof data, torque_mode ? DRIVE_TORQUE_COMMAND_E2E_DATA_ID : DRIVE_COMMAND_E2E_DATA_ID, counter);
    put_genuine(sender, receiver, client, torque_mode ? DRIVE_TORQUE_COMMAND_FRAME_ID : DRIVE_COMMAND_FRAME_ID, data,
                sizeof data);
}

static void put_arm(sender_t *sender, const transport_receiver_t *receiver, unsigned step, uint32_t response) {
    uint8_t data[8] = {[3] = (uint8_t)step};
    for (unsigned i = 0; i < 4; i++) {
        data[4 + i] = (uint8_t)(response >> 8 * i);
    }
    protect(data, sizeof data, DRIVE_ARM_E2E_DATA_ID, sender->arm_counter++);
    put_genuine(sender, receiver, HONEST, DRIVE_ARM_FRAME_ID, data, sizeof data);
}

/* One byte and four: PARAMETER_WRITE, PARAMETER_SET_CONTROL. */
static void put_set(sender_t *sender, const transport_receiver_t *receiver, unsigned identifier, uint16_t data_id,
                    uint8_t head, uint32_t value) {
    uint8_t data[8] = {[3] = head};
    for (unsigned i = 0; i < 4; i++) {
        data[4 + i] = (uint8_t)(value >> 8 * i);
    }
    protect(data, sizeof data, data_id, sender->arm_counter++);
    put_genuine(sender, receiver, HONEST, identifier, data, sizeof data);
}

/* CRC-32 of IEEE 802.3 over index and value of a PARAMETER_WRITE. */
static uint32_t check_of_set(uint8_t index, uint32_t value) {
    uint32_t crc = UINT32_MAX;
    for (unsigned i = 0; i < 5; i++) {
        crc ^= i == 0 ? index : value >> 8 * (i - 1) & 0xFFu;
        for (unsigned bit = 0; bit < 8; bit++) {
            crc = crc >> 1 ^ (crc & 1u ? UINT32_C(0xEDB88320) : 0);
        }
    }
    return ~crc;
}

/* --- The bench --- */

static void put_bench(sender_t *sender, const transport_receiver_t *receiver, canid_t identifier, uint8_t head,
                      uint32_t bits, uint64_t at_us) {
    uint8_t data[8] = {head, (uint8_t)bits, (uint8_t)(bits >> 8), (uint8_t)(bits >> 16)};
    for (unsigned i = 0; i < 4; i++) {
        data[4 + i] = (uint8_t)((at_us == sender->time_us ? 0 : at_us) >> 8 * i);
    }
    put(sender, receiver, HONEST, identifier | CAN_EFF_FLAG, data, sizeof data);
}

static bool in_step(const sender_t *sender, uint64_t at_us) {
    return at_us >= sender->time_us && at_us < sender->time_us + SENDER_STEP_US;
}

static void put_events(sender_t *sender, const transport_receiver_t *receiver) {
    const world_t *world = sender->world;
    for (unsigned i = 0; i < world->events; i++) {
        const world_event_t *event = world_begun(world, i, UINT64_MAX);
        if (event == NULL || (event->kind != WORLD_SET && event->kind != WORLD_FAULT)) {
            continue;
        }
        for (unsigned end = 0; end < 2; end++) {
            const uint64_t at_us = end ? event->end_us : event->begin_us;
            if (!in_step(sender, at_us) || (end && event->end_us == 0)) {
                continue;
            }
            if (event->kind == WORLD_SET) {
                put_bench(sender, receiver, RIG_SET_FRAME_ID, (uint8_t)event->what,
                          (uint32_t)(end ? event->raw_end : event->raw), at_us);
            } else {
                const uint32_t place = event->phase | event->leg << 2 | (end ? 0u : 8u);
                put_bench(sender, receiver, RIG_FAULT_FRAME_ID, (uint8_t)event->what,
                          place | ((uint32_t)event->raw & 0xFFFFFu) << 4, at_us);
            }
        }
    }
}

/* --- The honest client --- */

static const world_event_t *active(const sender_t *sender, world_kind_t kind) {
    for (unsigned i = 0; i < sender->world->events; i++) {
        const world_event_t *event = &sender->world->event[i];
        if (event->kind == kind && world_active(sender->world, i, sender->time_us)) {
            return event;
        }
    }
    return NULL;
}

static bool has(const sender_t *sender, world_kind_t kind) {
    return active(sender, kind) != NULL;
}

static int32_t reference_of(const world_t *world, double rpm) {
    return (int32_t)floor(rpm / world->machine->command_lsb_rpm + 0.5);
}

/* Of 24 bits; at least an LSB beyond the range. */
static int32_t reference_beyond(const world_t *world, double part) {
    const int32_t largest = reference_of(world, world->machine->speed_command_max_rpm);
    const int32_t beyond = (int32_t)fmin(fmax(floor(fabs(part) * largest), largest + 1.0), 8388607.0);
    return part < 0.0 ? -beyond : beyond;
}

/* off for 20 ms, clear_fault for 20 ms, until the drive has left the state fault. */
static sender_request_t clearing(const sender_t *sender) {
    const uint64_t since_us = sender->time_us - sender->phase_us;
    return since_us % 40000 < 20000 ? SENDER_OFF : SENDER_CLEAR;
}

static sender_request_t wanted(sender_t *sender) {
    const world_t *world = sender->world;
    const bool recovers = world->recovery_us && sender->time_us >= world->recovery_us;
    const bool clears = recovers || has(sender, WORLD_EAGER);
    if (sender->state == STATE_FAULT && sender->last_state != STATE_FAULT) {
        sender->phase_us = sender->time_us;
    }
    if (recovers && sender->time_us < world->recovery_us + 2 * SENDER_STEP_US) {
        sender->phase_us = sender->time_us;
    }
    sender->last_state = sender->state;
    if (recovers && sender->time_us < world->recovery_us + RECOVERY_OFF_US) {
        /* A lost phase is used again after clear_fault, even where its loss was no fault. */
        const bool later = sender->time_us >= world->recovery_us + RECOVERY_OFF_US / 2;
        return later && has(sender, WORLD_DEGRADED) ? SENDER_CLEAR : SENDER_OFF;
    }
    const world_event_t *request = active(sender, WORLD_REQUEST);
    if (request && !recovers) {
        return (sender_request_t)request->what;
    }
    return clears && sender->state == STATE_FAULT ? clearing(sender) : SENDER_RUN;
}

/* Before it runs the drive the client configures it, each time armed for that. */
typedef enum { SESSION_NONE, SESSION_LIMIT, SESSION_SAVE, SESSION_DEGRADED } session_t;

static session_t session(const sender_t *sender) {
    const world_event_t *limited = active(sender, WORLD_LIMITED);
    session_t list[4] = {SESSION_NONE};
    unsigned count = 0;
    if (limited) {
        list[count++] = SESSION_LIMIT;
    }
    if (limited && limited->what) {
        list[count++] = SESSION_SAVE;
    }
    if (limited || has(sender, WORLD_DEGRADED)) {
        list[count++] = SESSION_DEGRADED;
    }
    return sender->configured < count ? list[sender->configured] : SESSION_NONE;
}

static bool configures(const sender_t *sender) {
    const uint64_t end_us = has(sender, WORLD_LIMITED) ? LIMITED_US : CONFIGURED_US;
    return (session(sender) != SESSION_NONE || sender->time_us < sender->resting_us) && sender->time_us < end_us;
}

static void put_one_parameter(sender_t *sender, const transport_receiver_t *receiver, unsigned index, uint32_t value,
                              uint32_t error) {
    put_set(sender, receiver, DRIVE_PARAMETER_SET_CONTROL_FRAME_ID, DRIVE_PARAMETER_SET_CONTROL_E2E_DATA_ID,
            DRIVE_PARAMETER_SET_CONTROL_STEP_BEGIN_CHOICE, 0);
    put_set(sender, receiver, DRIVE_PARAMETER_WRITE_FRAME_ID, DRIVE_PARAMETER_WRITE_E2E_DATA_ID, (uint8_t)index, value);
    put_set(sender, receiver, DRIVE_PARAMETER_SET_CONTROL_FRAME_ID, DRIVE_PARAMETER_SET_CONTROL_E2E_DATA_ID,
            DRIVE_PARAMETER_SET_CONTROL_STEP_APPLY_CHOICE, check_of_set((uint8_t)index, value) ^ error);
}

static void put_session(sender_t *sender, const transport_receiver_t *receiver) {
    const world_machine_t *machine = sender->world->machine;
    switch (session(sender)) {
    case SESSION_LIMIT: {
        /* In LSBs of 2^-24 of the unit of torque: a 256th of those of a command. */
        const double part = active(sender, WORLD_LIMITED)->value;
        const double raw = floor(part * machine->torque_max_Nm / machine->command_lsb_Nm) * 256.0;
        put_one_parameter(sender, receiver, sender->parameters.torque_max_Nm, (uint32_t)raw, 0);
        break;
    }
    case SESSION_SAVE:
        put_set(sender, receiver, DRIVE_PARAMETER_SET_CONTROL_FRAME_ID, DRIVE_PARAMETER_SET_CONTROL_E2E_DATA_ID,
                DRIVE_PARAMETER_SET_CONTROL_STEP_SAVE_CHOICE, 0);
        sender->resting_us = sender->time_us + SAVING_US;
        break;
    default: {
        const world_event_t *degraded = active(sender, WORLD_DEGRADED);
        const bool wrong = degraded && degraded->what == WORLD_DEGRADED_WRONG_CHECK;
        put_one_parameter(sender, receiver, sender->parameters.degraded_running, degraded != NULL, wrong);
        break;
    }
    }
}

static void configure(sender_t *sender, const transport_receiver_t *receiver) {
    if (sender->time_us < sender->resting_us) {
        return;
    }
    if (sender->challenge && sender->challenge_for == DRIVE_ARMING_ATTEMPT_CONFIGURATION_CHOICE) {
        put_arm(sender, receiver, DRIVE_ARM_STEP_CONFIRM_CONFIGURATION_CHOICE, ~sender->challenge);
        put_session(sender, receiver);
        sender->challenge = 0;
        sender->configured++;
    } else if (sender->state == STATE_READY && sender->time_us >= sender->requested_us + ARM_RETRY_US) {
        sender->requested_us = sender->time_us;
        put_arm(sender, receiver, DRIVE_ARM_STEP_REQUEST_CONFIGURATION_CHOICE, 0);
    }
}

static void step_honest(sender_t *sender, const transport_receiver_t *receiver) {
    const world_t *world = sender->world;
    for (unsigned i = 0; i < world->events; i++) {
        const world_event_t *event = world_begun(world, i, UINT64_MAX);
        if (event != NULL && event->kind == WORLD_SPEED && in_step(sender, event->begin_us)) {
            sender->reference = reference_of(world, event->value);
            sender->due_us = sender->time_us;
        }
    }
    const sender_request_t request = wanted(sender);
    if (world->recovery_us && sender->time_us >= world->recovery_us) {
        sender->reference = sender->recovery_reference;
    }
    if (has(sender, WORLD_SILENT) || sender->time_us < 2000) {
        return;
    }
    if (configures(sender)) {
        configure(sender, receiver);
        return;
    }
    if (request != sender->request || sender->time_us >= sender->due_us) {
        sender->request = request;
        sender->due_us = sender->time_us + COMMAND_PERIOD_US;
        const world_event_t *torque = active(sender, WORLD_TORQUE);
        const world_event_t *beyond = active(sender, WORLD_BEYOND);
        const int32_t reference = beyond   ? reference_beyond(world, beyond->value)
                                  : torque ? (int32_t)floor(torque->value / world->machine->command_lsb_Nm + 0.5)
                                           : sender->reference;
        const bool refers = request == SENDER_RUN || (world->keeps_reference && request != SENDER_CLEAR);
        put_command(sender, receiver, HONEST, sender->counter++, torque != NULL && beyond == NULL, request,
                    refers ? reference : 0);
    }
    if (request != SENDER_RUN || has(sender, WORLD_UNARMED) || sender->armed || sender->state == STATE_FAULT ||
        sender->state == STATE_INITIALISE) {
        return;
    }
    if (sender->challenge && sender->challenge_for == DRIVE_ARMING_ATTEMPT_RUN_CHOICE) {
        put_arm(sender, receiver, DRIVE_ARM_STEP_CONFIRM_RUN_CHOICE, ~sender->challenge);
        sender->challenge = 0;
    } else if (sender->time_us >= sender->requested_us + ARM_RETRY_US) {
        sender->requested_us = sender->time_us;
        put_arm(sender, receiver, DRIVE_ARM_STEP_REQUEST_RUN_CHOICE, 0);
    }
}

/* --- The second client --- */

static uint64_t draw(sender_t *sender) {
    return seeded_bits(sender->world->seed, STREAM_HOSTILE, sender->drawn++);
}

static void put_random(sender_t *sender, const transport_receiver_t *receiver, unsigned identifier, unsigned length) {
    uint8_t data[8];
    const uint64_t bits = draw(sender);
    memcpy(data, &bits, sizeof data);
    put(sender, receiver, OTHER, identifier, data, length);
}

static void put_replay(sender_t *sender, const transport_receiver_t *receiver) {
    const uint64_t back = 5 + draw(sender) % (SENDER_HISTORY - 6);
    if (sender->sent > back) {
        const sender_frame_t *old = &sender->history[(sender->sent - back) % SENDER_HISTORY];
        put(sender, receiver, OTHER, old->identifier, old->data, old->length);
    }
}

static void put_repeated(sender_t *sender, const transport_receiver_t *receiver) {
    if (sender->sent > 0) {
        const sender_frame_t *last = &sender->history[(sender->sent - 1) % SENDER_HISTORY];
        put(sender, receiver, OTHER, last->identifier, last->data, last->length);
    }
}

/* A command of any kind with the next counter, its checksum off by a bit. */
static void put_forged(sender_t *sender, const transport_receiver_t *receiver) {
    uint8_t data[7] = {[3] = (uint8_t)(draw(sender) % 4)};
    protect(data, sizeof data, DRIVE_COMMAND_E2E_DATA_ID, sender->counter);
    data[0] ^= (uint8_t)(1u << draw(sender) % 8);
    put(sender, receiver, OTHER, DRIVE_COMMAND_FRAME_ID, data, sizeof data);
}

static void step_hostile(sender_t *sender, const transport_receiver_t *receiver, world_hostile_t sort) {
    static const unsigned commands[] = {DRIVE_COMMAND_FRAME_ID, DRIVE_TORQUE_COMMAND_FRAME_ID, DRIVE_ARM_FRAME_ID,
                                        DRIVE_PARAMETER_WRITE_FRAME_ID, DRIVE_PARAMETER_SET_CONTROL_FRAME_ID};
    const unsigned identifier = commands[draw(sender) % 5];
    switch (sort) {
    case WORLD_HOSTILE_NOISE:
        put_random(sender, receiver, identifier, identifier == DRIVE_COMMAND_FRAME_ID ? 7 : 8);
        break;
    case WORLD_HOSTILE_REPLAY:
        put_replay(sender, receiver);
        break;
    case WORLD_HOSTILE_LENGTH:
        put_random(sender, receiver, identifier, (unsigned)(draw(sender) % 9));
        break;
    case WORLD_HOSTILE_FORGED:
        put_forged(sender, receiver);
        break;
    case WORLD_HOSTILE_REPEAT:
        put_repeated(sender, receiver);
        break;
    case WORLD_HOSTILE_FLOOD:
        for (unsigned i = 0; i < 5; i++) {
            put_random(sender, receiver, (unsigned)(draw(sender) % 0x600), (unsigned)(draw(sender) % 9));
        }
        break;
    default:
        put_random(sender, receiver, DRIVE_STATUS_FRAME_ID + (unsigned)(draw(sender) % 16), 8);
        break;
    }
}

static void step_other(sender_t *sender, const transport_receiver_t *receiver) {
    const world_t *world = sender->world;
    for (unsigned i = 0; i < world->events; i++) {
        const world_event_t *event = &world->event[i];
        if (event->kind == WORLD_HOSTILE && world_active(world, i, sender->time_us)) {
            step_hostile(sender, receiver, (world_hostile_t)event->what);
        }
        if (event->kind == WORLD_SECOND && world_active(world, i, sender->time_us) &&
            sender->time_us >= sender->second_due_us) {
            sender->second_due_us = sender->time_us + COMMAND_PERIOD_US;
            put_command(sender, receiver, OTHER, sender->second_counter++, false, SENDER_RUN, -sender->reference / 2);
        }
    }
}

/* --- Transport --- */

static size_t descriptors(transport_t *transport, struct pollfd *list) {
    (void)transport;
    (void)list;
    return 0;
}

static size_t read_clients(transport_t *transport, const transport_receiver_t *receiver) {
    sender_t *sender = (sender_t *)transport;
    put_events(sender, receiver);
    step_honest(sender, receiver);
    step_other(sender, receiver);
    uint8_t run[7];
    const uint64_t until_ns = (sender->time_us + SENDER_STEP_US) * 1000;
    memcpy(run, &until_ns, 6);
    run[6] = (uint8_t)(sender->time_us / SENDER_STEP_US);
    put(sender, receiver, HONEST, RIG_RUN_UNTIL_FRAME_ID | CAN_EFF_FLAG, run, sizeof run);
    sender->time_us += SENDER_STEP_US;
    return 0;
}

static bool is_same(const sender_frame_t *frame, const struct can_frame *on_bus) {
    return frame->identifier == on_bus->can_id && frame->length == on_bus->len &&
           memcmp(frame->data, on_bus->data, frame->length) == 0;
}

static sender_meaning_t meaning_of_genuine(const sender_t *sender, const sender_frame_t *frame) {
    const bool torque = frame->identifier == DRIVE_TORQUE_COMMAND_FRAME_ID;
    const world_machine_t *machine = sender->world->machine;
    const uint32_t raw = frame->data[4] | (uint32_t)frame->data[5] << 8 | (uint32_t)frame->data[6] << 16;
    const double lsb = torque ? machine->command_lsb_Nm : machine->command_lsb_rpm;
    const int32_t largest = reference_of(sender->world, machine->speed_command_max_rpm);
    const bool beyond =
        frame->identifier == DRIVE_COMMAND_FRAME_ID && abs((int32_t)(raw ^ 0x800000u) - 0x800000) > largest;
    return (sender_meaning_t){.genuine = frame->in_sequence && !beyond,
                              .other = frame->other,
                              .command = is_motion_command(frame->identifier),
                              .confirms = frame->identifier == DRIVE_ARM_FRAME_ID &&
                                          frame->data[3] == DRIVE_ARM_STEP_CONFIRM_RUN_CHOICE,
                              .torque = torque,
                              .request = (sender_request_t)frame->data[3],
                              .reference = (double)((int32_t)(raw ^ 0x800000u) - 0x800000) * lsb};
}

/* A frame that has been on the bus before is no request once more, unless it is so young that its own sender may have
 * sent it again; a replay is at least five frames old. */
static sender_meaning_t meaning_of(sender_t *sender, const struct can_frame *on_bus, uint64_t time_ns) {
    for (uint64_t back = 1; back <= SENDER_HISTORY && back <= sender->sent; back++) {
        sender_frame_t *frame = &sender->history[(sender->sent - back) % SENDER_HISTORY];
        const bool young = back <= 4 && time_ns <= frame->seen_ns + DUPLICATE_MAX_NS;
        if (is_same(frame, on_bus) && (frame->seen_ns == 0 || young)) {
            frame->seen_ns = frame->seen_ns ? frame->seen_ns : time_ns;
            return meaning_of_genuine(sender, frame);
        }
    }
    return (sender_meaning_t){.genuine = false};
}

/* A frame of the drive; all that concern the client have eight bytes. */
static void listen(sender_t *sender, const struct can_frame *frame, uint64_t time_ns) {
    if (frame->len != 8) {
        return;
    }
    if (frame->can_id == DRIVE_STATUS_FRAME_ID) {
        struct drive_status_t status;
        drive_status_unpack(&status, frame->data, 8);
        sender->state = status.state;
    } else if (frame->can_id == DRIVE_ARMING_FRAME_ID) {
        struct drive_arming_t arming;
        drive_arming_unpack(&arming, frame->data, 8);
        sender->armed = arming.armed;
        sender->challenge_for = arming.attempt;
        sender->challenge = arming.challenge;
    }
    sender->on_frame(sender->context, time_ns, frame->can_id, frame->data);
}

/* What is on the bus, and the true state: not the answers of the bench, which depend on how a client divides time. */
static bool counts(const transport_frame_t *frame) {
    if (frame->size != CAN_MTU) {
        return false;
    }
    const canid_t identifier = frame->classic.can_id & CAN_EFF_MASK;
    return !transport_frame_is_rig(frame) ||
           (identifier >= RIG_TRUTH_MOTION_FRAME_ID && identifier <= RIG_TRUTH_FAULT_FRAME_ID);
}

static void send_clients(transport_t *transport, uint64_t time_ns, transport_origin_t origin,
                         const transport_frame_t *frame) {
    sender_t *sender = (sender_t *)transport;
    if (!counts(frame)) {
        return;
    }
    sender->frames++;
    mix(sender, &time_ns, sizeof time_ns);
    mix(sender, &frame->classic.can_id, sizeof frame->classic.can_id);
    mix(sender, &frame->classic.len, 1);
    mix(sender, frame->classic.data, frame->classic.len);
    if (origin == TRANSPORT_FROM_CLIENT_ON_BUS) {
        const sender_meaning_t meaning = meaning_of(sender, &frame->classic, time_ns);
        sender->on_command(sender->context, time_ns, &meaning);
    } else if (origin == TRANSPORT_FROM_EMULATOR) {
        if (frame->classic.can_id == (RIG_TRUTH_FAULT_FRAME_ID | CAN_EFF_FLAG)) {
            sender->on_fault(sender->context, time_ns, frame->classic.data[0], frame->classic.data[2] & 1u);
        } else {
            listen(sender, &frame->classic, time_ns);
        }
    }
}

static void nothing(transport_t *transport) {
    (void)transport;
}

static bool connected(transport_t *transport, uint32_t client) {
    (void)transport;
    (void)client;
    return true;
}

static bool in_use(transport_t *transport) {
    (void)transport;
    return true;
}

void sender_init(sender_t *sender, const world_t *world, sender_parameters_t parameters) {
    *sender = (sender_t){
        .transport = {.descriptors = descriptors,
                      .read = read_clients,
                      .send = send_clients,
                      .flush = nothing,
                      .close = nothing,
                      .connected = connected,
                      .in_use = in_use},
        .world = world,
        .parameters = parameters,
        .counter = (uint8_t)seeded_bits(world->seed, STREAM_HOSTILE, UINT64_MAX),
        .second_counter = (uint8_t)seeded_bits(world->seed, STREAM_HOSTILE, UINT64_MAX - 1),
        .arm_counter = (uint8_t)seeded_bits(world->seed, STREAM_HOSTILE, UINT64_MAX - 2),
        .hash = HASH_START,
    };
}

void sender_set_recovery_speed(sender_t *sender, double rpm) {
    sender->recovery_reference = reference_of(sender->world, rpm);
}
