/* Samples: latched by the PWM timer at the start of the period, read by the control interrupt. */
#include "hal_adc.h"
#include "hal_encoder.h"
#include "skeleton/board.h"

/* FILL IN: resolution of the converters. */
unsigned hal_adc_bits(const hal_t *hal) {
    (void)hal;
    return HAL_ADC_BITS_MIN;
}

/* FILL IN: result registers of the conversions that the timer has started. They must be complete. */
void hal_adc_read(const hal_t *hal, hal_adc_sample_t *sample) {
    (void)hal;
    *sample = (hal_adc_sample_t){0};
}

/* FILL IN: last conversion of the sensor, linearised, at most 2 ms old. Here: shorted sensors. */
uint16_t hal_adc_temperature(const hal_t *hal, unsigned sensor) {
    (void)hal;
    (void)sensor;
    return 0;
}

/* FILL IN: bits of a mechanical turn. */
unsigned hal_encoder_bits(const hal_t *hal) {
    (void)hal;
    return 17;
}

/* FILL IN: the count that the timer has latched, and the last edge before it where the board captures edges. */
void hal_encoder_read(const hal_t *hal, hal_encoder_sample_t *sample) {
    (void)hal;
    *sample = (hal_encoder_sample_t){.counts = 0, .edge_known = false};
}
