/* RIG_TRUTH frames: the true state of the plant, without sensor errors. */
#ifndef RIG_TRUTH_H
#define RIG_TRUTH_H

#include "plant/plant.h"
#include "rig/heat.h"
#include "rig/transport_frame.h"

#define TRUTH_FRAMES_MAX 6

/* Packs the present state: motion, currents and bench in two parts each. Values are clamped to the range of their
 * signal; the rotor angle is wrapped to 0..360 deg. */
unsigned truth_pack(const plant_t *plant, const heat_t *heat, transport_frame_t frames[TRUTH_FRAMES_MAX]);

/* Packs RIG_TRUTH_FAULT: a fault of this kind (rig.dbc) begins or ends. */
void truth_pack_fault(unsigned kind, unsigned phase, unsigned leg, bool present, transport_frame_t *frame);

#endif
