/* Steps of the plant in which all phases step together (integrator.h): for a plant with faults or coupled phases,
 * and where a comparator
 * responds. */
#ifndef PLANT_COMMON_STEPS_H
#define PLANT_COMMON_STEPS_H

#include <stdint.h>

#include "plant/plant_state.h"

/* Advances to `to_ns` with constant switch states, or to the time at which a comparator opens them, and takes the
 * samples within. */
void common_steps_advance(plant_t *plant, uint64_t to_ns);

#endif
