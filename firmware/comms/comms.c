#include "comms/comms.h"

#include "comms/counter.h"
#include "comms/memory_protocol.h"
#include "comms/node.h"
#include "comms/parameter_protocol.h"
#include "comms/trace_protocol.h"
#include "comms/xcp.h"
#include "drive_codec.h"
#include "fixed/compiler.h"

#define US_PER_MS 1000u

void comms_init(comms_t *comms, unsigned node, uint32_t time_us) {
    const uint32_t offset = node * NODE_STEP;
    *comms = (comms_t){.node_offset = offset};
    bus_monitor_init(&comms->bus, time_us);
    commands_init(&comms->commands);
    comms->commands.data_id_offset = (uint16_t)offset;
    telemetry_init(&comms->telemetry, offset, time_us);
}

/* Without CANopen (option SALIENT_CANOPEN of the build) nothing refers to its functions, which the linker removes. */
static bool is_canopen(const comms_t *comms) {
#ifdef SALIENT_WITHOUT_CANOPEN
    (void)comms;
    return false;
#else
    return comms->canopen.node != 0;
#endif
}

COLD void comms_choose(comms_t *comms, int32_t protocol, uint32_t time_us) {
#ifdef SALIENT_WITHOUT_CANOPEN
    (void)comms, (void)protocol, (void)time_us;
#else
    canopen_init(&comms->canopen, (unsigned)protocol, comms->node_offset / NODE_STEP + 1u, time_us);
#endif
}

COLD position_status_t *comms_place(comms_t *comms) {
    return is_canopen(comms) ? &comms->canopen.place : NULL;
}

/* [SR-35] */
COLD void comms_bus_off(comms_t *comms) {
    if (!is_canopen(comms)) {
        commands_disarm(&comms->commands);
        return;
    }
    comms->bus.run_inhibited = false; /* the profile has the reaction; it enables nothing by itself */
    comms->canopen.bus_off = true;
}

/* A bit that has changed in one copy is as in both others again. */
static void restore_node(comms_t *comms) {
    const uint32_t sends = comms->telemetry.identifier_offset, hears = comms->commands.data_id_offset;
    const uint32_t offset = (sends & hears) | (comms->node_offset & (sends | hears));
    comms->telemetry.identifier_offset = comms->node_offset = offset;
    comms->commands.data_id_offset = (uint16_t)offset;
}

static void report_arming(comms_t *comms, hal_t *hal, uint32_t time_us) {
    arming_t *arming = &comms->commands.arming;
    hal_can_frame_t frame;
    arming_report(arming, comms->commands.counters.run_unarmed, &frame);
    frame.identifier += comms->telemetry.identifier_offset;
    arming->changed = !hal_can_transmit(hal, &frame);
    comms->arming_sent_us = time_us;
}

static bool send_response(comms_t *comms, hal_t *hal) {
    const hal_can_frame_t *frame = frame_queue_peek(&comms->responses);
    if (frame == NULL || !hal_can_transmit(hal, frame)) {
        return false;
    }
    frame_queue_pop(&comms->responses);
    return true;
}

static void flush(comms_t *comms, hal_t *hal, uint32_t time_us) {
    const arming_t *arming = &comms->commands.arming;
    if (arming->attempt != ARMING_ATTEMPT_NONE) {
        if (arming->changed) {
            report_arming(comms, hal, time_us);
        }
        if (arming->changed || time_us - comms->arming_sent_us < COMMS_CHALLENGE_FIRST_US) {
            return;
        }
    }
    if (telemetry_pauses(&comms->telemetry, time_us)) {
        return;
    }
    comms->response_first = comms->response_first && !send_response(comms, hal);
    telemetry_flush(&comms->telemetry, hal, time_us);
    if (frame_queue_peek(&comms->telemetry.queue) == NULL && arming->changed) {
        report_arming(comms, hal, time_us);
    }
    while (frame_queue_peek(&comms->telemetry.queue) == NULL && send_response(comms, hal)) {
    }
}

/* Frames of XCP that are no response at once to a single command: an upload's wait with the responses, a
 * measurement's are for a bus on which the drive has nothing else to send. */
COLD static void send_xcp(comms_t *comms, hal_t *hal, const comms_objects_t *objects) {
    const parameters_t *parameters = objects->parameters;
    hal_can_frame_t frame;
    if (comms->xcp.pending && frame_queue_free(&comms->responses) > 0 &&
        xcp_late_response(&comms->xcp, objects->tables, &frame)) {
        frame.identifier += comms->telemetry.identifier_offset;
        frame_queue_push(&comms->responses, &frame);
    }
    while (comms->xcp.upload_left > 0 && frame_queue_free(&comms->responses) > 1u &&
           xcp_next_frame(&comms->xcp, parameters, true, &frame)) {
        frame.identifier += comms->telemetry.identifier_offset;
        frame_queue_push(&comms->responses, &frame);
    }
    if (!comms->xcp.connected) {
        return;
    }
    hal_can_status_t status;
    hal_can_status(hal, &status);
    /* Frames of XCP keep mailboxes: that the heartbeat has left is seen before the next one. */
    comms->telemetry.background_in_mailbox &= status.transmitting;
    if (comms->xcp.daq.running && frame_queue_peek(&comms->telemetry.queue) == NULL &&
        frame_queue_peek(&comms->responses) == NULL &&
        xcp_next_frame(&comms->xcp, parameters, status.transmitting, &frame)) {
        frame.identifier += comms->telemetry.identifier_offset;
        (void)hal_can_transmit(hal, &frame);
    }
}

/* Handles a parameter request or a frame of a set. Without room for its response a frame is dropped: commands behind it
 * must not wait. */
static void receive_parameters(comms_t *comms, hal_t *hal, const comms_objects_t *objects,
                               const hal_can_frame_t *frame) {
    arming_t *arming = &comms->commands.arming;
    if (frame->identifier == DRIVE_PARAMETER_WRITE_FRAME_ID) { /* has none */
        parameter_set_write(&comms->set, frame);
        return;
    }
    if (frame_queue_free(&comms->responses) == 0) {
        counter_add(&comms->telemetry.dropped, 1);
        return;
    }
    hal_can_frame_t response;
    if (frame->identifier == DRIVE_PARAMETER_SET_CONTROL_FRAME_ID) {
        if (parameter_set_control(&comms->set, arming->configuring != 0, objects->parameters, objects->store,
                                  &objects->conditions, frame, &response)) {
            arming_end_configuration(arming);
        }
    } else if (!memory_protocol_respond(objects->store, objects->self_test, hal, frame, &response) &&
               !trace_protocol_respond(objects->trace, objects->control_parameters, frame, &response)) {
        parameter_protocol_respond(objects->parameters, frame, &response);
    }
    response.identifier += comms->telemetry.identifier_offset;
    frame_queue_push(&comms->responses, &response);
}

static void receive_xcp(comms_t *comms, hal_t *hal, const comms_objects_t *objects, const hal_can_frame_t *frame,
                        uint32_t time_us) {
    if (frame_queue_free(&comms->responses) == 0) {
        counter_add(&comms->telemetry.dropped, 1);
        return;
    }
    const xcp_context_t context = {objects->parameters, &objects->conditions, &comms->set, objects->store,
                                   objects->tables};
    hal_can_frame_t response;
    if (xcp_receive(&comms->xcp, hal, frame, &context, time_us, &response)) {
        response.identifier += comms->telemetry.identifier_offset;
        frame_queue_push(&comms->responses, &response);
    }
}

static bool receive(comms_t *comms, hal_t *hal, const comms_objects_t *objects, uint32_t timeout_us, uint32_t time_us) {
    hal_can_frame_t frame;
    for (int i = 0; i < COMMS_FRAMES_PER_CALL; i++) {
        if (!hal_can_receive(hal, &frame)) {
            return false;
        }
        if (node_is_other(&frame, comms->telemetry.identifier_offset)) {
            continue;
        }
        if (!frame.extended) {
            frame.identifier ^=
                comms->telemetry.identifier_offset; /* as of node 0, whose identifiers do not have these bits */
        }
        switch (commands_receive(&comms->commands, hal, &frame, time_us, timeout_us, &comms->command)) {
        case COMMANDS_COMMAND:
            return true;
        case COMMANDS_PARAMETER_REQUEST:
        case COMMANDS_PARAMETER_SET:
            receive_parameters(comms, hal, objects, &frame);
            break;
        case COMMANDS_XCP:
            receive_xcp(comms, hal, objects, &frame, time_us);
            break;
        default: /* COMMANDS_ACCEPTED, COMMANDS_REJECTED */
            bus_monitor_check(&comms->bus, &frame, time_us);
            break;
        }
    }
    return false;
}

/* Receives, acts and sends as a CANopen device. */
COLD static bool background_canopen(comms_t *comms, hal_t *hal, const comms_objects_t *objects, uint32_t time_us) {
    const canopen_context_t context = {hal,
                                       objects->parameters,
                                       &objects->conditions,
                                       &comms->set,
                                       objects->store,
                                       &comms->commands,
                                       &comms->responses,
                                       time_us};
    hal_can_frame_t frame;
    for (int i = 0; i < COMMS_FRAMES_PER_CALL && hal_can_receive(hal, &frame); i++) {
        canopen_receive(&comms->canopen, &context, &frame);
    }
    const bool commanded = canopen_step(&comms->canopen, &context, &comms->command);
    while (send_response(comms, hal)) {
    }
    return commanded;
}

bool comms_background(comms_t *comms, hal_t *hal, const comms_objects_t *objects, drive_state_t state,
                      uint32_t time_us) {
    const parameters_t *parameters = objects->parameters;
    restore_node(comms);
    const uint32_t timeout_us = (uint32_t)parameters->values[PARAMETER_COMMAND_TIMEOUT_MS] * US_PER_MS;
    commands_supervise(&comms->commands, state, time_us, timeout_us);
    if (is_canopen(comms)) {
        return background_canopen(comms, hal, objects, time_us);
    }
    xcp_supervise(&comms->xcp, comms->bus.status.state == HAL_CAN_BUS_OFF, time_us);
    comms->set.begun = comms->set.begun && comms->commands.arming.configuring;
    telemetry_set_period(&comms->telemetry, DRIVE_TELEMETRY_RATE_FAST,
                         (unsigned)parameters->values[PARAMETER_TELEMETRY_PERIOD_MS]);
    telemetry_set_period(&comms->telemetry, DRIVE_TELEMETRY_RATE_SLOW,
                         (unsigned)parameters->values[PARAMETER_TELEMETRY_SLOW_PERIOD_MS]);
    const bool commanded = receive(comms, hal, objects, timeout_us, time_us);
    flush(comms, hal, time_us);
    send_xcp(comms, hal, objects);
    return commanded;
}

void comms_telemetry(comms_t *comms, hal_t *hal, drive_telemetry_t *values) {
    restore_node(comms);
    if (is_canopen(comms)) {
        telemetry_advance(&comms->telemetry, values->status.time_us);
        canopen_telemetry(&comms->canopen, values);
        return;
    }
    comms->telemetry.background_in_mailbox &= comms->bus.status.transmitting;
    telemetry_cycle(&comms->telemetry, values);
    comms->response_first = comms->telemetry.backlog;
    flush(comms, hal, values->status.time_us);
}
