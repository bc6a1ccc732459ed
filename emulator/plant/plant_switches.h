/* Switches of the plant over a control period. */
#ifndef PLANT_PLANT_SWITCHES_H
#define PLANT_PLANT_SWITCHES_H

#include <stdint.h>

#include "hal_pwm.h"
#include "plant/plant_state.h"

/* Starts a control period at time_ns: the switches follow `compare` (half_bridge.h) for 2 * period_ticks timer ticks
 * and then keep their states until the next call. period_ticks > 0. */
void plant_set_switches(plant_t *plant, const hal_pwm_compare_t *compare, uint16_t period_ticks);

/* Switches follow the edges up to time_ns; returns the time of the next one, at most to_ns. */
uint64_t plant_follow_edges(plant_t *plant, uint64_t to_ns);

/* Opens all switches at time_ns and discards the pending edges. */
void plant_open_all(plant_t *plant);

#endif
