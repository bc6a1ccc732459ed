/* The voltage of the supply: supply_voltage_V of the bench, and its faults. Ripple is a staircase: EVENT_SUPPLY sets
 * the voltage each SUPPLY_STEP_NS to the value in the middle of the step. */
#ifndef RIG_SUPPLY_H
#define RIG_SUPPLY_H

#include <stdint.h>

#include "plant/plant.h"
#include "rig/scheduler.h"

#define SUPPLY_STEP_NS UINT64_C(20000)

typedef struct {
    plant_t *plant;         /* that it supplies */
    scheduler_t *scheduler; /* with EVENT_SUPPLY */
    double voltage_V;       /* supply_voltage_V */
    double factor;          /* of a fault */
    double ripple_V, ripple_Hz;
    uint64_t ripple_start_ns;
} supply_t;

/* The voltage of the machine file, without faults. Keeps plant and scheduler. */
void supply_init(supply_t *supply, plant_t *plant, scheduler_t *scheduler);

/* supply_voltage_V, from the present time on. */
void supply_set_voltage(supply_t *supply, double voltage_V);

/* Frequency of the ripple, 300 Hz at the start; its phase is 0 from now on. */
void supply_set_ripple_frequency(supply_t *supply, double frequency_Hz);

/* A factor of that voltage, and the amplitude of a sine that is added, its phase 0 when it begins. */
void supply_set_fault(supply_t *supply, double factor, double ripple_V);

/* EVENT_SUPPLY: the next step of a voltage with ripple. */
void supply_step(supply_t *supply);

#endif
