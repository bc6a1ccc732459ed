#include "campaign/sender.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "campaign/drive_numbers.h"
#include "campaign/seeded.h"
#include "campaign/sender_frames.h"
#include "campaign/sender_rival.h"
#include "rig_codec.h"

#define HASH_START UINT64_C(14695981039346656037)
#define HASH_PRIME UINT64_C(1099511628211)
#define ARM_RETRY_US 20000
#define CONFIGURED_US 60000 /* then the client runs the drive, configured or not, */
#define LIMITED_US 200000   /* with several sessions */
#define SAVING_US 30000     /* in which a set is written */
#define RECOVERY_OFF_US                                                                                                \
    45000                  /* 30 ms of silence, and three frames: after a bus-off the drive follows the last of them */
#define WITHDRAWN_US 12000 /* of them after the end of the run */
#define DUPLICATE_MAX_NS UINT64_C(20000000) /* of a frame, by a disturbed acknowledgement */

static void mix(sender_t *sender, const void *bytes, size_t count) {
    const uint8_t *each = bytes;
    for (size_t i = 0; i < count; i++) {
        sender->hash = (sender->hash ^ each[i]) * HASH_PRIME;
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

/* Reference of 24 bits; at least an LSB beyond the range. */
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

/* After the faults a client withdraws its request until the drive has left its run: after a bus-off the first frames
 * are out of sequence to the drive, and count for nothing. */
static bool is_withdrawing(sender_t *sender) {
    const uint64_t since_us = sender->time_us - sender->world->recovery_us;
    sender->withdrawn = sender->withdrawn || (sender->state != STATE_RUN && since_us > 0);
    if (!sender->withdrawn) {
        sender->running_us = sender->time_us;
    }
    return since_us < RECOVERY_OFF_US || sender->time_us < sender->running_us + WITHDRAWN_US;
}

/* A lost phase is used again after clear_fault, even where its loss was no fault. */
static sender_request_t withdrawal(const sender_t *sender) {
    const bool later = sender->time_us >= sender->world->recovery_us + RECOVERY_OFF_US / 2;
    return later && sender->withdrawn && has(sender, WORLD_DEGRADED) ? SENDER_CLEAR : SENDER_OFF;
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
    if (recovers && is_withdrawing(sender)) {
        return withdrawal(sender);
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
    sender_put_set(sender, receiver, DRIVE_PARAMETER_SET_CONTROL_FRAME_ID, DRIVE_PARAMETER_SET_CONTROL_E2E_DATA_ID,
                   DRIVE_PARAMETER_SET_CONTROL_STEP_BEGIN_CHOICE, 0);
    sender_put_set(sender, receiver, DRIVE_PARAMETER_WRITE_FRAME_ID, DRIVE_PARAMETER_WRITE_E2E_DATA_ID, (uint8_t)index,
                   value);
    sender_put_set(sender, receiver, DRIVE_PARAMETER_SET_CONTROL_FRAME_ID, DRIVE_PARAMETER_SET_CONTROL_E2E_DATA_ID,
                   DRIVE_PARAMETER_SET_CONTROL_STEP_APPLY_CHOICE, sender_check_of_set((uint8_t)index, value) ^ error);
}

static void put_session(sender_t *sender, const transport_receiver_t *receiver) {
    const world_machine_t *machine = sender->world->machine;
    switch (session(sender)) {
    case SESSION_LIMIT: {
        /* In LSBs of 2^-24 of the unit of torque: a 256th of the LSBs of a command. */
        const double part = active(sender, WORLD_LIMITED)->value;
        const double raw = floor(part * machine->torque_max_Nm / machine->command_lsb_Nm) * 256.0;
        put_one_parameter(sender, receiver, sender->parameters.torque_max_Nm, (uint32_t)raw, 0);
        break;
    }
    case SESSION_SAVE:
        sender_put_set(sender, receiver, DRIVE_PARAMETER_SET_CONTROL_FRAME_ID, DRIVE_PARAMETER_SET_CONTROL_E2E_DATA_ID,
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
        sender_put_arm(sender, receiver, DRIVE_ARM_STEP_CONFIRM_CONFIGURATION_CHOICE, ~sender->challenge);
        put_session(sender, receiver);
        sender->challenge = 0;
        sender->configured++;
    } else if (sender->state == STATE_READY && sender->time_us >= sender->requested_us + ARM_RETRY_US) {
        sender->requested_us = sender->time_us;
        sender_put_arm(sender, receiver, DRIVE_ARM_STEP_REQUEST_CONFIGURATION_CHOICE, 0);
    }
}

static void take_references(sender_t *sender) {
    const world_t *world = sender->world;
    for (unsigned i = 0; i < world->events; i++) {
        const world_event_t *event = world_begun(world, i, UINT64_MAX);
        if (event != NULL && event->kind == WORLD_SPEED && sender_in_step(sender, event->begin_us)) {
            sender->reference = reference_of(world, event->value);
            sender->due_us = sender->time_us;
        }
    }
}

/* In position mode the drive holds until the first target. */
static void command_position(sender_t *sender, const transport_receiver_t *receiver, sender_request_t request) {
    const world_event_t *target = world_latest(sender->world, WORLD_TARGET, sender->time_us, false);
    sender->request = request;
    sender->due_us = sender->time_us + SENDER_COMMAND_PERIOD_US;
    sender_put_position(sender, receiver, sender->counter++, request, target != NULL,
                        target != NULL ? target->value : 0.0);
}

static void command(sender_t *sender, const transport_receiver_t *receiver, sender_request_t request) {
    const world_t *world = sender->world;
    if (world->client == WORLD_CLIENT_POSITION) {
        command_position(sender, receiver, request);
        return;
    }
    const world_event_t *torque = active(sender, WORLD_TORQUE), *beyond = active(sender, WORLD_BEYOND);
    const int32_t reference = beyond   ? reference_beyond(world, beyond->value)
                              : torque ? (int32_t)floor(torque->value / world->machine->command_lsb_Nm + 0.5)
                                       : sender->reference;
    const bool refers = request == SENDER_RUN || (world->keeps_reference && request != SENDER_CLEAR);
    sender->request = request;
    sender->due_us = sender->time_us + SENDER_COMMAND_PERIOD_US;
    sender_put_command(sender, receiver, SENDER_HONEST, sender->counter++, torque != NULL && beyond == NULL, request,
                       refers ? reference : 0);
}

static void arm(sender_t *sender, const transport_receiver_t *receiver) {
    if (has(sender, WORLD_UNARMED) || sender->armed || sender->state == STATE_FAULT ||
        sender->state == STATE_INITIALISE) {
        return;
    }
    if (sender->challenge && sender->challenge_for == DRIVE_ARMING_ATTEMPT_RUN_CHOICE) {
        sender_put_arm(sender, receiver, DRIVE_ARM_STEP_CONFIRM_RUN_CHOICE, ~sender->challenge);
        sender->challenge = 0;
    } else if (sender->time_us >= sender->requested_us + ARM_RETRY_US) {
        sender->requested_us = sender->time_us;
        sender_put_arm(sender, receiver, DRIVE_ARM_STEP_REQUEST_RUN_CHOICE, 0);
    }
}

static void step_honest(sender_t *sender, const transport_receiver_t *receiver) {
    const world_t *world = sender->world;
    take_references(sender);
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
        command(sender, receiver, request);
    }
    if (request == SENDER_RUN || has(sender, WORLD_ARMED)) {
        arm(sender, receiver);
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
    sender_put_events(sender, receiver);
    if (sender->world->client == WORLD_CLIENT_CANOPEN) {
        master_step(sender, receiver);
    } else {
        step_honest(sender, receiver);
        sender_step_rival(sender, receiver);
    }
    uint8_t run[7];
    const uint64_t until_ns = (sender->time_us + SENDER_STEP_US) * 1000;
    memcpy(run, &until_ns, 6);
    run[6] = (uint8_t)(sender->time_us / SENDER_STEP_US);
    sender_put(sender, receiver, SENDER_HONEST, RIG_RUN_UNTIL_FRAME_ID | CAN_EFF_FLAG, run, sizeof run);
    sender->time_us += SENDER_STEP_US;
    return 0;
}

static bool is_same(const sender_frame_t *frame, const struct can_frame *on_bus) {
    return frame->identifier == on_bus->can_id && frame->length == on_bus->len &&
           memcmp(frame->data, on_bus->data, frame->length) == 0;
}

static sender_meaning_t meaning_of_position(const sender_frame_t *frame) {
    struct drive_position_command_t command;
    drive_position_command_unpack(&command, frame->data, frame->length);
    return (sender_meaning_t){.genuine = frame->in_sequence,
                              .command = true,
                              .position = true,
                              .request = (sender_request_t)command.request,
                              .reference = command.position_deg / SENDER_POSITIONS_PER_REV};
}

static sender_meaning_t meaning_of_genuine(const sender_t *sender, const sender_frame_t *frame) {
    if (frame->identifier == DRIVE_POSITION_COMMAND_FRAME_ID) {
        return meaning_of_position(frame);
    }
    const bool torque = frame->identifier == DRIVE_TORQUE_COMMAND_FRAME_ID;
    const world_machine_t *machine = sender->world->machine;
    const uint32_t raw = frame->data[4] | (uint32_t)frame->data[5] << 8 | (uint32_t)frame->data[6] << 16;
    const double lsb = torque ? machine->command_lsb_Nm : machine->command_lsb_rpm;
    const int32_t largest = reference_of(sender->world, machine->speed_command_max_rpm);
    const bool beyond =
        frame->identifier == DRIVE_COMMAND_FRAME_ID && abs((int32_t)(raw ^ 0x800000u) - 0x800000) > largest;
    return (sender_meaning_t){.genuine = frame->in_sequence && !beyond,
                              .other = frame->other,
                              .command = sender_is_motion_command(frame->identifier),
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
    if (sender->world->client == WORLD_CLIENT_CANOPEN) {
        master_on_frame(sender, time_ns, frame);
        sender->on_frame(sender->context, time_ns, frame->can_id, frame->data);
        return;
    }
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

/* Frames on the bus, and the true state: not the answers of the bench, which depend on how a client divides time. */
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
    if (origin == TRANSPORT_FROM_CLIENT_ON_BUS && sender->world->client == WORLD_CLIENT_CANOPEN) {
        master_on_bus(sender, time_ns, &frame->classic);
    } else if (origin == TRANSPORT_FROM_CLIENT_ON_BUS) {
        const sender_meaning_t meaning = meaning_of(sender, &frame->classic, time_ns);
        sender->on_command(sender->context, time_ns, &meaning);
    } else if (origin == TRANSPORT_FROM_EMULATOR) {
        if (frame->classic.can_id == (RIG_TRUTH_FAULT_FRAME_ID | CAN_EFF_FLAG)) {
            struct rig_truth_fault_t fault;
            rig_truth_fault_unpack(&fault, frame->classic.data, RIG_TRUTH_FAULT_LENGTH);
            sender->on_fault(sender->context, time_ns, fault.kind, fault.present);
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
        .counter = (uint8_t)seeded_bits(world->seed, SENDER_STREAM, UINT64_MAX),
        .second_counter = (uint8_t)seeded_bits(world->seed, SENDER_STREAM, UINT64_MAX - 1),
        .arm_counter = (uint8_t)seeded_bits(world->seed, SENDER_STREAM, UINT64_MAX - 2),
        .hash = HASH_START,
    };
}

void sender_set_recovery_speed(sender_t *sender, double rpm) {
    sender->recovery_reference = reference_of(sender->world, rpm);
}
