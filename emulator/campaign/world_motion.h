/* Draws the world of a seed with positions by the drive's own frames, or with a CANopen master. */
#ifndef CAMPAIGN_WORLD_MOTION_H
#define CAMPAIGN_WORLD_MOTION_H

#include "campaign/world.h"

void world_draw_motion(world_t *world, const world_machine_t *machines, unsigned count, uint64_t seed);

#endif
