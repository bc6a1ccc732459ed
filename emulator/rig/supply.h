/* The voltage of the supply: supply_voltage_V of the bench, and its faults. Ripple is a staircase: EVENT_SUPPLY sets
 * the voltage each SUPPLY_STEP_NS to that of the middle of the step. */
#ifndef RIG_SUPPLY_H
#define RIG_SUPPLY_H

#include <stdint.h>

#include "rig/rig.h"

#define SUPPLY_STEP_NS UINT64_C(20000)

/* That of the machine file, without faults. */
void supply_init(rig_t *rig);

/* supply_voltage_V, from the present time on. */
void supply_set_voltage(rig_t *rig, double voltage_V);

/* Of the ripple, 300 Hz at the start; its phase is 0 from now on. */
void supply_set_ripple_frequency(rig_t *rig, double frequency_Hz);

/* A factor of that voltage, and the amplitude of a sine that is added, its phase 0 when it begins. */
void supply_set_fault(rig_t *rig, double factor, double ripple_V);

/* Handler of EVENT_SUPPLY; context is the rig. */
void supply_event(void *context, uint64_t now_ns);

#endif
