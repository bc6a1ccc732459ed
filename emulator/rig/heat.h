/* Temperatures of the windings and of the switches of each phase, and their sensors.
 *
 * Each is one lumped body, with the losses of the plant in its phase (copper; devices of the half bridge):
 *
 *   C dT / dt = P - (T - T_ambient) / R        C, R: thermal_data_t, of the machine file
 *
 * in explicit steps of a millisecond and at most a control period more, whose energies are exact. A body may be held at
 * a temperature instead. The resistance of a winding in the plant follows its temperature when that has changed by
 * 1 K, which is 0.4 % of the resistance: a run that heats its windings by less is that of a constant resistance.
 *
 * A sensor has the temperature of its body at the end of the step, and the line of hal_adc.h at 12 bits.
 */
#ifndef RIG_HEAT_H
#define RIG_HEAT_H

#include "rig/rig.h"

/* Every body at ambient temperature. */
void heat_init(rig_t *rig);

/* Takes a step when a millisecond has passed since the last one, at the time of the plant. */
void heat_step(rig_t *rig);

/* Temperature of the hottest winding and of the hottest switches. */
double heat_winding_C(const rig_t *rig);
double heat_inverter_C(const rig_t *rig);

#endif
