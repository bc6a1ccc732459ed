/* State machine of CiA 402, and the demand of its modes.
 *
 *   state                      drive                          from there, by controlword or by itself
 *   not ready to switch on     initialise                     switch on disabled
 *   switch on disabled         ready, no request to run       shutdown: ready to switch on
 *   ready to switch on         likewise                       switch on: switched on
 *   switched on                likewise                       enable operation: operation enabled
 *   operation enabled          armed, runs                    the option codes say how it ends
 *   quick stop active          armed, runs to standstill      switch on disabled, or stays (options 5, 6)
 *   fault reaction active      likewise, the master is lost   fault
 *   fault                      fault, all switches open       fault reset: switch on disabled
 *
 * Enable operation arms the drive: in state operational of the NMT, when the drive is ready. Whatever disarms it
 * (commands.h) leaves operation enabled.
 *
 * The demand follows its ramp once in each telemetry cycle, and is published as a command of speed or torque with the
 * time of that cycle: a background that stands still is the fault command_timeout as with the other protocol.
 */
#ifndef COMMS_CANOPEN_DRIVE_H
#define COMMS_CANOPEN_DRIVE_H

#include "comms/canopen_types.h"

/* Enable operation waits so long for a drive that has just been disabled. */
#define CANOPEN_ENABLING_US 20000u

/* The drive is asked to clear its fault for so long. */
#define CANOPEN_CLEARING_US 100000u

/* The controlword has been written. */
void canopen_drive_control(canopen_t *canopen, const canopen_context_t *context);

/* A controlword by which an enabled drive stops or opens its switches, and one that is ready to is not any more. */
bool canopen_drive_is_stop(const canopen_t *canopen, uint32_t word);

/* Error codes of a lost master: by heartbeat, guarding or silence, by bus-off, by the event timer of a receive PDO. */
#define CANOPEN_MASTER_SILENT 0x8130u
#define CANOPEN_BUS_OFF 0x8140u
#define CANOPEN_RPDO_TIMEOUT 0x8250u

/* Error code of a following error: the position loop has stopped, and the drive runs on. */
#define CANOPEN_FOLLOWING_ERROR 0x8611u

/* The master is lost, for the reason of an error code: emergency, error behaviour 0x1029, canopen_drive_abort. */
void canopen_drive_lose_master(canopen_t *canopen, const canopen_context_t *context, unsigned code);

/* The NMT has left operational, or the master is lost: reaction 0x6007 of a drive that is enabled. */
void canopen_drive_abort(canopen_t *canopen, const canopen_context_t *context);

/* Opens all switches: switch on disabled, or fault in a fault. */
void canopen_drive_disable(canopen_t *canopen, const canopen_context_t *context);

/* A telemetry cycle: writes the command. */
void canopen_drive_step(canopen_t *canopen, const canopen_context_t *context, command_t *command);

/* Values of objects. */
uint16_t canopen_drive_statusword(const canopen_t *canopen);
uint16_t canopen_drive_error_code(const canopen_t *canopen);
uint8_t canopen_drive_error_register(const canopen_t *canopen);

#endif
