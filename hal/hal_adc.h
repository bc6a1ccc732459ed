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

/* Resolution in bits, 12..16; constant. [both] */
unsigned hal_adc_bits(const hal_t *hal);

/* The conversion results of this period's sample. [interrupt] */
void hal_adc_read(const hal_t *hal, hal_adc_sample_t *sample);

#endif
