/* Temperatures of the windings and of the switches of each phase, and their sensors.
 *
 * Each is one lumped body, with the losses of the plant in its phase (copper; devices of the half bridge):
 *
 *   C dT / dt = P - (T - T_ambient) / R        C, R: thermal_data_t, of the machine file
 *
 * in explicit steps of a millisecond and at most a control period more, whose energies are exact. A body may be held at
 * a temperature instead. The resistance of a winding in the plant follows its temperature when that has changed by 1 K,
 * which is 0.4 % of the resistance: a run that heats its windings by less has a constant resistance.
 *
 * A sensor has the temperature of its body at the end of the step, and the line of hal_adc.h at 12 bits.
 */
#ifndef RIG_HEAT_H
#define RIG_HEAT_H

#include <stdint.h>

#include "hal.h"
#include "plant/plant.h"
#include "plant/sensors.h"

/* Bodies of one kind, one in each phase, and their temperature sensors. */
typedef struct {
    double temperature_C[HAL_PHASES_MAX];
    double loss_J[HAL_PHASES_MAX];                      /* of the plant, at the last step */
    double held_C;                                      /* a variable of the bench */
    sensors_input_fault_t sensor_fault[HAL_PHASES_MAX]; /* code: of 16 bits; offset in K */
} heat_bodies_t;

typedef struct {
    plant_t *plant;
    uint16_t *codes;  /* of the sensors, at the inputs of the board */
    uint64_t time_ns; /* of the last step */
    double ambient_C;
    heat_bodies_t winding, inverter;
    double resistance_C[HAL_PHASES_MAX]; /* temperatures of the windings that the plant's resistances are for */
} heat_t;

/* Every body at ambient temperature. Keeps plant and codes, of HAL_ADC_TEMPERATURES sensors. */
void heat_init(heat_t *heat, plant_t *plant, uint16_t *codes);

/* Takes a step when its time has passed since the last one, at the time of the plant. */
void heat_step(heat_t *heat);

/* Temperature of the hottest winding and of the hottest switches. */
double heat_winding_C(const heat_t *heat);
double heat_inverter_C(const heat_t *heat);

#endif
