/* Torque sharing function (TSF): share of the torque reference per phase over its angle.
 *
 *   share(x) = 3 x^2 - 2 x^3 in the overlap at turn-on, 1, 1 - (3 x^2 - 2 x^3) in the overlap before turn-off
 *
 * with x from 0 to 1 over the overlap, in which the window of the next phase begins: the shares add up to one at every
 * angle. Torque sharing functions: M. Ilic-Spong, T. J. E. Miller, S. R. MacMinn, J. S. Thorp, "Instantaneous torque
 * control of electric motor drives", IEEE Trans. Power Electron. 2(1), 1987. The cubic is the polynomial of least
 * degree with zero slope at both ends, so that the flux linkage which it demands has a limited rate of change; a step
 * of the share would demand an unlimited voltage.
 *
 * Angles are for a phase with positive torque: 2^31 unaligned .. 2^32 aligned, in 2^-32 electrical rev. A phase in
 * the other half, where its torque is negative, is evaluated at the mirrored angle. The windows are the
 * machine's over torque and speed, or constant ones that are advanced to earlier angles when the voltage is limited
 * (conduction.h). A turn-on angle below 2^31 is then possible, and the share is not zero at the unaligned position.
 */
#ifndef CONTROL_TORQUE_SHARING_H
#define CONTROL_TORQUE_SHARING_H

#include <stdbool.h>
#include <stdint.h>

typedef struct {
    bool overlapping;          /* false: no overlap, one phase at a time */
    uint32_t stroke;           /* 2^32 / phases */
    uint32_t turn_on;          /* 2^-32 electrical rev */
    uint32_t turn_off;         /* from turn_on + stroke + 2^20 */
    uint32_t turn_on_advance;  /* decrease of turn_on at full advance */
    uint32_t turn_off_advance; /* decrease of turn_off at full advance */
} torque_sharing_parameters_t;

/* Window of a phase at some advance, 2^-32 electrical rev. */
typedef struct {
    uint32_t turn_on;
    uint32_t stroke;
    uint32_t overlap;    /* 0: none */
    uint32_t reciprocal; /* 2^47 / overlap */
} torque_sharing_window_t;

/* Window for an advance in Q1.15, 0..32768. Products rounded down; 1 / overlap from its upper 17 bits. */
torque_sharing_window_t torque_sharing_window(const torque_sharing_parameters_t *parameters, int32_t advance_q15);

/* Share in Q1.15, 0..32768, at an angle from 2^31 on. The two shares of an overlap add up to exactly 32768. Error: 4
 * LSB and the rounding of the overlap. */
int32_t torque_sharing_q15(const torque_sharing_window_t *window, uint32_t angle);

#endif
