/* Drawing of a world: what its parts share. */
#ifndef CAMPAIGN_WORLD_DRAW_H
#define CAMPAIGN_WORLD_DRAW_H

#include "campaign/world.h"

/* Streams of random numbers; the index within one is that of the draw. */
enum {
    STREAM_BOARD = 1,
    STREAM_IMPERFECTION,
    STREAM_SPEED,
    STREAM_LOAD,
    STREAM_SCRIPT,
    STREAM_FAULT_ON,
    STREAM_FAULT,
    STREAM_BUS,
    STREAM_GATES,
    STREAM_TORQUE,
    STREAM_REQUEST,
};

#define DEGRADED_SHARE 0.1 /* of the seeds */

/* NULL: there is no room. */
world_event_t *world_add(world_t *world, world_kind_t kind, uint64_t begin_us, uint64_t end_us);

/* A bench variable that has a value from begin to end, and another one after it; end 0: it lasts. */
void world_add_set(world_t *world, unsigned variable, double value, double after, uint64_t begin_us, uint64_t end_us);

/* low <= number < high, of which the logarithm is uniform. */
double world_logarithmic(uint64_t seed, uint64_t stream, uint64_t index, double low, double high);

/* --- Faults --- */

/* No fault of the bench; two phases lost one after the other; one lasting fault alone. */
bool world_is_faultless(uint64_t seed);
bool world_loses_two(uint64_t seed);
bool world_has_lasting_fault(uint64_t seed);

/* Faults until last_us; of bus, safe torque off, interrupt time and resets: bench variables. */
void world_draw_faults(world_t *world, uint64_t last_us);
void world_draw_other_faults(world_t *world, uint64_t last_us);

#endif
