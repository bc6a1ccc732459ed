/* CAN interface of the drive: receives commands, parameter requests and sets of parameters, sends telemetry and
 * responses.
 *
 * All functions run in the background. The caller's loop:
 *
 *     const uint32_t time_us = hal_time_us(hal);
 *     if (comms_telemetry_due(&comms, time_us)) {
 *         bus_monitor_step(&comms.bus, hal, time_us);
 *         ... collect a drive_telemetry_t, with the control interrupt masked ...
 *         comms_telemetry(&comms, hal, &values);
 *     }
 *     if (comms_background(&comms, hal, &objects, state, time_us)) {
 *         ... execute comms.command ...
 *     }
 */
#ifndef COMMS_COMMS_H
#define COMMS_COMMS_H

#include <stdbool.h>
#include <stdint.h>

#include "comms/bus_monitor.h"
#include "comms/canopen.h"
#include "comms/commands.h"
#include "comms/frame_queue.h"
#include "comms/parameter_set.h"
#include "comms/telemetry.h"
#include "comms/xcp.h"
#include "hal_can.h"
#include "interrupts/control_step.h"
#include "interrupts/fault_trace.h"
#include "interrupts/self_test.h"
#include "storage/nvm_store.h"
#include "storage/parameters.h"

/* Maximum number of received frames that one call processes. The shortest frame takes 47 us at 1 Mbit/s, so even a
 * fully loaded bus delivers fewer than this between two calls at the lowest control rate. */
#define COMMS_FRAMES_PER_CALL 4

/* Telemetry fills no mailbox in this time after a challenge, unless the attempt to arm ends: most of its identifiers
 * are lower than DRIVE_ARMING's, and the host waits for the challenge. The frames wait in their queue. */
#define COMMS_CHALLENGE_FIRST_US 500u

typedef struct {
    bus_monitor_t bus;
    commands_t commands;
    telemetry_t telemetry;
    frame_queue_t responses; /* to parameter requests and steps of a set */
    bool response_first;     /* one may pass ahead of telemetry in this cycle */
    parameter_set_t set;     /* staged */
    xcp_t xcp;               /* initialised by the caller after comms_init */
    command_t command;       /* last accepted command */
    uint32_t arming_sent_us; /* when DRIVE_ARMING last entered a mailbox because of a change */
    uint32_t node_offset;    /* of identifiers and data IDs; the other two copies are in telemetry and commands */
    canopen_t canopen;       /* in place of all above but bus, responses, set and command when it has a node-ID */
} comms_t;

/* Objects that requests read or change, for one call. */
typedef struct {
    parameters_t *parameters;
    parameters_conditions_t conditions; /* for a set of parameters to be applied now */
    nvm_store_t *store;
    const fault_trace_t *trace;
    const self_test_t *self_test;
    const control_parameters_t *control_parameters;
    table_store_t *tables; /* NULL: the port does not load them */
} comms_objects_t;

/* The first telemetry cycle is due at time_us. node: 0..NODE_MAX. */
void comms_init(comms_t *comms, unsigned node, uint32_t time_us);

/* Chooses the protocol, after comms_init. protocol: the parameter, 0 for drive.dbc, else CANopen with this
 * node-ID. */
void comms_choose(comms_t *comms, int32_t protocol, uint32_t time_us);

/* Bus-off: no run begins, or goes on, by itself. [background] */
void comms_bus_off(comms_t *comms);

/* Sends waiting frames and processes at most COMMS_FRAMES_PER_CALL received frames. Returns true when a command was
 * accepted, in comms->command; reception stops there, so that the caller sees every command, in order. state: of the
 * drive.
 *
 * A challenge is sent first, then telemetry; when none waits, other changes of DRIVE_ARMING, then parameter responses.
 * When the bus does not take the telemetry of a cycle, one response passes ahead of it in each cycle. While the queue
 * of responses is full a frame that needs one has no effect, is dropped and counted (telemetry.dropped): it must not
 * hold up the commands behind it, and PARAMETER_SET_CONTROL wins arbitration over all that the drive sends.
 *
 * Of a frame that is neither command nor request, the identifier may be one of the drive's own (comms->bus). Frames of
 * the traffic of other nodes are ignored (comms/node.h).
 *
 * Who is heard and by which identifiers the drive sends is its node's: of the three copies of its offset a call of this
 * or the next function begins with the majority of each bit. [background] */
bool comms_background(comms_t *comms, hal_t *hal, const comms_objects_t *objects, drive_state_t state,
                      uint32_t time_us);

/* True when comms_telemetry is due. [background] */
static inline bool comms_telemetry_due(const comms_t *comms, uint32_t time_us) {
    return telemetry_due(&comms->telemetry, time_us);
}

/* Queues one cycle of telemetry and fills the free mailboxes; writes values->bus_counters.telemetry_dropped. With
 * CANopen takes the values over. [background] */
void comms_telemetry(comms_t *comms, hal_t *hal, drive_telemetry_t *values);

/* Where the report of the position loop is to be copied in each telemetry cycle; NULL without CANopen. [background] */
position_status_t *comms_place(comms_t *comms);

#endif
