/* The emulated drive train: DC link, asymmetric half bridges, switched reluctance machine, shaft.
 *
 * Equations, for each phase j (sources: T. J. E. Miller, "Switched Reluctance Motors and their Control", 1993; the
 * magnetics are magnetics.h's):
 *
 *   d psi_j / dt = v_j - R i_j      with psi_j = psi(theta - j pitch / phases, i_j)
 *   J d omega / dt = sum T_j - B omega - T_load,   d theta / dt = omega
 *   v_j = s_j Vdc - the drops of the two devices that carry the current; s_j = +1 with both switches on (two switches),
 *     0 with one (a switch and a diode), -1 with none (two diodes); a device drops V + r i (machine.h). A phase without
 *     current that is not driven by a positive v_j is open (its diodes block) and stays at exactly 0 A.
 *   C d Vdc / dt = max(0, (Vs - Vdc) / Rs) - sum s_j i_j - Vdc / Rc while the brake chopper is on. Without a
 *     capacitor Vdc = Vs, the supply takes energy back.
 *
 * Signs: angle and speed rise in the forward direction, motoring torque is positive; load torque is positive against
 * the forward direction and does not depend on the speed (it can drive the shaft backwards). Phase 0 is aligned at
 * rotor angle 0. Phase current is never negative. The link's current is positive out of the link.
 *
 * Left out, on purpose: mutual coupling of the phases and end effects; iron loss, hysteresis and eddy currents in the
 * machine, skin effect, temperature; switching times and losses of the devices (dead time has no place in these
 * bridges: their two switches are in series with the winding), inductance of the link, ripple of the supply's
 * rectifier; a rigid shaft without static friction. DC link: the supply conducts in one direction only, a capacitor
 * has no series resistance.
 *
 * Integration: integrator.h, in the currents, speed, angle and bus voltage together. Steps end at every switch edge
 * (whole nanoseconds), at the instants a diode, the supply or the chopper begins or ends to conduct (found to less than
 * a picosecond) and where the magnetics are not smooth; in between their length is limited as plant_set_step_factor
 * says.
 */
#ifndef PLANT_PLANT_H
#define PLANT_PLANT_H

#include <stdbool.h>
#include <stdint.h>

#include "hal.h"
#include "hal_pwm.h"
#include "plant/half_bridge.h"
#include "plant/machine.h"
#include "plant/magnetics.h"

struct plant;
typedef void (*plant_sample_t)(void *context, const struct plant *plant);

/* The machine's deviations from its file, as factors; 1 is as in the file. */
typedef struct {
    double flux_linkage; /* > 0: flux linkage and torque of every phase at the same angle and current */
    double resistance;   /* > 0: of the windings */
    double inertia;      /* > 0 */
    double friction;     /* >= 0 */
} plant_gains_t;

typedef struct plant {
    /* State, valid at time_ns; read freely. */
    uint64_t time_ns;
    double speed_rad_s;
    double rotor_angle_rad; /* unwrapped */
    double current_A[HAL_PHASES_MAX];
    double bus_voltage_V;
    bool chopper_on;

    /* Inputs; write at any time. The load acts from time_ns, the pulse from the next plant_set_switches. */
    double load_torque_Nm;
    double minimum_pulse_ns;

    plant_gains_t gains; /* read; plant_set_gains changes them */

    /* Energy since plant_init. At every instant, with the changes of the energies that are stored:
     * drawn - returned = copper + converter + load + friction
     *                    + change of plant_field_energy_J + change of plant_kinetic_energy_J
     * supplied = source + chopper + drawn - returned + change of plant_link_energy_J, with a capacitor
     */
    double energy_drawn_J;     /* from the link, both switches on */
    double energy_returned_J;  /* to the link, both switches off */
    double energy_copper_J;    /* in the windings */
    double energy_converter_J; /* in the half bridges' devices */
    double energy_load_J;      /* work done on the load */
    double energy_friction_J;
    double energy_supplied_J; /* by the source; this and the next two only with a capacitor */
    double energy_source_J;   /* in the source's resistance */
    double energy_chopper_J;

    /* The rest is plant.c's. */
    const machine_t *machine;
    magnetics_model_t magnetics;
    double winding_ohm, inertia_kg_m2, friction_Nm_s;
    double phase_offset_rad;
    double drop_V[3], resistance_ohm[3]; /* of a phase with so many switches on, its winding in it */
    double step_factor, step_max_s, step_current_A, step_angle_rad;
    double smooth_from_rad, smooth_to_rad;
    double supply_voltage_V;
    half_bridge_switches_t switches;
    half_bridge_pattern_t pattern;
    unsigned edge_next;
    plant_sample_t sample;
    void *sample_context;
    uint64_t sample_next_ns, sample_step_ns;
} plant_t;

/* A machine at rest at time 0: no current, all switches open, bus at its supply voltage, no load. `machine` must
 * outlive the plant. */
void plant_init(plant_t *plant, const machine_t *machine, double initial_angle_rad);

/* The supply's voltage (>= 0) from now on: the bus voltage itself without a capacitor. */
void plant_set_supply_voltage(plant_t *plant, double voltage_V);

/* The machine is another one from now on. Angle, speed and currents stay, so the energies of fields and rotor jump by
 * what the change makes of them, and no other term of the ledger takes note: it balances over times without a change.
 */
void plant_set_gains(plant_t *plant, const plant_gains_t *gains);

/* A new control period starts now (time_ns): the switches follow `compare` as half_bridge.h says, for
 * 2 * period_ticks timer ticks. After that they stay as they are at the period's end until set again.
 * period_ticks > 0. */
void plant_set_switches(plant_t *plant, const hal_pwm_compare_t *compare, uint16_t period_ticks);

/* Opens all switches from now on, and forgets the edges still to come. */
void plant_open_all(plant_t *plant);

/* Advances to exactly to_ns; does nothing when that is not in the future. An advance that ends
 * within a period cuts a step in two and so changes the last bits of what follows; plant_observe does not. */
void plant_advance(plant_t *plant, uint64_t to_ns);

/* Calls sample(context, plant) at exactly first_ns + n * step_ns, n = 0, 1, ..., while plant_advance passes them, with
 * the state of that instant (the energies are those of the step's start). An instant at the end of an advance belongs
 * to it. Watching does not change a bit of what is watched: the samples are interpolated (cubic Hermite) within the
 * steps. first_ns in the past is taken as the next instant of that grid. step_ns 0 ends it. */
void plant_observe(plant_t *plant, uint64_t first_ns, uint64_t step_ns, plant_sample_t sample, void *context);

/* Scales every limit of the step length; 1 (default) is the documented accuracy, smaller is finer. > 0. */
void plant_set_step_factor(plant_t *plant, double factor);

/* Electromagnetic torque of all phases now. */
double plant_torque_Nm(const plant_t *plant);

/* Mechanical angle that a phase sees now: 0 (and every pitch) aligned, not wrapped. */
double plant_phase_angle_rad(const plant_t *plant, unsigned phase);

/* Flux linkage of one phase now. */
double plant_flux_linkage_Wb(const plant_t *plant, unsigned phase);

/* Energy stored in the fields of all phases, and in the moving rotor, now. */
double plant_field_energy_J(const plant_t *plant);
double plant_kinetic_energy_J(const plant_t *plant);

/* Energy stored in the link's capacitor now; 0 without one. */
double plant_link_energy_J(const plant_t *plant);

#endif
