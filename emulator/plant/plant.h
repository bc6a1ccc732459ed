/* Emulated drive train: DC link, asymmetric half bridges, switched reluctance machine, shaft.
 *
 * Equations, for each phase j (sources: T. J. E. Miller, "Switched Reluctance Motors and their Control", 1993;
 * magnetics: magnetics.h):
 *
 *   d psi_j / dt = v_j - R i_j      with psi_j = psi(theta - j pitch / phases, i_j)
 *   J d omega / dt = sum T_j - B omega - T_load,   d theta / dt = omega
 *     A dynamometer that holds the shaft imposes d omega / dt and takes what is missing in this equation.
 *   v_j = s_j Vdc - voltage drops of the two conducting devices; s_j = +1 with both switches on (two switches),
 *     0 with one (a switch and a diode), -1 with none (two diodes); a device drops V + r i (machine.h). A phase without
 *     current that is not driven by a positive v_j is open (its diodes block) and stays at exactly 0 A.
 *   C d Vdc / dt = max(0, (Vs - Vdc) / Rs) - sum s_j i_j - Vdc / Rc while the brake chopper is on. Without a
 *     capacitor Vdc = Vs, and the supply is bidirectional.
 *
 * Signs: angle and speed increase in the forward direction, motoring torque is positive; load torque is positive
 * against the forward direction and independent of the speed (it can drive the shaft backwards). Phase 0 is aligned at
 * rotor angle 0. Phase currents are never negative. The current of the DC link is positive out of the link.
 *
 * By the machine file: mutual coupling, eddy currents and spread of the phases, which change these equations as
 * coupled.h states.
 *
 * Deliberately not modelled: end effects; hysteresis of the iron, skin effect, temperature of the magnetics; switching
 * times and losses of the devices (these bridges need no dead time: their two switches are in series with the winding),
 * inductance of the DC link, ripple of the supply's rectifier, series resistance of the capacitor; elasticity of the
 * shaft. Faults, friction at rest among them, change these equations as faulted.h states.
 *
 * Integration: phase_steps.h, where every phase has steps of its own; with faults, and where a
 * comparator responds, common_steps.h, for currents, speed, angle and DC-link voltage together. Steps end at switching
 * edges (whole nanoseconds), at the times at which a diode, the supply or the chopper starts or stops conducting or a
 * comparator responds (located within a picosecond) and where the magnetics are not smooth; plant_set_step_factor
 * scales the other limits of their length.
 */
#ifndef PLANT_PLANT_H
#define PLANT_PLANT_H

#include <stdint.h>

#include "plant/machine.h"
#include "plant/plant_state.h"
#include "plant/plant_switches.h"

/* Initialises a machine at rest at time 0: no current, all switches open, DC link at the supply voltage, no load.
 * `machine` must outlive the plant. */
void plant_init(plant_t *plant, const machine_t *machine, double initial_angle_rad);

/* Sets the supply voltage (>= 0) from time_ns on; without a capacitor it is the DC-link voltage. */
void plant_set_supply_voltage(plant_t *plant, double voltage_V);

/* Holds the shaft by a dynamometer from time_ns on, whatever the torques: at this speed and acceleration. A speed other
 * than the present one is a jump, whose kinetic energy is not in the energy balance. */
void plant_hold(plant_t *plant, double speed_rad_s, double acceleration_rad_s2);

/* Locks the shaft at time_ns until plant_release or plant_hold: it stops, and its kinetic energy goes into the lock. */
void plant_lock(plant_t *plant);

/* Frees a held or locked shaft from time_ns on. */
void plant_release(plant_t *plant);

/* Changes the machine from time_ns on. Angle, speed and currents continue unchanged, so the energies of fields and
 * rotor jump, without a counterpart in the energy balance, which holds over intervals without such a change. */
void plant_set_gains(plant_t *plant, const plant_gains_t *gains);

/* Sets the temperatures of the windings from time_ns on: the resistance of copper at T is the machine file's, at
 * PLANT_RESISTANCE_C, times (235 C + T) / (235 C + PLANT_RESISTANCE_C) (IEC 60034-1, 8.6.2.3.3). T > -235 C; plant_init
 * sets PLANT_RESISTANCE_C. */
void plant_set_winding_temperatures(plant_t *plant, const double temperature_C[HAL_PHASES_MAX]);

/* Changes the faults from time_ns on. Currents (with shorted turns: magnetomotive forces) continue unchanged. */
void plant_set_faults(plant_t *plant, const plant_faults_t *faults);

/* Comparators of the gate drivers, from time_ns on: all switches open PLANT_TRIP_RESPONSE_NS after the current of a
 * phase with a conducting switch exceeds trip_current_A, and `tripped` is set; plant_set_switches can close them again.
 * INFINITY, after plant_init: none. */
void plant_set_trip(plant_t *plant, double trip_current_A);

/* Resets `tripped`; the comparators act again. */
void plant_clear_trip(plant_t *plant);

/* Advances to exactly to_ns; does nothing when that is not in the future. An advance that ends within a period splits a
 * step and thereby changes the last bits of all later results; plant_observe does not. */
void plant_advance(plant_t *plant, uint64_t to_ns);

/* Calls sample(context, plant) at exactly first_ns + n * step_ns, n = 0, 1, ..., while plant_advance passes them, with
 * the state of that instant (the energies are those at the start of the integration step). An instant at the end of an
 * advance belongs to it. Observation changes no bit of the state: samples are interpolated (cubic Hermite) within the
 * steps. If first_ns is in the past, sampling starts at the next instant of that grid. step_ns 0 stops the observation.
 */
void plant_observe(plant_t *plant, uint64_t first_ns, uint64_t step_ns, plant_sample_t sample, void *context);

/* Scales all limits of the step length. factor > 0: 1 (default) gives the accuracy stated in plant.c, less is finer. */
void plant_set_step_factor(plant_t *plant, double factor);

#endif
