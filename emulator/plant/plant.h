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
 * Deliberately not modelled: mutual coupling of the phases and end effects; iron loss, hysteresis and eddy currents in
 * the machine, skin effect, temperature; switching times and losses of the devices (these bridges need no dead time:
 * their two switches are in series with the winding), inductance of the DC link, ripple of the supply's rectifier,
 * series resistance of the capacitor; elasticity of the shaft. Faults, friction at rest among them, change these
 * equations as faulted.h states.
 *
 * Integration: phase_steps.h, where every phase has steps of its own; with faults, and where a
 * comparator responds, integrator.h, for currents, speed, angle and DC-link voltage together. Steps end at switching
 * edges (whole nanoseconds), at the times at which a diode, the supply or the chopper starts or stops conducting or a
 * comparator responds (located within a picosecond) and where the magnetics are not smooth; plant_set_step_factor
 * scales the other limits of their length.
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

/* Response of comparator, filter and gate driver. */
#define PLANT_TRIP_RESPONSE_NS 1000

/* A freewheeling current decays exponentially; below this it counts as zero. */
#define PLANT_CURRENT_NEGLIGIBLE_A 1e-9

/* Temperature of the winding that the resistance of a machine file is for. */
#define PLANT_RESISTANCE_C 25.0

struct plant;
typedef void (*plant_sample_t)(void *context, const struct plant *plant);

/* Factors on the values of the machine file. */
typedef struct {
    double flux_linkage; /* > 0: flux linkage and torque of every phase at the same angle and current */
    double resistance;   /* > 0: windings, at any temperature */
    double inertia;      /* > 0 */
    double friction;     /* >= 0 */
} plant_gains_t;

/* Faults of converter, machine and shaft; all zero: none. The equations are in faulted.h. Bit j is phase j. */
typedef struct {
    uint8_t winding_open;
    half_bridge_switches_t switch_open, switch_shorted; /* a shorted switch conducts even when it is open as well */
    half_bridge_switches_t diode_open; /* upper: to the positive rail, from the winding's lower end; lower: from the
                                          negative rail to its upper end */
    bool chopper_open;
    double shorted_turns[HAL_PHASES_MAX]; /* fraction of the turns of a phase, 0..0.5 */
    double coulomb_Nm, static_Nm;         /* friction torques, >= 0 */
    double earth_ohm[HAL_PHASES_MAX];     /* of the lower end of a winding to the negative rail; 0: none */
} plant_faults_t;

/* How a phase of a plant with faults carries its current: a row of the equations in faulted.h. */
typedef struct {
    double link_gain, drop_V, resistance_ohm;       /* of the flux rate: q s, q V, q (R + r / (1 - k)) */
    double terminal_gain, terminal_S;               /* of the terminals' current: by i_m, by the flux rate */
    double sign, device_V, device_ohm, breakdown_V; /* s; V and r without the breakdown, that of arc and avalanche */
} plant_path_t;

/* What phase_steps.h keeps of a phase from step to step. */
typedef struct {
    bool known; /* the magnetics at this current and angle are in `point` */
    double current_A, angle_rad;
    double flux_Wb, inverse_1_H; /* flux linkage; inverse of the incremental inductance */
    magnetics_point_t point;
    double smooth_from_rad, smooth_to_rad; /* angles of the rotor between which its magnetics are smooth */
} plant_phase_t;

typedef struct plant {
    /* State at time_ns; read only. */
    uint64_t time_ns;
    double speed_rad_s;
    double rotor_angle_rad;           /* unwrapped */
    double current_A[HAL_PHASES_MAX]; /* with shorted turns: plant_current_A */
    double bus_voltage_V;
    uint8_t switches[HAL_PHASES_MAX]; /* that are on: HALF_BRIDGE_UPPER, HALF_BRIDGE_LOWER */
    bool chopper_on;
    bool tripped; /* the comparators have opened the switches since plant_clear_trip */

    /* Inputs; write at any time. The load torque acts from time_ns, the minimum pulse from the next plant_set_switches.
     */
    double load_torque_Nm;
    double minimum_pulse_ns;

    plant_gains_t gains;   /* read only; plant_set_gains changes them */
    plant_faults_t faults; /* read only; plant_set_faults changes them */

    /* Energies since plant_init. Energy balance at every instant:
     * drawn - returned = copper + converter + load + friction + fault
     *                    + change of plant_field_energy_J + change of plant_kinetic_energy_J
     * supplied = source + chopper + drawn - returned + change of plant_link_energy_J (with a capacitor)
     */
    double energy_drawn_J;     /* from the link, both switches on */
    double energy_returned_J;  /* to the link, both switches off */
    double energy_copper_J;    /* in the windings */
    double energy_converter_J; /* in the half bridges' devices */
    double energy_load_J;      /* work done on the load and the dynamometer */
    double energy_friction_J;
    double energy_fault_J;    /* in arcs and avalanches, and in a shaft that is locked */
    double energy_supplied_J; /* by the source; this and the next two with a capacitor only */
    double energy_source_J;   /* in the source's resistance */
    double energy_chopper_J;
    double phase_copper_J[HAL_PHASES_MAX], phase_converter_J[HAL_PHASES_MAX]; /* parts of energy_copper_J and
                                                                                 energy_converter_J */

    /* Private to plant.c and the steps of the phases (phase_steps.h). */
    const machine_t *machine;
    magnetics_model_t magnetics;
    double winding_gain[HAL_PHASES_MAX], winding_ohm[HAL_PHASES_MAX]; /* gain: by temperature */
    double inertia_kg_m2, friction_Nm_s;
    double phase_offset_rad;
    double drop_V[3];                         /* of the devices, by the number of switches that are on */
    double resistance_ohm[HAL_PHASES_MAX][3]; /* of winding and devices, likewise */
    double step_factor, step_max_s, together_step_max_s, step_current_A, step_angle_rad;
    double link_swing_s2_H; /* limit of a step of a phase on a DC link: its square by the incremental inductance */
    double smooth_from_rad, smooth_to_rad;
    double supply_voltage_V;
    bool held; /* plant_hold */
    double held_acceleration_rad_s2;
    bool faulted; /* any of `faults` */
    plant_path_t path[HAL_PHASES_MAX];
    half_bridge_pattern_t pattern[HAL_PHASES_MAX]; /* of the control period that began at pattern_ns */
    uint64_t pattern_ns;
    hal_pwm_compare_t pattern_compare; /* of which `pattern` is; with a period of 0 ticks: none */
    uint16_t pattern_period_ticks;
    double pattern_minimum_pulse_ns;
    uint32_t shortest_ticks; /* of that pulse */
    uint8_t edge_next[HAL_PHASES_MAX];
    plant_phase_t phase[HAL_PHASES_MAX];
    double trip_current_A; /* plant_set_trip */
    uint64_t trip_ns;      /* time at which the switches open, after a comparator's response; UINT64_MAX: none */
    plant_sample_t sample;
    void *sample_context;
    uint64_t sample_next_ns, sample_step_ns;
} plant_t;

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

/* Sets the temperatures of the windings from time_ns on: the resistance of copper at T is that of the machine file, at
 * PLANT_RESISTANCE_C, times (235 C + T) / (235 C + PLANT_RESISTANCE_C) (IEC 60034-1, 8.6.2.3.3). T > -235 C; plant_init
 * sets PLANT_RESISTANCE_C. */
void plant_set_winding_temperatures(plant_t *plant, const double temperature_C[HAL_PHASES_MAX]);

/* Changes the faults from time_ns on. Currents (with shorted turns: magnetomotive forces) continue unchanged. */
void plant_set_faults(plant_t *plant, const plant_faults_t *faults);

/* Starts a control period at time_ns: the switches follow `compare` (half_bridge.h) for 2 * period_ticks timer ticks
 * and then keep their states until the next call. period_ticks > 0. */
void plant_set_switches(plant_t *plant, const hal_pwm_compare_t *compare, uint16_t period_ticks);

/* Switches follow the edges up to time_ns; returns the time of the next one, at most to_ns. */
uint64_t plant_follow_edges(plant_t *plant, uint64_t to_ns);

/* Opens all switches at time_ns and discards the pending edges. */
void plant_open_all(plant_t *plant);

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

/* Current at the terminals of a phase. */
double plant_current_A(const plant_t *plant, unsigned phase);

/* Electromagnetic torque, sum of all phases. */
double plant_torque_Nm(const plant_t *plant);

/* Torque that the shaft takes, as a torque transducer on it shows: that of the load and of a dynamometer. */
double plant_shaft_torque_Nm(const plant_t *plant);

/* Mechanical angle relative to the aligned position of a phase (0 and every pole pitch), not wrapped. */
double plant_phase_angle_rad(const plant_t *plant, unsigned phase);

/* Flux linkage of one phase. */
double plant_flux_linkage_Wb(const plant_t *plant, unsigned phase);

/* Magnetic energy stored in all phases, and kinetic energy of the rotor. */
double plant_field_energy_J(const plant_t *plant);
double plant_kinetic_energy_J(const plant_t *plant);

/* Energy stored in the DC-link capacitor; 0 without one. */
double plant_link_energy_J(const plant_t *plant);

#endif
