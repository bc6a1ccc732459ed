/* Mutual coupling of the phases, eddy currents and spread of the phases: what the magnetics of one phase leave out, by
 * the machine file's tables [coupling], [eddy_current] and [spread] (circuit_t).
 *
 * Coupling: the poles of phase j are magnetised by its own current and by a share of its neighbours',
 *
 *   u_j = i_j + k_j i_(j+1) + k_(j-1) i_(j-1)
 *
 * and the co-energy of the machine is the sum of the co-energies of the poles, W = sum W_j(theta_j, u_j). Hence
 *
 *   psi_j = psi(theta_j, u_j) + k_j psi(theta_(j+1), u_(j+1)) + k_(j-1) psi(theta_(j-1), u_(j-1)),   T = sum T_j
 *
 * For a linear machine the mutual inductance is k (L_j + L_(j+1)). It saturates with the poles. The form is reciprocal,
 * and because W is convex in the currents the field stores energy at any currents, if the shares alone are positive
 * definite (the machine file is checked). A constant mutual inductance would exceed the incremental inductances of
 * saturated poles and make the field a source. A phase measured alone has k^2 of its neighbours' inductance
 * more than the file. The magnetics are odd in u: psi(-u) = -psi(u).
 *
 * Eddy currents: a short-circuited loop of conductance G around the poles of each phase, of as many turns:
 *
 *   u_j = ... with i_j less G d psi_j / dt: the current of the terminals is i = i_j + G d psi_j / dt
 *
 * the same equations as shorted turns (faulted.h), and both may be present. A winding that is open has
 * d psi_j / dt = -i_j / G. plant_t.current_A is i_j. In a coupled machine the loops of open phases carry what the
 * neighbours induce, of either sign.
 *
 * Spread: gain of the flux linkage and position of the aligned angle of each phase.
 *
 * An open winding without eddy currents or shorted turns begins to conduct where the voltage that its converter would
 * apply exceeds the induced one. */
#ifndef PLANT_COUPLED_H
#define PLANT_COUPLED_H

#include "plant/integrator.h"
#include "plant/plant_state.h"

/* Prepares the machine's circuit_t. */
void coupled_prepare(coupled_t *coupled, const machine_t *machine, double pitch_rad);

/* Magnetomotive force of the poles of a phase, per turn, by the currents of all phases. */
double coupled_mmf_A(const coupled_t *coupled, const double current_A[HAL_PHASES_MAX], unsigned phase);

/* Magnetics of the poles of a phase at a magnetomotive force of either sign. */
void coupled_evaluate(const magnetics_model_t *model, const coupled_t *coupled, double rotor_angle_rad, unsigned phase,
                      double mmf_A, double ahead_rad, magnetics_point_t *point);

/* Longest step with eddy currents of open windings; infinite without. */
double coupled_loop_step_s(const plant_t *plant, const integrator_setting_t *setting);

/* Time from the present state, where the derivatives are `first`, to the next reversal of a magnetomotive force, to
 * second order; infinite without. */
double coupled_reversal_s(const plant_t *plant, const integrator_setting_t *setting,
                          const integrator_derivative_t *first);

/* integrator_differentiate for a setting with `coupled`. */
void coupled_differentiate(const integrator_setting_t *setting, const integrator_state_t *state,
                           integrator_derivative_t *derivative);

/* Voltage of an open phase of the setting, `open[index]`, above the one at which it would conduct; negative: it
 * conducts. */
double coupled_blocking_V(const integrator_setting_t *setting, const integrator_state_t *state,
                          const integrator_derivative_t *derivative, unsigned index);

#endif
