/* What the drive is asked to do, whatever brought the request.
 *
 * Direction: the encoder counts up when the rotor turns forwards; forward speed and the torque that drives it are
 * positive, everywhere in the drive. A negative speed reference asks for the other direction. Which quadrants a
 * controller has is its own affair: salient drives and brakes in both directions and reverses through zero without
 * leaving RUN; traditional and paper only drive forwards, take a negative reference as 0 and leave braking to friction
 * and load.
 */
#ifndef DRIVE_COMMAND_H
#define DRIVE_COMMAND_H

#include <stdint.h>

/* The values of DRIVE_COMMAND.request in drive.dbc. */
typedef enum { COMMAND_OFF, COMMAND_RUN, COMMAND_STOP, COMMAND_CLEAR_FAULT } command_request_t;

typedef struct {
    command_request_t request;
    int32_t speed_reference_q22; /* of COMMAND_RUN: rad/s, Q9.22, -3000..3000 r/min, negative backwards */
    uint32_t time_us;            /* the drive's time when it was accepted */
} command_t;

#endif
