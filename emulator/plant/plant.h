/* The emulated drive train: switched reluctance machine, asymmetric half bridges, shaft.
 *
 * Equations, for each phase j (sources: T. J. E. Miller, "Switched Reluctance Motors and their Control", 1993; the
 * magnetics are magnetics.h's):
 *
 *   d psi_j / dt = v_j - R i_j      with psi_j = psi(theta - j pitch / phases, i_j)
 *   J d omega / dt = sum T_j - B omega - T_load,   d theta / dt = omega
 *   v_j = +Vdc with both switches on, 0 with one, -Vdc with none while current flows; a phase without current and
 *   without positive voltage is open (its diodes block) and stays at exactly 0 A
 *
 * Signs: angle and speed rise in the forward direction, motoring torque is positive; load torque is positive against
 * the forward direction and does not depend on the speed (it can drive the shaft backwards). Phase 0 is aligned at
 * rotor angle 0. Phase current is never negative.
 *
 * Left out, on purpose: mutual coupling of the phases, end effects, iron loss, hysteresis, temperature; ideal switches
 * and diodes (no drop, no dead time, no switching time); an ideal supply that takes energy back; a rigid shaft without
 * static friction.
 *
 * Integration: Runge-Kutta of fourth order in the currents, speed and angle together. Steps end at every switch edge
 * (whole nanoseconds), at the instant a diode stops conducting (found to less than a picosecond) and where the
 * magnetics are not smooth; in between their length is limited as plant_set_step_factor says.
 */
#ifndef PLANT_PLANT_H
#define PLANT_PLANT_H

#include <stdint.h>

#include "hal.h"
#include "hal_pwm.h"
#include "plant/machine.h"
#include "plant/magnetics.h"

#define PLANT_EDGES_MAX (4 * HAL_PHASES_MAX)

/* Switches that are on from some instant; bit j is phase j. */
typedef struct {
    uint8_t upper;
    uint8_t lower;
} plant_switches_t;

typedef struct {
    uint64_t time_ns;
    plant_switches_t switches; /* from this instant */
} plant_edge_t;

struct plant;
typedef void (*plant_sample_t)(void *context, const struct plant *plant);

typedef struct plant {
    /* State, valid at time_ns; read freely. */
    uint64_t time_ns;
    double speed_rad_s;
    double rotor_angle_rad; /* unwrapped */
    double current_A[HAL_PHASES_MAX];

    /* Inputs; write at any time, they act from time_ns. */
    double load_torque_Nm;
    double bus_voltage_V; /* >= 0 */

    /* Energy since plant_init. At every instant, with the change of field and kinetic energy:
     * drawn - returned = copper + load + friction + change of plant_field_energy_J + change of plant_kinetic_energy_J
     */
    double energy_drawn_J;    /* from the link, both switches on */
    double energy_returned_J; /* to the link, both switches off */
    double energy_copper_J;
    double energy_converter_J; /* in the half bridges' devices */
    double energy_load_J;      /* work done on the load */
    double energy_friction_J;

    /* The rest is plant.c's. */
    const machine_t *machine;
    magnetics_model_t magnetics;
    double phase_offset_rad;
    double step_max_s, step_current_A, step_angle_rad;
    double smooth_from_rad, smooth_to_rad;
    plant_switches_t switches;
    unsigned edge_count, edge_next;
    plant_edge_t edges[PLANT_EDGES_MAX];
    plant_sample_t sample;
    void *sample_context;
    uint64_t sample_next_ns, sample_step_ns;
} plant_t;

/* A machine at rest at time 0: no current, all switches open, bus at its supply voltage, no load. `machine` must
 * outlive the plant. */
void plant_init(plant_t *plant, const machine_t *machine, double initial_angle_rad);

/* A new control period starts now (time_ns): the switches follow `compare` as hal_pwm.h says, edges exact to the
 * nanosecond, for 2 * period_ticks timer ticks. After that they stay as they are at the period's end until set again.
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

#endif
