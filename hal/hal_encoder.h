/* Absolute encoder on the shaft, latched by the timer at the start of each control period. */
#ifndef HAL_ENCODER_H
#define HAL_ENCODER_H

#include <stdint.h>

#include "hal.h"

/* Bits of one mechanical turn, 8..32; constant. [both] */
unsigned hal_encoder_bits(const hal_t *hal);

/* This period's latched position in counts, 0..2^bits-1, rising in the forward direction. [interrupt] */
uint32_t hal_encoder_read(const hal_t *hal);

#endif
