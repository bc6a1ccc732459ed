/* Draws the world of a seed.
 *
 * Swarm testing: each seed switches most kinds of events off (A. Groce et al., "Swarm testing", ISSTA 2012). */
#ifndef CAMPAIGN_WORLD_DRAW_H
#define CAMPAIGN_WORLD_DRAW_H

#include "campaign/world.h"

/* Machine, board and sensors, and how they scatter: parts of every kind. */
void world_draw_board(world_t *world, const world_machine_t *machines, unsigned count, uint64_t seed);
void world_draw_imperfections(world_t *world);

/* With faults; a healthy one. */
void world_draw(world_t *world, const world_machine_t *machines, unsigned count, uint64_t seed);
void world_draw_healthy(world_t *world, const world_machine_t *machines, unsigned count, uint64_t seed);

#endif
