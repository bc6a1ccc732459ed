/* Machine with converter, DC link and sensors, as defined by a machine file (tools/machines). */
#ifndef PLANT_MACHINE_H
#define PLANT_MACHINE_H

#include "plant/magnetics.h"

/* Devices of the asymmetric half bridges, all equal. All zero: ideal. */
typedef struct {
    double switch_drop_V; /* threshold voltage; the resistance is the slope */
    double switch_resistance_ohm;
    double diode_drop_V;
    double diode_resistance_ohm;
    double minimum_pulse_ns; /* shorter pulses and gaps of a switch are suppressed */
} converter_t;

/* DC link: a unidirectional supply with internal resistance, a capacitor, and a brake chopper that switches on at
 * chopper_on_V and off at chopper_off_V. */
typedef struct {
    double capacitance_F; /* 0: an ideal bidirectional supply; the other members are ignored */
    double source_resistance_ohm;
    double chopper_resistance_ohm; /* 0: no chopper */
    double chopper_on_V, chopper_off_V;
} dc_link_t;

/* Sensor errors; sensors.h applies them, and the rig can change them. */
typedef struct {
    double current_gain; /* 1 is exact */
    double current_offset_A;
    double current_noise_A; /* standard deviation */
    double current_limit_A; /* magnitude at which the sensor saturates */
    double current_delay_ns;
    double encoder_eccentricity_deg; /* amplitude of the angle error of one period per revolution, mechanical */
} sensor_errors_t;

/* Full scales of the board's analogue inputs, 2^bits counts (hal_adc.h). */
typedef struct {
    double current_A;      /* current sensors */
    double dc_link_V;      /* divider of the DC-link voltage */
    double load_torque_Nm; /* torque transducer, in either direction */
} sensor_ranges_t;

/* Heat path to the surroundings of one winding, and of the switches of one phase (rig/heat.h). */
typedef struct {
    double winding_capacity_J_K, winding_resistance_K_W;
    double inverter_capacity_J_K, inverter_resistance_K_W;
} thermal_data_t;

#define MACHINE_PHASES_MAX 6 /* as HAL_PHASES_MAX, for programs without the HAL */

/* Properties of the magnetic circuit that the magnetics of one phase leave out (coupled.h); all zero: none. */
typedef struct {
    double coupling[MACHINE_PHASES_MAX];            /* of each phase with the next one, of the last with the first */
    double eddy_conductance_S;                      /* of each phase */
    double flux_deviation[MACHINE_PHASES_MAX];      /* flux linkage at the same angle and current: relative, > -1 */
    double angle_deviation_deg[MACHINE_PHASES_MAX]; /* position of the aligned angle, mechanical */
} circuit_t;

typedef struct {
    const char *name;
    unsigned stator_poles;
    unsigned rotor_poles;
    unsigned phases; /* 1..HAL_PHASES_MAX */
    double resistance_ohm;
    double inertia_kg_m2;
    double friction_Nm_s;
    double supply_voltage_V;
    magnetics_t magnetics;
    circuit_t circuit;
    converter_t converter;
    dc_link_t dc_link;
    sensor_errors_t sensors;
    sensor_ranges_t ranges;
    thermal_data_t thermal;
    double trip_current_A; /* of the comparators in the gate drivers; 0: none */
} machine_t;

/* Machine of a program that is built for one; generated from the machine file. */
extern const machine_t machine_plant;

#endif
