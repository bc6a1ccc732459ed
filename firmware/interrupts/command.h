/* Command to the drive, independent of the interface that received it.
 *
 * Direction: the encoder counts up in forward rotation; forward speed and the torque that accelerates forwards are
 * positive throughout the drive. A negative speed reference requests reverse rotation. The quadrants depend on the
 * controller: salient motors and brakes in both directions and reverses through zero speed without leaving RUN;
 * traditional and paper only motor forwards, treat a negative reference as 0 and leave braking to friction and load.
 * `stop` ramps the speed to zero in either mode.
 */
#ifndef INTERRUPTS_COMMAND_H
#define INTERRUPTS_COMMAND_H

#include <stdbool.h>
#include <stdint.h>

#include "control/position/position.h"
#include "drive_enumerations.h"

/* Time without a valid command after which a run ends in the fault command_timeout. */
#define COMMAND_LOST_US 500000u

/* Request to run experiments (control/identify.h), beside the requests of the bus. */
#define COMMAND_IDENTIFY ((command_request_t)COMMAND_COUNT)

/* True of the requests that a drive has to be armed for. */
static inline bool command_needs_arming(command_request_t request) {
    return request == COMMAND_RUN || request == COMMAND_IDENTIFY;
}

typedef struct {
    command_request_t request;
    drive_mode_t mode;             /* of COMMAND_RUN: which of the references it follows */
    int32_t speed_reference_q22;   /* rad/s, Q9.22, within machine_tables.speed_reference_max, negative: reverse */
    int32_t torque_reference_q24;  /* N m, Q7.24, any value, negative: reverse or braking */
    uint32_t time_us;              /* the drive's time at acceptance */
    position_set_point_t position; /* of the mode position */
} command_t;

#endif
