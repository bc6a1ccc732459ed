/* What the drive is asked to do, whatever brought the request. */
#ifndef DRIVE_COMMAND_H
#define DRIVE_COMMAND_H

#include <stdint.h>

/* The values of DRIVE_COMMAND.request in drive.dbc. */
typedef enum { COMMAND_OFF, COMMAND_RUN, COMMAND_STOP, COMMAND_CLEAR_FAULT } command_request_t;

typedef struct {
    command_request_t request;
    int32_t speed_reference_q22; /* rad/s, Q9.22, 0..3000 r/min */
    uint32_t time_us;            /* the drive's time when it was accepted */
} command_t;

#endif
