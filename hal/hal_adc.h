/* Analogue inputs, sampled together by the timer at the start of each control period. */
#ifndef HAL_ADC_H
#define HAL_ADC_H

#include <stdint.h>

#include "hal.h"

#define HAL_ADC_BITS_MIN 12
#define HAL_ADC_BITS_MAX 16

/* Full scale is 2^bits counts, one above the largest. The full scales are data of the board, in the machine's tables
 * and so in its machine file. Current sensors are unipolar: 0 counts are 0 A; the DC-link voltage divider likewise. The
 * torque transducer between machine and load is offset binary: mid-scale, 2^(bits-1), is 0 N m. A board without a
 * transducer leaves the input floating: only use it where a parameter enables it. */

typedef struct {
    uint16_t phase_current_counts[HAL_PHASES_MAX]; /* 0..2^bits-1, as all counts */
    uint16_t bus_voltage_counts;
    uint16_t load_torque_counts; /* positive against the forward direction */
} hal_adc_sample_t;

/* Resolution in bits, 12..16; constant. [background] */
unsigned hal_adc_bits(const hal_t *hal);

/* The conversion results of this period's sample. [control interrupt] */
void hal_adc_read(const hal_t *hal, hal_adc_sample_t *sample);

/* Temperature sensors, one in each winding and one in the switches of each phase, converted in the background. A code
 * has 16 bits, whatever the resolution, and is linear: 0 is HAL_ADC_TEMPERATURE_ZERO_C, full scale
 * HAL_ADC_TEMPERATURE_SPAN_K more; a port linearises what its sensors are. Outside of the limits below a sensor is
 * shorted (0) or open (its largest code, by a pull-up resistor), and the divider of a port has to see to that. */
#define HAL_ADC_TEMPERATURE_ZERO_C (-100)
#define HAL_ADC_TEMPERATURE_SPAN_K 400
#define HAL_ADC_TEMPERATURE_CODE_MIN 4096u  /* -75 C */
#define HAL_ADC_TEMPERATURE_CODE_MAX 61440u /* 275 C */

/* Sensor of a winding, of the switches of a phase: plus the number of the phase. */
#define HAL_ADC_WINDING 0u
#define HAL_ADC_INVERTER HAL_PHASES_MAX
#define HAL_ADC_TEMPERATURES (2 * HAL_PHASES_MAX)

/* Code of the last conversion, at most 2 ms old; codes of phases that the machine does not have mean nothing.
 * [background] */
uint16_t hal_adc_temperature(const hal_t *hal, unsigned sensor);

#endif
