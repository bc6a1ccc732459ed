/* Analogue inputs: 12-bit, sampled together by the timer at the start of each control period. */
#ifndef HAL_ADC_H
#define HAL_ADC_H

#include <stdint.h>

#include "hal.h"

#define HAL_ADC_BITS 12
#define HAL_ADC_FULL_SCALE_COUNTS 4096 /* one count above the largest code, 4095 */

/* Current sensors are unipolar: code 0 is 0 A, 4096 counts would be 80 A (51.2 counts/A). */
#define HAL_ADC_CURRENT_FULL_SCALE_A 80
/* DC-link divider: 4096 counts would be 512 V (8 counts/V). */
#define HAL_ADC_BUS_FULL_SCALE_V 512

typedef struct {
    uint16_t phase_current_counts[HAL_PHASES_MAX]; /* 0..4095 */
    uint16_t bus_voltage_counts;                   /* 0..4095 */
} hal_adc_sample_t;

/* The conversion results of this period's sample. [interrupt] */
void hal_adc_read(const hal_t *hal, hal_adc_sample_t *sample);

#endif
