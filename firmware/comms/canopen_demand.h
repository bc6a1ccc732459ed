/* Demand of the modes of CiA 402: profile velocity (3) and torque (4), which follow a ramp, and their cyclic
 * synchronous forms (9, 10), which interpolate between references. Modes of position: canopen_position.h; a ramp to
 * standstill is one of the velocity in them, too.
 *
 * Demands are 0.001 r/min, or 0.001 per mille of the rated torque, with 16 fraction bits in 64 bits. In a step the
 * demand moves by at most rate * time, rounded to 2^-16, in at most CANOPEN_STEP_MAX_US of time: a background that was
 * held up does not jump. */
#ifndef COMMS_CANOPEN_DEMAND_H
#define COMMS_CANOPEN_DEMAND_H

#include "comms/canopen_types.h"

#define CANOPEN_STEP_MAX_US 8000u

/* A ramp to standstill ends the run so long after its demand is 0, whatever turns the rotor. */
#define CANOPEN_STANDSTILL_MAX_US 1000000u

enum {
    CANOPEN_MODE_NONE = 0,
    CANOPEN_MODE_VELOCITY = 3,
    CANOPEN_MODE_TORQUE = 4,
    CANOPEN_MODE_CYCLIC_VELOCITY = 9,
    CANOPEN_MODE_CYCLIC_TORQUE = 10
};

/* Begins the mode of 0x6060 with the present velocity, or the present torque reference. */
void canopen_demand_begin(canopen_t *canopen);

/* Begins a ramp to standstill with the present velocity in any mode. */
void canopen_demand_stop(canopen_t *canopen);

/* The drive rests after that ramp: below the velocity threshold, or CANOPEN_STANDSTILL_MAX_US after its end. */
bool canopen_demand_rests(const canopen_t *canopen, uint32_t time_us);

/* A variable has been written: of a cyclic reference the demand moves to it within the interpolation time. */
void canopen_demand_target(canopen_t *canopen, unsigned slot);

/* Moves the demand. */
void canopen_demand_step(canopen_t *canopen, uint32_t time_us);

/* Mode and reference of a command to run. */
void canopen_demand_command(canopen_t *canopen, command_t *command);

/* Velocity demand, 0.001 r/min; 0 in a mode of torque. */
int32_t canopen_demand_velocity(const canopen_t *canopen);

/* 0x6502, and true for a mode that it has, or none. Modes of position need a controller of four quadrants. */
int32_t canopen_demand_modes(const canopen_t *canopen);
bool canopen_demand_has_mode(const canopen_t *canopen, int32_t mode);

/* Bits 10 and 12 of the statusword. */
bool canopen_demand_reached(const canopen_t *canopen);
bool canopen_demand_slow_or_followed(const canopen_t *canopen);

#endif
