/* CANopen (CiA 301) with the drive profile CiA 402, in place of the frames of drive.dbc: chosen at the start by the
 * parameter `protocol`, whose value is the node-ID.
 *
 * It stands beside commands.h, behind which nothing differs: it makes the command_t that the drive executes, changes
 * parameters by the checks of a set (parameter_set.h), stores them by the store, and reports the faults of the drive.
 * objects.toml is the table of its objects; canopen_objects.h has access to them, canopen_sdo.h and canopen_pdo.h carry
 * them, canopen_drive.h is the state machine of the profile. docs/can/canopen.md lists what conforms and what not;
 * docs/safety/canopen.md why the drive may run without the challenge of arming.h.
 *
 * All functions run in the background.
 */
#ifndef COMMS_CANOPEN_H
#define COMMS_CANOPEN_H

#include "comms/canopen_types.h"

/* node: node-ID, 0 for none; serial: serial number. State pre-operational after the boot-up message. */
void canopen_init(canopen_t *canopen, unsigned node, unsigned serial, uint32_t time_us);

/* Handles a received frame. */
void canopen_receive(canopen_t *canopen, const canopen_context_t *context, const hal_can_frame_t *frame);

/* Takes over a telemetry cycle. */
void canopen_telemetry(canopen_t *canopen, const drive_telemetry_t *values);

/* Watches the master and queues what is due; true when *command is to be executed: once in each telemetry cycle. To be
 * called in every round of the background. */
bool canopen_step(canopen_t *canopen, const canopen_context_t *context, command_t *command);

#endif
