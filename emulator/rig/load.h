/* The load on the shaft: load_torque_Nm, which steps or ramps, plus a sine over time, plus a profile over the angle.
 *
 * A load that moves is a staircase: EVENT_LOAD sets the torque each LOAD_STEP_NS of virtual time to its exact value at
 * that instant, where it stays until the next event. On average it is half a step late; the profile, which is taken at
 * the true angle half a step later, is not. Without a sine, a ramp or a profile there are no events, and the plant is
 * advanced as if this file did not exist.
 */
#ifndef RIG_LOAD_H
#define RIG_LOAD_H

#include <stdbool.h>
#include <stdint.h>

#include "plant/plant.h"
#include "rig/scheduler.h"

#define LOAD_STEP_NS UINT64_C(20000)
#define LOAD_PROFILE_MAX 256 /* values */

typedef struct {
    plant_t *plant;         /* whose load it is */
    scheduler_t *scheduler; /* with EVENT_LOAD */
    double torque_Nm;       /* load_torque_Nm as set: where a ramp ends */
    double ramp_Nm_s;       /* 0: steps */
    double ramp_from_Nm;
    uint64_t ramp_start_ns;
    double sine_amplitude_Nm;
    double sine_frequency_Hz;
    double sine_start_periods; /* phase at sine_start_ns */
    uint64_t sine_start_ns;
    double profile_Nm; /* of the value 1 */
    unsigned profile_values;
    double profile[LOAD_PROFILE_MAX]; /* over one turn */
    bool dropped;                     /* no load, whatever the members above */
} load_t;

/* No load; a change of load_torque_Nm steps; amplitude 0. Keeps plant and scheduler. */
void load_init(load_t *load, plant_t *plant, scheduler_t *scheduler);

/* The bench variables of these names (rig.dbc), from the present time on. */
void load_set_torque(load_t *load, double torque_Nm);
void load_set_ramp(load_t *load, double rate_Nm_s);
void load_set_sine_amplitude(load_t *load, double amplitude_Nm);
void load_set_sine_frequency(load_t *load, double frequency_Hz);
void load_set_profile(load_t *load, double torque_Nm);

/* Takes the load off the shaft from the present time on, or puts it on again; its ramp, sine and profile go on. */
void load_drop(load_t *load, bool dropped);

/* RIG_LOAD_PROFILE: one value of the profile, from the next step on; ignored unless
 * index < values <= LOAD_PROFILE_MAX. */
void load_set_profile_value(load_t *load, unsigned values, unsigned index, double value);

/* EVENT_LOAD: the next step of a load that moves. */
void load_step(load_t *load);

#endif
