/* The RIG_TRUTH frames: the plant's true state, not what sensors see of it. */
#ifndef RIG_TRUTH_H
#define RIG_TRUTH_H

#include "plant/plant.h"
#include "rig/transport_frame.h"

#define TRUTH_FRAMES 3

/* Packs the state of now: motion, currents, bench. Values beyond a signal's range are held at its end; the rotor angle
 * is within a turn, 0..360 deg. */
void truth_pack(const plant_t *plant, transport_frame_t frames[TRUTH_FRAMES]);

#endif
