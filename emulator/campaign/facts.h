/* Questions to an observation that several checkers ask. */
#ifndef CAMPAIGN_FACTS_H
#define CAMPAIGN_FACTS_H

#include "campaign/fault_effects.h"
#include "campaign/observation.h"

/* --- Faults and events of the world --- */

/* A fault that disturbs any of these is there, or was lately (DISTURBS_*). */
bool facts_disturbed(const observation_t *seen, uint32_t disturbs);

/* Likewise, of another kind than one. */
bool facts_disturbed_besides(const observation_t *seen, uint32_t disturbs, unsigned kind);

/* A fault that disturbs any of these has begun, whether or not it has ended. */
bool facts_ever_disturbed(const observation_t *seen, uint32_t disturbs);

/* A bench variable that does any of these is set, or was lately (VARIABLE_*). */
bool facts_variable(const observation_t *seen, uint32_t disturbs);

/* The bus is loaded, cut or shared with another sender, or was lately. */
bool facts_bus_disturbed(const observation_t *seen);

/* Neither a fault nor a disturbed bus. */
bool facts_undisturbed(const observation_t *seen);

/* A line of safe torque off is not energised. */
bool facts_sto_demanded(const observation_t *seen, uint64_t time_us);

/* The event is a load that steps or ramps; that swings. */
bool facts_is_load(const world_event_t *event);
bool facts_is_load_sine(const world_event_t *event);

/* A load drives the machine in the direction of a speed at any time. */
bool facts_overhauled(const observation_t *seen, double speed);

/* Bit of each phase with a fault of its own in the last quarter of a second: its current is not the drive's alone. */
unsigned facts_phases_at_fault(const observation_t *seen, uint64_t now_us);

/* Frames of the only sender, sent once more while it is silent, are its frames: nothing but the arming tells them. */
bool facts_impersonated(const observation_t *seen);

/* --- The drive --- */

/* Torque of both signs in both directions, by a torque sharing function; otherwise one quadrant. */
bool facts_four_quadrants(const observation_t *seen);

/* The state of the drive, or what it takes for it, was changed from outside. */
bool facts_state_changed(const observation_t *seen);

/* Late or lost interrupts and a background without time: what is checked is checked late. */
bool facts_checks_late(const observation_t *seen);

/* That, or memory or clock of the drive was changed. */
bool facts_drive_disturbed(const observation_t *seen);

/* Frames on the bus may not have reached the drive, or not in time. */
bool facts_may_be_deaf(const observation_t *seen);

/* A bus-off since the last arming may have disarmed the drive: then a request to run is off, and before that it has no
 * effect. */
bool facts_may_be_unarmed(const observation_t *seen);

/* A drive with degraded running has had a fault of a phase and goes on with the others, also after the fault's end,
 * until the client clears it: there are angles at which it has no torque. */
bool facts_may_be_degraded(const observation_t *seen);

/* The frames of the drive are of the present: neither disturbed nor older than a reset. */
bool facts_frames_are_current(const observation_t *seen);

/* The drive can observe the speed. A shaft that is stopped at once stands before it does; and its observer goes by the
 * torque of the measured currents. */
bool facts_speed_is_observed(const observation_t *seen);

/* The commanded speed is one that the drive turns at. */
bool facts_can_turn(const observation_t *seen);

/* The drive runs by a command to turn at such a speed. */
bool facts_runs_by_speed(const observation_t *seen);

/* The client has been heard within the time after which the torque ramps to zero, and its request has an effect. */
bool facts_heard(const observation_t *seen);

/* The drive hears a command to turn at a speed that is not near zero. */
bool facts_pushed(const observation_t *seen);

/* A frame may wait in the drive for its background, at most for the watchdog's 18 ms: this time later. */
uint64_t facts_request_max_ns(const observation_t *seen, uint64_t max_ns);

/* --- Positions --- */

/* Neither a fault of the bench, nor another sender, nor a reset, at any time. */
bool facts_untouched(const observation_t *seen);

/* True position as the drive counts it without a homing, revolutions. */
double facts_position_rev(const observation_t *seen);

/* A count of the encoder, revolutions. */
double facts_count_rev(const observation_t *seen);

/* The world has, or has had by now, an event of the kind. */
bool facts_has_event(const observation_t *seen, world_kind_t kind);
bool facts_had_event(const observation_t *seen, world_kind_t kind);

/* The load last changed, ns; 0: not yet. */
uint64_t facts_load_ns(const observation_t *seen);

/* The master chooses, or has chosen by the end of the world, a mode of CiA 402; none but modes of a list. */
bool facts_chooses_mode(const observation_t *seen, unsigned mode);

/* --- Quantities --- */

/* Rotation from a phase to the next one. */
double facts_stroke_rad(const observation_t *seen);

/* Time that a number of strokes takes at the commanded speed, which must not be zero. */
uint64_t facts_strokes_ns(const observation_t *seen, double strokes);

double facts_speed_rpm(const observation_t *seen); /* magnitude */
double facts_base_rad_s(const observation_t *seen);
double facts_largest_current_A(const observation_t *seen);
double facts_inertia_kg_m2(const observation_t *seen);

/* The torque that the drive has at least for a change of the speed, and the time that half of it needs. */
double facts_torque_max_Nm(const observation_t *seen);
double facts_needed_s(const observation_t *seen, double change_rad_s);

/* Limit of the torque in a frame DRIVE_THERMAL. */
double facts_limit_Nm(const observation_t *seen, const uint8_t data[8]);

/* Heat has left less than 0.8 of it, by telemetry. */
bool facts_derated(const observation_t *seen);

/* Fraction of the largest torque that temperatures of the hottest winding and of the hottest switch leave, 0..1. */
double facts_cool_part(double winding_C, double switch_C);

/* Both sets of a client that limits the torque are in effect. */
bool facts_sets_in_effect(const observation_t *seen);

/* Speed that a drive of one quadrant cannot take away: what the torque limit adds in three periods, while the speed is
 * observed and while the voltage removes the largest flux linkage. */
double facts_added_rad_s(const observation_t *seen);

/* Speed that the torque limit adds within a count of the encoder from rest: w^2 = 2 T / J theta. */
double facts_uncounted_rad_s(const observation_t *seen);

#endif
