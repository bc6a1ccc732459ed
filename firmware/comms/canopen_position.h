/* Modes of position of CiA 402: profile position (1), homing (6), cyclic synchronous position (8).
 *
 * They order the position loop (control/position) in the units and with the limits of the profile; what it does with a
 * target, a limit, a following error or a homing is the same as by a position command of drive.dbc. Until the first
 * set-point, target or start of a homing after a mode begins, with the halt bit and after a homing the drive holds.
 *
 * Profile position: bit 4 of the controlword takes a set-point, 0x607A with the profile's limits as they are then. One
 * runs and one waits for its end: within 0x6067 of the target for 0x6068. Bit 12 of the statusword falls when bit 4 has
 * fallen and no set-point waits; an edge before that is without effect. Relative set-points are relative to the one
 * accepted before.
 *
 * Homing: bit 4 begins, and its fall interrupts. It begins once the position loop has seen the halt before it, so that
 * the same method can be begun again.
 *
 * Cyclic: each write of 0x607A is a target, that is reached within 0x60C2 ms.
 */
#ifndef COMMS_CANOPEN_POSITION_H
#define COMMS_CANOPEN_POSITION_H

#include "comms/canopen_types.h"

enum { CANOPEN_MODE_POSITION = 1, CANOPEN_MODE_HOMING = 6, CANOPEN_MODE_CYCLIC_POSITION = 8 };

/* The demand of the mode is one of position. */
static inline bool canopen_position_is(unsigned mode) {
    return mode == CANOPEN_MODE_POSITION || mode == CANOPEN_MODE_HOMING || mode == CANOPEN_MODE_CYCLIC_POSITION;
}

/* A mode of position begins: the drive stops by the profile and holds. */
void canopen_position_begin(canopen_t *canopen);

/* Bit 4 of the controlword has changed. */
void canopen_position_order(canopen_t *canopen, bool rises);

/* 0x607A has been written: a target of the cyclic mode. */
void canopen_position_target(canopen_t *canopen);

/* A telemetry cycle: the next set-point, and the order that is published. */
void canopen_position_step(canopen_t *canopen, uint32_t elapsed_us, bool halted);

/* The set point of a command to run; halted: with the deceleration of a halt. */
void canopen_position_command(const canopen_t *canopen, bool halted, position_set_point_t *set_point);

/* At the target of the last set-point by the position loop, within the window. */
bool canopen_position_within(const canopen_t *canopen);

/* Bits 10, 12 and 13 of the statusword. */
bool canopen_position_reached(const canopen_t *canopen, bool halted);
bool canopen_position_acknowledged(const canopen_t *canopen, bool halted);
bool canopen_position_failed(const canopen_t *canopen);

/* Parameter homing_method from a method of CiA 402, POSITION_HOMING_METHODS for one that the drive has not; and the
 * reverse. */
position_homing_t canopen_homing_method(int32_t method);
int32_t canopen_homing_number(int32_t parameter);

#endif
