/* The plant under faults (plant_faults_t): what differs from the equations in plant.h.
 *
 * Converter: a switch that is open or shorted, or a diode that is open, changes the devices that carry the current of
 * an end of the winding. Where neither switch nor diode can, the opening switch does in avalanche, with a drop of
 * FAULTED_BREAKDOWN supply voltages.
 *
 * Winding to earth: the negative rail is earthed, too, so that a current of the lower end flows there while the lower
 * switch is off; a switch that is on carries all of it.
 *
 * Open winding: the break is an arc of constant voltage, FAULTED_BREAKDOWN supply voltages, until the current has
 * ended.
 *
 * Shorted turns: a fraction k of the turns is a loop of its own with the resistance k R, coupled with the others
 * without leakage. With the loop's current i_s and the current i of the terminals, the magnetomotive force is as if
 * i_m = (1 - k) i + k i_s flowed in all turns, for which the magnetics hold: psi = psi(theta, i_m), and
 *
 *   v = (1 - k) R i + (1 - k) d psi / dt,   0 = k R i_s + k d psi / dt
 *
 * from which follow, with v = s Vdc - V - r i of the devices and q = 1 / (1 + r k / (R (1 - k))),
 *
 *   d psi / dt = q (s Vdc - V) - q (R + r / (1 - k)) i_m,   i = i_m / (1 - k) + k / (R (1 - k)) d psi / dt
 *
 * When no current flows at the terminals: d psi / dt = -R / k i_m. plant_t.current_A is i_m; plant_current_A gives i.
 *
 * Friction: Coulomb friction opposes the motion; at rest it and the static friction hold the shaft up to the larger of
 * the two. Break-away is found at the start of an integration step. Neither acts while a dynamometer holds the shaft.
 */
#ifndef PLANT_FAULTED_H
#define PLANT_FAULTED_H

#include "plant/integrator.h"
#include "plant/plant_state.h"

#define FAULTED_BREAKDOWN 2.0 /* of an avalanche and of an arc, in supply voltages of the machine file */

/* Lists the conducting phases and their devices. */
void faulted_find_conducting(plant_t *plant, integrator_setting_t *setting);

/* Adds the friction of the shaft to a setting whose other members are known. */
void faulted_find_friction(plant_t *plant, integrator_setting_t *setting);

/* Distance of a state from the next event that only faults and coupled phases have: end or beginning of conduction of a
 * phase with shorted turns or eddy currents (A), or of an open phase of a coupled machine (V), standstill of a shaft
 * with friction (rad/s). Negative: past the event. */
double faulted_distance_to_event(const integrator_setting_t *setting, const integrator_state_t *state);

/* Distance of a state from a comparator's response, of the currents at the terminals; negative: past it. */
double faulted_distance_to_trip(const integrator_setting_t *setting, const integrator_state_t *state);

/* Adds the energies of a step of the half bridges, the windings and the friction. */
void faulted_add_energies(plant_t *plant, const integrator_setting_t *setting, const integrator_integrals_t *integrals,
                          double step_s);

/* Shortest time constant that faults add; infinite without one. */
double faulted_time_constant_s(const plant_t *plant);

#endif
