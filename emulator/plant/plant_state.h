/* State of the plant, and the quantities that follow from it at its present time. plant.h has the equations. */
#ifndef PLANT_PLANT_STATE_H
#define PLANT_PLANT_STATE_H

#include <stdbool.h>
#include <stdint.h>

#include "hal.h"
#include "hal_pwm.h"
#include "plant/half_bridge.h"
#include "plant/machine.h"
#include "plant/magnetics.h"
#include "plant/smooth_range.h"

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
    double sign, device_V, device_ohm, breakdown_V; /* s; V and r without the breakdown of arc and avalanche */
} plant_path_t;

/* State of a phase between the steps of phase_steps.h. */
typedef struct {
    bool known; /* the magnetics at this current and angle are in `point` */
    double current_A, angle_rad;
    double flux_Wb, inverse_1_H; /* flux linkage; inverse of the incremental inductance */
    magnetics_point_t point;
    smooth_range_t smooth; /* of the rotor, in which its magnetics are smooth */
} plant_phase_t;

/* The machine's circuit_t, prepared; coupled.h has the equations. */
typedef struct {
    bool present; /* any of it */
    bool mutual;  /* a coupling is not 0 */
    unsigned phases;
    double share[HAL_PHASES_MAX][HAL_PHASES_MAX]; /* of the current of a phase [1] on the poles of a phase [0] */
    double gain[HAL_PHASES_MAX];                  /* flux linkage */
    double offset_rad[HAL_PHASES_MAX];            /* position of each phase's aligned angle */
    double eddy_S;
} coupled_t;

/* Limits of the length of a step at the present step factor. */
typedef struct {
    double factor;                  /* plant_set_step_factor */
    double own_max_s, common_max_s; /* of the rotor's step in phase_steps.h, of a step in common_steps.h */
    double current_A, angle_rad;    /* changes in a common step */
    double link_swing_s2_H;         /* of a step of a phase on a DC link: its square by the incremental inductance */
} plant_limits_t;

/* Compare values behind the patterns of the phases. */
typedef struct {
    hal_pwm_compare_t compare;
    uint16_t period_ticks; /* 0: of none */
    double minimum_pulse_ns;
    uint32_t shortest_ticks; /* of that pulse */
} plant_pattern_source_t;

/* plant_observe. */
typedef struct {
    plant_sample_t sample; /* NULL: none */
    void *context;
    uint64_t next_ns, step_ns;
} plant_observation_t;

typedef struct plant {
    /* State at time_ns; read only. */
    uint64_t time_ns;
    double speed_rad_s;
    double rotor_angle_rad;           /* unwrapped */
    double current_A[HAL_PHASES_MAX]; /* with shorted turns or eddy currents: plant_current_A */
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
     * drawn - returned = copper + converter + iron + load + friction + fault
     *                    + change of plant_field_energy_J + change of plant_kinetic_energy_J
     * supplied = source + chopper + drawn - returned + change of plant_link_energy_J (with a capacitor)
     */
    double energy_drawn_J;     /* from the link, both switches on */
    double energy_returned_J;  /* to the link, both switches off */
    double energy_copper_J;    /* in the windings */
    double energy_converter_J; /* in the half bridges' devices */
    double energy_iron_J;      /* by eddy currents */
    double energy_load_J;      /* work done on the load and the dynamometer */
    double energy_friction_J;
    double energy_fault_J;    /* in arcs and avalanches, and in a shaft that is locked */
    double energy_supplied_J; /* by the source; this and the next two with a capacitor only */
    double energy_source_J;   /* in the source's resistance */
    double energy_chopper_J;
    double phase_copper_J[HAL_PHASES_MAX], phase_converter_J[HAL_PHASES_MAX]; /* parts of energy_copper_J and
                                                                                 energy_converter_J */

    /* Private to the plant's files. */
    const machine_t *machine;
    magnetics_model_t magnetics;
    double winding_gain[HAL_PHASES_MAX], winding_ohm[HAL_PHASES_MAX]; /* gain: by temperature */
    double inertia_kg_m2, friction_Nm_s;
    double phase_offset_rad;
    double drop_V[3];                         /* of the devices, by the number of switches that are on */
    double resistance_ohm[HAL_PHASES_MAX][3]; /* of winding and devices, likewise */
    plant_limits_t limits;
    smooth_range_t smooth; /* of the rotor, in which the magnetics of all phases are smooth */
    double supply_voltage_V;
    bool held; /* plant_hold */
    double held_acceleration_rad_s2;
    bool faulted; /* any of `faults` or of `coupled`: all phases step together */
    coupled_t coupled;
    plant_path_t path[HAL_PHASES_MAX];
    half_bridge_pattern_t pattern[HAL_PHASES_MAX]; /* of the control period that began at pattern_ns */
    uint64_t pattern_ns;
    plant_pattern_source_t pattern_source;
    uint8_t edge_next[HAL_PHASES_MAX];
    plant_phase_t phase[HAL_PHASES_MAX];
    double trip_current_A; /* plant_set_trip */
    uint64_t trip_ns;      /* time at which the switches open, after a comparator's response; UINT64_MAX: none */
    plant_observation_t observation;
} plant_t;

/* Current at the terminals of a phase. */
double plant_current_A(const plant_t *plant, unsigned phase);

/* Electromagnetic torque, sum of all phases. */
double plant_torque_Nm(const plant_t *plant);

/* Torque that the shaft takes, as a torque transducer on it shows: the torque of the load and of a dynamometer. */
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

/* The DC link has a capacitor: its voltage is a state. */
static inline bool plant_has_link(const plant_t *plant) {
    return plant->machine->dc_link.capacitance_F > 0.0;
}

/* The phase has shorted turns or eddy currents: its current_A is not the terminals'. */
static inline bool plant_has_loop(const plant_t *plant, unsigned phase) {
    return plant->faults.shorted_turns[phase] > 0.0 || plant->coupled.eddy_S > 0.0;
}

/* Current at the terminals of a phase with faults, by the current of its turns. */
static inline double plant_path_terminal_A(const plant_path_t *path, double bus_voltage_V, double current_A) {
    const double flux_rate_V = path->link_gain * bus_voltage_V - path->drop_V - path->resistance_ohm * current_A;
    return path->terminal_gain * current_A + path->terminal_S * flux_rate_V;
}

/* Takes the sample that is due at time_ns. */
static inline void plant_take_sample(plant_t *plant) {
    plant->observation.next_ns += plant->observation.step_ns;
    plant->observation.sample(plant->observation.context, plant);
}

#endif
