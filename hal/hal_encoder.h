/* Absolute encoder on the shaft, latched by the timer at the start of each control period. */
#ifndef HAL_ENCODER_H
#define HAL_ENCODER_H

#include <stdbool.h>
#include <stdint.h>

#include "hal.h"

/* Longest age of an edge; a longer one saturates. */
#define HAL_ENCODER_AGE_MAX_TICKS UINT32_C(0x7FFFFFFF)

/* This period's latch. A board that captures the encoder's edges also reports the last one before the latch: at that
 * instant the angle was exactly on a boundary of the present count. */
typedef struct {
    uint32_t counts;         /* 0..2^bits-1, rising in the forward direction */
    bool edge_known;         /* false: the board captures none, or none was seen since start */
    bool edge_forward;       /* true: passed forwards, at `counts`; false: backwards, at `counts` + 1 (modulo a turn) */
    uint32_t edge_age_ticks; /* from the edge to the latch, in ticks of the PWM timer, nearest; 0..2^31-1, saturated */
} hal_encoder_sample_t;

/* Bits of one mechanical turn, 8..32; constant. [background] */
unsigned hal_encoder_bits(const hal_t *hal);

/* This period's latch. [control interrupt] */
void hal_encoder_read(const hal_t *hal, hal_encoder_sample_t *sample);

#endif
