#include "rig/server.h"

#include <string.h>

#include "plant/min_max.h"
#include "rig/faults.h"
#include "rig/load.h"
#include "rig/stimulus.h"
#include "rig_codec.h"

#define LOAD_PROFILE_LSB 1e-6 /* of value in RIG_LOAD_PROFILE */

static bool stop_requested(rig_t *rig) {
    return rig->config.stop.requested && rig->config.stop.requested(rig->config.stop.context);
}

static bool give_up(void *context) {
    return stop_requested(context);
}

void server_init(rig_t *rig) {
    static const transport_full_t full[] = {
        [PACING_LOCKSTEP] = TRANSPORT_WAIT,
        [PACING_TIMED] = TRANSPORT_DROP,
        [PACING_FREE] = TRANSPORT_WAIT_FOR_READ,
    };
    transport_t *transport = rig->config.transport;
    transport->full = full[rig->config.pacing.kind];
    transport->unstamped = rig->config.drive_only;
    transport->give_up = give_up;
    transport->give_up_context = rig;
    rig->server.run_count = 0;
    rig->server.stop_checked_ns = 0;
}

static void send_clock(rig_t *rig, uint8_t sequence) {
    struct rig_clock_t clock = {.sequence = sequence};
    rig_clock_set_time_ns(&clock, (int64_t)rig->board.time_ns);
    transport_frame_t frame = {.size = CAN_MTU,
                               .classic = {.can_id = RIG_CLOCK_FRAME_ID | CAN_EFF_FLAG, .len = RIG_CLOCK_LENGTH}};
    rig_clock_pack(frame.classic.data, &clock, RIG_CLOCK_LENGTH);
    transport_send(rig->config.transport, rig->board.time_ns, TRANSPORT_CLOCK, &frame);
}

/* Runs to until_ns and answers the RIG_RUN_UNTILs on the way, each at its time. */
static void advance(rig_t *rig, uint64_t until_ns) {
    while (rig->server.run_count > 0 && rig->server.runs[0].time_ns <= until_ns) {
        if (rig->server.runs[0].time_ns > rig->board.time_ns) {
            scheduler_run(&rig->scheduler, rig->server.runs[0].time_ns);
        }
        uint8_t sequence = rig->server.runs[0].sequence;
        memmove(&rig->server.runs[0], &rig->server.runs[1], --rig->server.run_count * sizeof rig->server.runs[0]);
        send_clock(rig, sequence);
    }
    scheduler_run(&rig->scheduler, until_ns);
}

static void take_run_until(rig_t *rig, uint32_t client, const uint8_t *data) {
    struct rig_run_until_t message;
    rig_run_until_unpack(&message, data, RIG_RUN_UNTIL_LENGTH);
    if (message.time_ns <= rig->board.time_ns || rig->server.run_count == SERVER_RUNS_MAX) {
        send_clock(rig, message.sequence);
        return;
    }
    unsigned index = rig->server.run_count++;
    for (; index > 0 && rig->server.runs[index - 1].time_ns > message.time_ns; --index) {
        rig->server.runs[index] = rig->server.runs[index - 1];
    }
    rig->server.runs[index] =
        (server_run_t){.time_ns = message.time_ns, .sequence = message.sequence, .client = client};
}

static void take_set(rig_t *rig, const uint8_t *data) {
    const stimulus_reply_t result = stimulus_receive(rig, data);
    const struct rig_set_reply_t reply = {.quantity = result.variable, .status = result.status, .at_us = result.at_us};
    transport_frame_t frame = {
        .size = CAN_MTU, .classic = {.can_id = RIG_SET_REPLY_FRAME_ID | CAN_EFF_FLAG, .len = RIG_SET_REPLY_LENGTH}};
    rig_set_reply_pack(frame.classic.data, &reply, RIG_SET_REPLY_LENGTH);
    transport_frame_set_node(&frame, rig->config.node);
    transport_send(rig->config.transport, rig->board.time_ns, TRANSPORT_FROM_EMULATOR, &frame);
}

static void take_fault(rig_t *rig, const uint8_t *data) {
    transport_frame_t frame = {
        .size = CAN_MTU, .classic = {.can_id = RIG_FAULT_REPLY_FRAME_ID | CAN_EFF_FLAG, .len = RIG_FAULT_REPLY_LENGTH}};
    memcpy(frame.classic.data, data, RIG_FAULT_REPLY_LENGTH); /* kind, place and time of the request */
    frame.classic.data[1] &= 0x0F;
    frame.classic.data[2] = faults_receive(rig, data);
    frame.classic.data[3] = 0;
    transport_frame_set_node(&frame, rig->config.node);
    transport_send(rig->config.transport, rig->board.time_ns, TRANSPORT_FROM_EMULATOR, &frame);
}

static void take_load_profile(rig_t *rig, const uint8_t *data) {
    struct rig_load_profile_t message;
    rig_load_profile_unpack(&message, data, RIG_LOAD_PROFILE_LENGTH);
    load_set_profile_value(&rig->load, message.values, message.index, (double)message.value * LOAD_PROFILE_LSB);
}

static bool may_read(void *context, uint32_t client) {
    const rig_t *rig = context;
    if (rig->config.pacing.kind != PACING_LOCKSTEP) {
        return can_bus_client_backlog(&rig->bus, client) < RIG_MOVING_BACKLOG_MAX;
    }
    for (unsigned i = 0; i < rig->server.run_count; ++i) {
        if (rig->server.runs[i].client == client) {
            return false;
        }
    }
    return true;
}

static bool connected(void *context, uint32_t client) {
    return transport_connected(context, client);
}

/* A frame to the rig of one drive, its identifier as of node 0. */
static void take_for_drive(rig_t *rig, canid_t identifier, const transport_frame_t *frame) {
    if (identifier == RIG_SET_FRAME_ID && frame->classic.len == RIG_SET_LENGTH) {
        take_set(rig, frame->classic.data);
    } else if (identifier == RIG_FAULT_FRAME_ID && frame->classic.len == RIG_FAULT_LENGTH) {
        take_fault(rig, frame->classic.data);
    } else if (identifier == RIG_LOAD_PROFILE_FRAME_ID && frame->classic.len == RIG_LOAD_PROFILE_LENGTH) {
        take_load_profile(rig, frame->classic.data);
    }
}

static bool take(void *context, uint32_t client, const transport_frame_t *frame) {
    rig_t *rig = context;
    if (!transport_frame_is_off_bus(frame)) {
        if (!can_bus_has_client(&rig->bus, client)) {
            can_bus_remove_clients(&rig->bus, connected, rig->config.transport);
        }
        hal_can_frame_t queued;
        transport_frame_to_hal(frame, &queued);
        return can_bus_push(&rig->bus, client, &queued);
    }
    transport_send(rig->config.transport, rig->board.time_ns, TRANSPORT_FROM_CLIENT_OFF_BUS, frame);
    if (frame->size == CAN_MTU && transport_frame_is_rig(frame) && !(frame->classic.can_id & CAN_RTR_FLAG)) {
        const canid_t identifier = frame->classic.can_id & CAN_EFF_MASK;
        if (identifier == RIG_RUN_UNTIL_FRAME_ID && frame->classic.len == RIG_RUN_UNTIL_LENGTH) {
            take_run_until(rig, client, frame->classic.data);
        }
        for (rig_t *each = rig; each; each = each->next) {
            if (transport_frame_node(frame) == each->config.node) {
                take_for_drive(each, identifier & ~TRANSPORT_NODE_MASK, frame);
            }
        }
    }
    return true;
}

static bool check_stop(rig_t *rig) {
    rig->server.stop_checked_ns = rig->board.time_ns;
    return stop_requested(rig);
}

static bool check_stop_when_due(rig_t *rig) {
    return rig->board.time_ns - rig->server.stop_checked_ns >= RIG_STOP_STEP_NS && check_stop(rig);
}

/* True when one of the stop descriptors became readable. */
static bool wait_for_clients(rig_t *rig, int timeout_ms) {
    struct pollfd list[TRANSPORT_DESCRIPTORS_MAX + 2];
    size_t count = transport_descriptors(rig->config.transport, list);
    for (unsigned i = 0; i < 2; ++i) {
        list[count++] = (struct pollfd){.fd = rig->config.stop.descriptors[i], .events = POLLIN};
    }
    return poll(list, count, timeout_ms) > 0 && (list[count - 1].revents || list[count - 2].revents);
}

/* Removes the runs of clients that have left, when there is another client to be served; true when one was removed. */
static bool abandon_runs(rig_t *rig) {
    transport_t *transport = rig->config.transport;
    if (transport_connected(transport, rig->server.runs[0].client) || !transport_in_use(transport)) {
        return false;
    }
    unsigned kept = 0;
    for (unsigned i = 0; i < rig->server.run_count; ++i) {
        if (transport_connected(transport, rig->server.runs[i].client)) {
            rig->server.runs[kept++] = rig->server.runs[i];
        }
    }
    rig->server.run_count = kept;
    return true;
}

static bool serve_lockstep(rig_t *rig, int timeout_ms) {
    if (rig->server.run_count == 0) {
        transport_flush(rig->config.transport);
        return !(wait_for_clients(rig, timeout_ms) && check_stop(rig));
    }
    shared_bus_start(&rig->shared_bus);
    uint64_t target_ns = rig->server.runs[0].time_ns;
    while (rig->board.time_ns < target_ns && !abandon_runs(rig)) {
        advance(rig, min_u64(target_ns, rig->server.stop_checked_ns + RIG_STOP_STEP_NS));
        if (rig->config.transport->failure || check_stop_when_due(rig)) {
            return false;
        }
    }
    transport_flush(rig->config.transport);
    return true;
}

static bool serve_moving(rig_t *rig) {
    shared_bus_start(&rig->shared_bus);
    uint64_t reading_ns = (rig->board.time_ns / RIG_READ_STEP_NS + 1) * RIG_READ_STEP_NS;
    advance(rig, min_u64(reading_ns, rig->config.stop_at_ns));
    transport_flush(rig->config.transport);
    if (rig->board.time_ns >= rig->config.stop_at_ns) {
        return false;
    }
    pacing_wait(&rig->config.pacing, rig->board.time_ns);
    return !check_stop_when_due(rig);
}

bool server_round(rig_t *rig, int timeout_ms) {
    const transport_receiver_t receiver = {.context = rig, .may_read = may_read, .take = take};
    transport_read(rig->config.transport, &receiver);
    if (rig->config.transport->failure) {
        return false;
    }
    return rig->config.pacing.kind == PACING_LOCKSTEP ? serve_lockstep(rig, timeout_ms) : serve_moving(rig);
}
