#include "comms/canopen.h"

#include "comms/canopen_drive.h"
#include "comms/canopen_lss.h"
#include "comms/canopen_mapping.h"
#include "comms/canopen_pdo.h"
#include "comms/canopen_sdo.h"
#include "comms/canopen_send.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"

#define NMT_ID 0x000u
#define HEARTBEAT_ID 0x700u
#define US_PER_MS 1000u
#define GUARD_MAX_MS 2000000u /* half an hour: a time of 32 bits is not longer in us */
#define TOGGLE 0x80u
#define NODE_SHIFT 16
enum { NMT_START = 1, NMT_STOP = 2, NMT_PRE_OPERATIONAL = 128, NMT_RESET_NODE = 129, NMT_RESET_COMMUNICATION = 130 };

static void reset_communication(canopen_t *canopen, uint32_t time_us) {
    canopen->node = canopen->lss.node;
    canopen->lss = (canopen_lss_t){.node = canopen->node};
    canopen->sdo = (canopen_sdo_t){0};
    canopen->guard = (canopen_watch_t){0};
    for (unsigned i = 0; i < CANOPEN_CONSUMERS; i++) {
        canopen->consumer[i] = (canopen_watch_t){0};
    }
    canopen->guard_toggle = false;
    canopen->emergencies = 0;
    canopen->nmt = CANOPEN_NMT_INITIALISING; /* where it remains without a node-ID, and hears LSS alone */
    canopen->boot_up = canopen->node <= CANOPEN_NODE_MAX;
    canopen->heartbeat_us = canopen->heard_us = time_us;
}

COLD void canopen_init(canopen_t *canopen, unsigned node, unsigned serial, uint32_t time_us) {
    *canopen = (canopen_t){.serial = (uint8_t)serial,
                           .lss = {.node = (uint8_t)(node <= CANOPEN_NODE_MAX ? node : CANOPEN_NODE_NONE)},
                           .drive = {.step_us = time_us}};
    reset_communication(canopen, time_us);
    canopen_reset_values(canopen, true);
}

COLD void canopen_telemetry(canopen_t *canopen, const drive_telemetry_t *values) {
    canopen->measured = (canopen_measured_t){
        .speed = values->motion.speed_rpm,
        .torque_q8 = values->torque.torque_estimate_nm,
        .reference_q8 = values->torque.torque_reference_nm,
        .voltage_q6 = values->torque.bus_voltage_v,
        .state = (drive_state_t)values->status.state,
        .fault = (uint8_t)values->status.fault,
        .limited = values->status.speed_limited != 0,
        .has_position = values->status.controller == DRIVE_CONTROLLER_SALIENT,
    };
    canopen->cycle = true;
}

/* --- reception --------------------------------------------------------------------------------------------------- */

static void leave_operational(canopen_t *canopen, const canopen_context_t *context, canopen_nmt_t to) {
    if (canopen->nmt == CANOPEN_NMT_OPERATIONAL) {
        canopen_drive_abort(canopen, context);
    }
    canopen->nmt = to;
}

static void receive_nmt(canopen_t *canopen, const canopen_context_t *context, const hal_can_frame_t *frame) {
    if (frame->length != 2u || (frame->data[1] != 0 && frame->data[1] != canopen->node)) {
        return;
    }
    canopen->heard_us = context->time_us;
    switch (frame->data[0]) {
    case NMT_START:
        if (canopen->nmt != CANOPEN_NMT_OPERATIONAL) {
            canopen_mapping_restart(canopen);
            canopen->nmt = CANOPEN_NMT_OPERATIONAL;
        }
        break;
    case NMT_STOP:
        leave_operational(canopen, context, CANOPEN_NMT_STOPPED);
        break;
    case NMT_PRE_OPERATIONAL:
        leave_operational(canopen, context, CANOPEN_NMT_PRE_OPERATIONAL);
        break;
    case NMT_RESET_NODE:
        canopen_drive_disable(canopen, context);
        canopen->restart = true;
        break;
    case NMT_RESET_COMMUNICATION:
        canopen_drive_disable(canopen, context);
        reset_communication(canopen, context->time_us);
        canopen_reset_values(canopen, false);
        break;
    default:
        break;
    }
}

static void respond_guard(canopen_t *canopen, const canopen_context_t *context) {
    if (canopen->values[CANOPEN_VALUE_HEARTBEAT] != 0) {
        return;
    }
    const uint8_t state = (uint8_t)(canopen->nmt | (canopen->guard_toggle ? TOGGLE : 0u));
    canopen->guard_toggle = !canopen->guard_toggle;
    canopen->guard = (canopen_watch_t){.watched = true, .time_us = context->time_us};
    canopen->heard_us = context->time_us;
    canopen_send(canopen, context, HEARTBEAT_ID + canopen->node, &state, 1);
}

/* 0: an entry without a time, or a node, is not used. */
static uint32_t consumed_node(const canopen_t *canopen, unsigned consumer) {
    const uint32_t entry = (uint32_t)canopen->values[CANOPEN_VALUE_CONSUMER + consumer];
    return (entry & UINT16_MAX) != 0 ? entry >> NODE_SHIFT : 0;
}

static void receive_heartbeat(canopen_t *canopen, const canopen_context_t *context, const hal_can_frame_t *frame) {
    for (unsigned i = 0; i < CANOPEN_CONSUMERS; i++) {
        if (consumed_node(canopen, i) != 0 && consumed_node(canopen, i) == frame->identifier - HEARTBEAT_ID &&
            frame->length == 1u) {
            canopen->consumer[i] = (canopen_watch_t){.watched = true, .time_us = context->time_us};
            canopen->heard_us = context->time_us;
        }
    }
}

/* Requests of SDO count as a sign of the master, refused ones too. */
static void receive_sdo(canopen_t *canopen, const canopen_context_t *context, const hal_can_frame_t *frame) {
    if (canopen->nmt != CANOPEN_NMT_STOPPED) {
        canopen->heard_us = context->time_us;
        canopen_sdo_receive(canopen, context, frame);
    }
}

static void receive_data(canopen_t *canopen, const canopen_context_t *context, const hal_can_frame_t *frame) {
    const bool synchronises = frame->identifier == (uint32_t)canopen->values[CANOPEN_VALUE_SYNC_ID] &&
                              canopen->nmt == CANOPEN_NMT_OPERATIONAL;
    if (canopen_pdo_receive(canopen, context, frame)) {
        canopen->heard_us = context->time_us;
    } else if (synchronises) {
        canopen->heard_us = context->time_us;
        canopen_pdo_sync(canopen, context);
    }
}

static void receive_lss(canopen_t *canopen, const canopen_context_t *context, const hal_can_frame_t *frame) {
    if (canopen_lss_receive(canopen, context, frame)) {
        reset_communication(canopen, context->time_us);
        canopen_reset_values(canopen, false);
    }
}

COLD void canopen_receive(canopen_t *canopen, const canopen_context_t *context, const hal_can_frame_t *frame) {
    const uint32_t id = frame->identifier;
    const bool initialises = canopen->nmt == CANOPEN_NMT_INITIALISING;
    if (frame->extended || canopen->restart ||
        (initialises && (canopen->node <= CANOPEN_NODE_MAX || frame->remote || id != CANOPEN_LSS_REQUEST))) {
        return;
    }
    if (frame->remote) {
        if (id == HEARTBEAT_ID + canopen->node) {
            respond_guard(canopen, context);
        }
    } else if (id == NMT_ID) {
        receive_nmt(canopen, context, frame);
    } else if (id == CANOPEN_SDO_REQUEST + canopen->node) {
        receive_sdo(canopen, context, frame);
    } else if (id == CANOPEN_LSS_REQUEST) {
        receive_lss(canopen, context, frame);
    } else if (id > HEARTBEAT_ID && id <= HEARTBEAT_ID + CANOPEN_NODE_MAX) {
        receive_heartbeat(canopen, context, frame);
    } else {
        receive_data(canopen, context, frame);
    }
}

/* --- what is due ------------------------------------------------------------------------------------------------- */

static void watch(canopen_t *canopen, const canopen_context_t *context, canopen_watch_t *watch, uint32_t limit_us) {
    if (watch->watched && limit_us != 0 && context->time_us - watch->time_us > limit_us) {
        *watch = (canopen_watch_t){0}; /* until the next sign of life */
        canopen_drive_lose_master(canopen, context, CANOPEN_MASTER_SILENT);
    }
}

/* A stop ends by itself, but for a quick stop that stays. */
static bool goes_on(const canopen_drive_t *drive) {
    return drive->state == CANOPEN_OPERATION_ENABLED
               ? !drive->stopping
               : drive->state == CANOPEN_QUICK_STOP_ACTIVE && drive->after == CANOPEN_QUICK_STOP_ACTIVE;
}

/* Without another supervision the silence of all masters is watched while the drive is enabled. */
static void watch_silence(canopen_t *canopen, const canopen_context_t *context, bool watched) {
    const uint32_t limit_us = (uint32_t)canopen->values[CANOPEN_VALUE_SILENCE] * US_PER_MS;
    for (unsigned pdo = 0; pdo < CANOPEN_PDOS; pdo++) {
        watched = watched || (canopen->rpdo[pdo].seen && canopen->values[CANOPEN_VALUE_RPDO_TIMER + pdo] != 0);
    }
    if (goes_on(&canopen->drive) && !watched && context->time_us - canopen->heard_us > limit_us) {
        canopen_drive_lose_master(canopen, context, CANOPEN_MASTER_SILENT);
    }
}

static void watch_master(canopen_t *canopen, const canopen_context_t *context) {
    const uint32_t guard_ms = (uint32_t)canopen->values[CANOPEN_VALUE_GUARD_TIME] *
                              (uint32_t)canopen->values[CANOPEN_VALUE_LIFE_FACTOR]; /* below 2^24 */
    const uint32_t guard_us = fixed_min_u32(guard_ms, GUARD_MAX_MS) * US_PER_MS;
    bool watched = canopen->guard.watched && guard_us != 0;
    watch(canopen, context, &canopen->guard, guard_us);
    for (unsigned i = 0; i < CANOPEN_CONSUMERS; i++) {
        const uint32_t time_ms = (uint32_t)canopen->values[CANOPEN_VALUE_CONSUMER + i] & UINT16_MAX;
        watched = watched || canopen->consumer[i].watched;
        watch(canopen, context, &canopen->consumer[i], time_ms * US_PER_MS);
    }
    if (canopen->bus_off) {
        canopen->bus_off = false;
        canopen_drive_lose_master(canopen, context, CANOPEN_BUS_OFF);
    }
    watch_silence(canopen, context, watched);
}

static void send_state(canopen_t *canopen, const canopen_context_t *context) {
    const uint32_t period_us = (uint32_t)canopen->values[CANOPEN_VALUE_HEARTBEAT] * US_PER_MS;
    if (canopen->boot_up) {
        const uint8_t state = CANOPEN_NMT_INITIALISING;
        canopen_send(canopen, context, HEARTBEAT_ID + canopen->node, &state, 1);
        canopen->boot_up = false;
        canopen->nmt = CANOPEN_NMT_PRE_OPERATIONAL;
        canopen->heartbeat_us = context->time_us;
    } else if (period_us != 0 && context->time_us - canopen->heartbeat_us >= period_us) {
        const uint8_t state = (uint8_t)canopen->nmt;
        canopen->heartbeat_us = context->time_us;
        canopen_send(canopen, context, HEARTBEAT_ID + canopen->node, &state, 1);
    }
}

/* Defaults of the parameters, as object 0x1011 has asked for; the protocol stays, with its node-ID. */
static void restore(canopen_t *canopen, const canopen_context_t *context) {
    const int32_t protocol = context->parameters->values[PARAMETER_PROTOCOL];
    if (!canopen->restore || !parameter_set_begin(context->set, context->parameters, true)) {
        return;
    }
    parameter_set_stage(context->set, PARAMETER_PROTOCOL, protocol);
    const parameters_verdict_t verdict = parameter_set_finish(context->set, context->parameters, context->conditions);
    if (verdict.status == PARAMETER_STATUS_DONE) {
        parameter_store_save(context->store);
    }
}

COLD bool canopen_step(canopen_t *canopen, const canopen_context_t *context, command_t *command) {
    if (canopen->restart && !context->conditions->running) {
        restore(canopen, context);
        canopen_init(canopen, (unsigned)context->parameters->values[PARAMETER_PROTOCOL], canopen->serial,
                     context->time_us);
        return false;
    }
    canopen_sdo_step(canopen, context);
    if (!canopen->cycle) {
        return false;
    }
    canopen->cycle = false;
    canopen->measured.supplied =
        (int32_t)canopen->measured.voltage_q6 >= context->parameters->values[PARAMETER_UNDER_VOLTAGE_V];
    watch_master(canopen, context);
    canopen_drive_step(canopen, context, command);
    if (canopen->node > CANOPEN_NODE_MAX) {
        return true; /* nothing has a COB-ID */
    }
    canopen_send_emergencies(canopen, context, canopen_drive_error_register(canopen));
    send_state(canopen, context);
    if (canopen->nmt == CANOPEN_NMT_OPERATIONAL) {
        canopen_pdo_step(canopen, context);
    }
    return true;
}
