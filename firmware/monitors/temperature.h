/* Measured temperatures of the windings and of the switches of each phase: a separate limit beside the thermal models
 * of the currents (thermal.h). Those know the heat of a current before a sensor shows it; the sensors know the
 * surroundings, the cooling and the heat from before a reset. The smallest limit of the torque counts, and the faults
 * are the same.
 *
 * From TEMPERATURE_DERATE_K below the limit of the parameters the torque's limit falls linearly to 0 at the limit,
 * which is a fault until the temperature is TEMPERATURE_DERATE_K lower. A reading outside of hal_adc.h's limits three
 * times in succession, or the first one, is a sensor that is open or shorted; meanwhile no lower temperature counts.
 */
#ifndef MONITORS_TEMPERATURE_H
#define MONITORS_TEMPERATURE_H

#include <stdbool.h>
#include <stdint.h>

#include "hal_adc.h"
#include "storage/parameters.h"

#define TEMPERATURE_STEP_US 10000u
#define TEMPERATURE_CODE_BITS 16
#define TEMPERATURE_DERATE_K 20
#define TEMPERATURE_INVALID_MAX 3 /* readings in succession */

typedef enum { TEMPERATURE_WINDING, TEMPERATURE_INVERTER, TEMPERATURE_PARTS } temperature_part_t;

typedef struct {
    int32_t limit[TEMPERATURE_PARTS]; /* codes of hal_adc.h */
    int32_t torque_max_q24;           /* N m, Q7.24 */
} temperature_parameters_t;

typedef struct {
    uint32_t step_us;                          /* the last one */
    uint8_t invalid[HAL_ADC_TEMPERATURES];     /* readings in succession */
    uint8_t failed_sensors[TEMPERATURE_PARTS]; /* bit of a phase */
    bool hot[TEMPERATURE_PARTS];               /* the faults */
    int32_t hottest[TEMPERATURE_PARTS];        /* code */
    int32_t torque_limit_q24;                  /* of the torque reference's magnitude, N m, Q7.24: 0..torque_max_q24 */
} temperature_t;

/* Derives the parameters: any values within the limits of the table. */
temperature_parameters_t temperature_configure(const int32_t *values);

/* The first step is due at time_us. */
void temperature_init(temperature_t *temperature, uint32_t time_us);

/* Reads the sensors of a machine's phases when a step is due. [background] */
void temperature_step(const temperature_parameters_t *parameters, temperature_t *temperature, const hal_t *hal,
                      unsigned phases, uint32_t time_us);

/* Fault mask. */
uint32_t temperature_faults(const temperature_t *temperature);

/* Temperature of the hottest winding or switches in C, rounded down. */
static inline int32_t temperature_C(const temperature_t *temperature, temperature_part_t part) {
    return HAL_ADC_TEMPERATURE_ZERO_C +
           (temperature->hottest[part] * HAL_ADC_TEMPERATURE_SPAN_K >> TEMPERATURE_CODE_BITS);
}

#endif
