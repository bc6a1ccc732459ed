/* Record of a fault. The faults are those of drive.dbc. */
#ifndef DRIVE_FAULT_H
#define DRIVE_FAULT_H

#include <stdint.h>

#include "drive_enumerations.h"

/* Bit of a fault in a mask of failed checks. */
#define FAULT_BIT(fault) ((uint16_t)(1u << (fault)))

/* The first fault since the last clearing and the drive as it was in that tick. */
typedef struct {
    fault_t fault;   /* lowest number among the checks */
    uint16_t checks; /* every check that failed in that tick, FAULT_BIT */
    uint8_t state;   /* drive_state_t in that tick */
    uint32_t time_us;
    int32_t speed_q22;            /* rad/s, Q9.22 */
    int32_t torque_reference_q24; /* N m, Q7.24 */
    uint16_t current_max_q9;      /* A, Q7.9 */
    uint16_t bus_voltage_q6;      /* V, Q9.6 */
} fault_record_t;

#endif
