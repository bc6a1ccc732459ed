/* Draws the faults of a world. */
#ifndef CAMPAIGN_WORLD_FAULTS_H
#define CAMPAIGN_WORLD_FAULTS_H

#include "campaign/world.h"

/* No fault of the bench; two phases lost one after the other; one lasting fault alone. */
bool world_is_faultless(uint64_t seed);
bool world_loses_two(uint64_t seed);
bool world_has_lasting_fault(uint64_t seed);

/* Faults until last_us; of bus, safe torque off, interrupt time and resets: bench variables. */
void world_draw_faults(world_t *world, uint64_t last_us);
void world_draw_other_faults(world_t *world, uint64_t last_us);

#endif
