/* Record of a fault. The faults and their numbers come from drive.dbc. */
#ifndef STORAGE_FAULT_H
#define STORAGE_FAULT_H

#include <stdint.h>

#include "drive_enumerations.h"
#include "hal.h"

/* Bit of a fault in a fault mask, which has 64 bits: bit number = fault number. */
#define FAULT_BIT(fault) (UINT64_C(1) << (fault))

/* First fault since the last clearing, and the drive in the tick that latched it. */
typedef struct {
    fault_t fault; /* lowest number in fault_mask */
    uint32_t time_us;
    uint64_t fault_mask;                 /* every check that failed in that tick, FAULT_BIT */
    int32_t speed_q22;                   /* rad/s, Q9.22 */
    int32_t torque_reference_q24;        /* N m, Q7.24 */
    uint16_t current_max_q9;             /* largest phase current, A, Q7.9 */
    uint16_t dc_link_voltage_q6;         /* V, Q9.6 */
    uint16_t current_q9[HAL_PHASES_MAX]; /* of the phases, A, Q7.9 */
    uint16_t angle;                      /* rotor, 2^-16 rev */
    uint16_t self_test; /* failed checks, bits of DRIVE_SELF_TEST; this and the next for the log only */
    uint8_t phases;     /* of a fault of phases, bits */
    uint8_t state;      /* drive_state_t in that tick */
    uint8_t sensors;    /* failed temperature sensors of phases e and f, for the log only */
} fault_record_t;

#endif
