/* A machine with its converter, link and sensors, as its machine file (tools/machines) says. */
#ifndef PLANT_MACHINE_H
#define PLANT_MACHINE_H

#include "plant/magnetics.h"

/* The asymmetric half bridges' devices, all alike. All zero: ideal. */
typedef struct {
    double switch_drop_V; /* at any current, and its slope */
    double switch_resistance_ohm;
    double diode_drop_V;
    double diode_resistance_ohm;
    double minimum_pulse_ns; /* a shorter pulse or gap of a switch does not happen */
} converter_t;

/* The DC link: a capacitor behind a supply with inner resistance that takes nothing back, and a brake chopper that is
 * on from chopper_on_V until the voltage is down to chopper_off_V. */
typedef struct {
    double capacitance_F; /* 0: an ideal supply that takes energy back, and the rest is ignored */
    double source_resistance_ohm;
    double chopper_resistance_ohm; /* 0: no chopper */
    double chopper_on_V, chopper_off_V;
} dc_link_t;

/* What the sensors do wrong; sensors.h applies it, the rig can change it. */
typedef struct {
    double current_gain; /* 1 is right */
    double current_offset_A;
    double current_noise_A; /* standard deviation */
    double current_limit_A; /* the sensor shows no more than this */
    double current_delay_ns;
    double encoder_eccentricity_deg; /* amplitude of an error that goes once round with the rotor, mechanical */
} sensor_errors_t;

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
    converter_t converter;
    dc_link_t dc_link;
    sensor_errors_t sensors;
} machine_t;

/* The machine this executable was built for; generated from the machine file. */
extern const machine_t machine_plant;

#endif
