/* True random number generator. */
#ifndef HAL_RANDOM_H
#define HAL_RANDOM_H

#include <stdint.h>

#include "hal.h"

/* A number that nothing predicts: neither earlier numbers nor a reset nor another board. [background] */
uint32_t hal_random_u32(hal_t *hal);

#endif
