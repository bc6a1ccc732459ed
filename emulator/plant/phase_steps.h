/* Steps of the plant in which every phase has steps of its own: for a plant without faults.
 *
 * A phase's steps end at its own switching edges instead of every phase's, and each evaluates its magnetics once
 * (integrator.h: all conducting phases, twice). The rotor's step reaches over all of them, as far as the limits of
 * its angle allow; usually it is a control period:
 *
 * 1. The angle is predicted by a cubic, from speed, acceleration and jerk at the start.
 * 2. Each phase is integrated along it. Its state is the flux linkage, which follows from the voltage alone:
 *
 *      psi1 = psi0 + v h - R q,   q = h/2 (i0 + i1) + h^2/12 (i0' - i1')            (cubic Hermite, order 4)
 *
 *    and i1 is the current of psi1 at the predicted angle: the magnetics are evaluated at a predicted current, from
 *    which one step of Newton's method, with its second-order term, leads to i1. Impulse and first moment of the torque
 *    are integrated in the same way.
 * 3. They give speed and angle at the end. The flux linkages remain; the currents change with the angle's correction,
 *    to first order.
 *
 * A current ends where its flux linkage does, which is a scalar equation.
 *
 * There are two ways to step for the speed of the emulator. Stepped together by integrator.h, the healthy plant takes
 * 1.7 times as many instructions with the traditional controller and 3.2 times with paper and salient, whose phases
 * have edges at different times; plant, drive and bench together 1.2, 1.9 and 1.9 times (saturating machine, 40 kHz,
 * 600 r/min, 8 N m). These steps carry no faults, because they hold only where the flux linkage of a phase follows from
 * its voltage alone, at an inductance and a resistance that are its own: coupled phases (coupled.h) are tied to each
 * other, shorted turns and eddy currents tie the current of the terminals
 * to the flux rate and to the link, friction at rest stops the shaft within a step, and a comparator opens all phases
 * at an instant that is found by shortening the step of all of them.
 *
 * With a DC-link capacitor the phases step in the order of time, and its voltage between their steps: link_steps.h. */
#ifndef PLANT_PHASE_STEPS_H
#define PLANT_PHASE_STEPS_H

#include <stdbool.h>
#include <stdint.h>

#include "plant/plant_state.h"

/* Advances by one step of the rotor, to `to_ns` at most, and takes the samples within. False, and nothing changed,
 * where it does not apply: with faults, a comparator that responds, or when a phase has more
 * than PHASE_STEPS_MAX steps (phase_samples.h). */
bool phase_steps_advance(plant_t *plant, uint64_t to_ns);

/* Discards what is kept of the magnetics' last evaluations; after a change of the machine. */
void phase_steps_reset(plant_t *plant);

#endif
