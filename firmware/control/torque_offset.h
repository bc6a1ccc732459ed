/* Torque offset: what is added to the torque reference so that the estimated torque has its mean.
 *
 *   offset = rate * integral of (reference - torque) dt,   reference without the offset
 *
 * Voltage drops of the devices and what else the flux linkage's prediction leaves out make the torque smaller than
 * requested, by 1 % on a machine of small inductance. The load observer takes the estimated torque and so does not see
 * the difference, which the speed law would have to make up by a speed error. The integral stands still while the
 * voltage limits the torque. A reference acts two periods later: a reference that changes by T leaves an offset of 2 Ts
 * rate T, one thousandth, which decays. */
#ifndef CONTROL_TORQUE_OFFSET_H
#define CONTROL_TORQUE_OFFSET_H

#include <stdbool.h>
#include <stdint.h>

typedef struct {
    int32_t gain_q32;  /* rate / update rate, Q0.32 */
    int32_t limit_q24; /* of the offset, N m, Q7.24 */
} torque_offset_parameters_t;

typedef struct {
    int64_t offset_q56; /* N m, Q7.56 */
} torque_offset_t;

/* Rate of the updates in Hz, limit of the torque reference in N m, Q7.24: the offset is at most an eighth of it. */
torque_offset_parameters_t torque_offset_configure(uint32_t update_rate_hz, int32_t torque_max_q24);

/* Offset for the next reference, N m, Q7.24, rounded down. */
static inline int32_t torque_offset_q24(const torque_offset_t *offset) {
    return (int32_t)(offset->offset_q56 >> 32);
}

/* One sample: reference, with the present offset, and estimated torque in N m, Q7.24, any value; voltage_limited keeps
 * the offset. Differences saturate, the 64-bit integral is clamped. */
void torque_offset_step(const torque_offset_parameters_t *parameters, torque_offset_t *offset, int32_t reference_q24,
                        int32_t torque_q24, bool voltage_limited);

#endif
