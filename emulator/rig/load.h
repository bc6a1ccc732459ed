/* The load on the shaft: load_torque_Nm, which steps or ramps, plus a sine over time, plus a profile over the angle.
 *
 * A load that moves is a staircase: EVENT_LOAD sets the torque each LOAD_STEP_NS of virtual time to its exact value at
 * that instant, where it stays until the next event. On average it is half a step late; the profile, which is that of
 * the true angle half a step later, is not. Without a sine, a ramp or a profile there are no events, and the plant is
 * advanced as if this file did not exist.
 */
#ifndef RIG_LOAD_H
#define RIG_LOAD_H

#include <stdint.h>

#include "rig/rig.h"

#define LOAD_STEP_NS UINT64_C(20000)

/* No load; a change of load_torque_Nm steps; amplitude 0. */
void load_init(rig_t *rig);

/* The bench variables of these names (rig.dbc), from the present time on. */
void load_set_torque(rig_t *rig, double torque_Nm);
void load_set_ramp(rig_t *rig, double rate_Nm_s);
void load_set_sine_amplitude(rig_t *rig, double amplitude_Nm);
void load_set_sine_frequency(rig_t *rig, double frequency_Hz);
void load_set_profile(rig_t *rig, double torque_Nm);

/* Takes the load off the shaft from the present time on, or puts it on again; its ramp, sine and profile go on. */
void load_drop(rig_t *rig, bool dropped);

/* RIG_LOAD_PROFILE: one value of the profile, from the next step on; ignored unless index < values <= 256. */
void load_set_profile_value(rig_t *rig, unsigned values, unsigned index, double value);

/* Handler of EVENT_LOAD; context is the rig. */
void load_event(void *context, uint64_t now_ns);

#endif
