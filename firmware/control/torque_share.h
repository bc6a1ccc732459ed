/* Torque sharing: which part of the reference each phase gives, over its angle.
 *
 * A phase works from turn-on to turn-off, which overlaps the next phase's window by `overlap`: in the overlap the one
 * rises by a cubic and the other falls by the same, so that they make one everywhere. Two samples ahead, a smooth share
 * is what a voltage can follow; a step is not.
 *
 * Angles are those of a phase that makes positive torque: 2^31 unaligned .. 2^32 aligned, in 2^-32 pitch. A phase in
 * the other half, where its torque is negative, is asked at its mirror image. Where voltage runs out the window moves
 * towards earlier angles: turn-on below 2^31 then says how much of the share a phase has at once at the unaligned
 * position.
 */
#ifndef CONTROL_TORQUE_SHARE_H
#define CONTROL_TORQUE_SHARE_H

#include <stdbool.h>
#include <stdint.h>

typedef struct {
    bool sharing;           /* false: no overlap, one phase at a time */
    uint32_t stroke;        /* 2^32 / phases */
    uint32_t turn_on;       /* 2^-32 pitch */
    uint32_t turn_off;      /* from turn_on + stroke + 2^20 */
    uint32_t turn_on_early; /* how much earlier each is at full advance */
    uint32_t turn_off_early;
} torque_share_parameters_t;

/* The window at some advance. */
typedef struct {
    uint32_t turn_on;
    uint32_t stroke;
    uint32_t overlap;    /* 0: none */
    uint32_t reciprocal; /* 2^47 / overlap */
} torque_share_window_t;

/* Advance in Q1.15, 0..32768. */
torque_share_window_t torque_share_window(const torque_share_parameters_t *parameters, int32_t advance_q15);

/* Share in Q1.15, 0..32768, at an angle from 2^31. Both shares of an overlap make 32768, to the bit. */
int32_t torque_share_q15(const torque_share_window_t *window, uint32_t angle);

#endif
