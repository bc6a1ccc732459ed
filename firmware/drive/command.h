/* Motion command to the drive, independent of its source.
 *
 * Direction: the encoder counts up when the rotor turns forward; forward speed and the torque that drives it are
 * positive, everywhere in the drive. A negative speed reference is reverse. salient drives and brakes in both
 * directions and reverses through zero without leaving RUN; traditional and paper are single-quadrant: they drive
 * forward only, treat a negative reference as 0 and leave braking to friction and load.
 */
#ifndef DRIVE_COMMAND_H
#define DRIVE_COMMAND_H

#include <stdint.h>

#include "drive_enumerations.h"

typedef struct {
    command_request_t request;
    int32_t speed_reference_q22; /* used by COMMAND_RUN: rad/s, Q9.22, -3000..3000 r/min, negative is reverse */
    uint32_t time_us;            /* drive time of acceptance */
} command_t;

#endif
