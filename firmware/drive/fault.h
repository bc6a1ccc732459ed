/* Record of a fault. The faults and their numbers are those of drive.dbc. */
#ifndef DRIVE_FAULT_H
#define DRIVE_FAULT_H

#include <stdint.h>

#include "drive_enumerations.h"

/* Bit of a fault in a fault mask, which has 64 bits: bit number = fault number. */
#define FAULT_BIT(fault) (UINT64_C(1) << (fault))

/* First fault since the last clearing, and the drive in the tick that latched it. */
typedef struct {
    fault_t fault; /* lowest number in fault_mask */
    uint32_t time_us;
    uint64_t fault_mask;          /* every check that failed in that tick, FAULT_BIT */
    int32_t speed_q22;            /* rad/s, Q9.22 */
    int32_t torque_reference_q24; /* N m, Q7.24 */
    uint16_t current_max_q9;      /* largest phase current, A, Q7.9 */
    uint16_t dc_link_voltage_q6;  /* V, Q9.6 */
    uint8_t state;                /* drive_state_t in that tick */
} fault_record_t;

#endif
