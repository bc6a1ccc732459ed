/* Which phase works: turn-on and turn-off angle of direct instantaneous torque control.
 *
 * Angles of a phase in 2^-32 rotor pitch: 0 aligned, 2^31 unaligned (45 degrees of the 90 degree pitch in the paper).
 * The conduction windows of the phases follow each other without gap when turn-off - turn-on is pitch / phases, as the
 * paper's 45 and 75 degrees are; a phase that has left its window stays available until `outgoing_off`, because a hard
 * turn-off at 75 degrees leaves a hole in the torque that the next phase cannot fill in time. Where windows overlap
 * (300 degrees of a four-phase pitch, say) the phase that entered last is the active one and the one before it
 * outgoing.
 */
#ifndef CONTROL_COMMUTATION_H
#define CONTROL_COMMUTATION_H

#include <stdint.h>

#include "hal.h"

#define COMMUTATION_NONE HAL_PHASES_MAX

/* As a user sets them. */
typedef struct {
    uint32_t turn_on;      /* 2^-32 pitch, from 2^31 */
    uint32_t turn_off;     /* above turn_on; else no phase is ever active */
    uint32_t outgoing_off; /* from turn_off */
} commutation_angles_t;

/* As the interrupt uses them. */
typedef struct {
    uint32_t phases;
    uint32_t rotor_poles;
    uint32_t stroke;
    uint32_t turn_on;
    uint32_t active_width;    /* behind turn-on a phase is in its window so long */
    uint32_t available_width; /* and available so long */
} commutation_parameters_t;

typedef struct {
    uint32_t electrical; /* angle of phase 0, 2^-32 pitch */
    unsigned active;     /* in its window, the last to enter where windows overlap; COMMUTATION_NONE */
    unsigned outgoing;   /* the one before it, or itself behind its window, where available; COMMUTATION_NONE */
} commutation_t;

/* 2^32 / phases: a stroke in 2^-32 pitch, from one phase to the next; rounded down. phases >= 2. */
uint32_t commutation_stroke(unsigned phases);

/* Any angles; 2 <= phases <= HAL_PHASES_MAX. */
commutation_parameters_t commutation_configure(const commutation_angles_t *angles, unsigned phases,
                                               unsigned rotor_poles);

/* Roles for a rotor angle in 2^-32 mechanical turn. */
void commutation_find(const commutation_parameters_t *parameters, uint32_t rotor_angle, commutation_t *commutation);

/* Angle of a phase, 2^-32 pitch. */
static inline uint32_t commutation_angle(const commutation_parameters_t *parameters, const commutation_t *commutation,
                                         unsigned phase) {
    return commutation->electrical - phase * parameters->stroke;
}

#endif
