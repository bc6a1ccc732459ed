/* Commutation: phases that conduct, by turn-on and turn-off angle, for direct instantaneous torque control.
 *
 * Angles of a phase in 2^-32 electrical rev, an electrical revolution being a rotor pole pitch: 0 aligned, 2^31
 * unaligned (45 mechanical degrees of 90 in the paper). Angle control of a switched reluctance machine is textbook (T.
 * J. E. Miller, "Switched Reluctance Motors and Their Control", 1993); the default angles are the paper's.
 *
 * Conduction windows follow each other without gap when turn-off - turn-on = 1 rev / phases, as 45 and 75 degrees of
 * the paper do. A phase past its window stays available as outgoing phase until `outgoing_off`, because a hard turn-off
 * at 75 degrees leaves a torque dip that the next phase cannot fill in time. Where windows overlap (300 electrical
 * degrees of a four-phase machine, say) the phase that entered last is the active one and its predecessor the outgoing
 * one.
 */
#ifndef CONTROL_COMMUTATION_H
#define CONTROL_COMMUTATION_H

#include <stdbool.h>
#include <stdint.h>

#include "control/machine_tables.h"
#include "fixed/divide.h"
#include "hal.h"

#define COMMUTATION_NONE HAL_PHASES_MAX
#define COMMUTATION_ANGLES 64u

/* Angles as parameters set them. */
typedef struct {
    uint32_t turn_on;      /* 2^-32 electrical rev, from 2^30 */
    uint32_t turn_off;     /* above turn_on; otherwise no phase is active */
    uint32_t outgoing_off; /* from turn_off on */
} commutation_angles_t;

/* Angles as the control interrupt uses them, 2^-32 electrical rev. */
typedef struct {
    uint32_t phases;
    uint32_t rotor_poles;
    uint32_t stroke;
    uint32_t turn_on;
    uint32_t active_width;    /* conduction window, from turn_on */
    uint32_t available_width; /* window in which a phase is active or outgoing, from turn_on */
} commutation_parameters_t;

typedef struct {
    uint32_t electrical; /* angle of phase 0, 2^-32 electrical rev */
    unsigned active;     /* phase in its window, the last to enter where windows overlap; or COMMUTATION_NONE */
    unsigned outgoing;   /* available phase that entered before it, or that is past its window; or COMMUTATION_NONE */
} commutation_t;

/* 2^-32 electrical revolution from electrical degrees in Q7; 360 degrees saturate just below one revolution. */
static inline uint32_t commutation_angle_from_degrees(int32_t degrees_q7) {
    const int64_t angle = fixed_divide((int64_t)degrees_q7 << 32, 360 * 128);
    return angle > UINT32_MAX ? UINT32_MAX : (uint32_t)angle;
}

/* Stroke, the angle from one phase to the next: 2^32 / phases, rounded down, 2^-32 electrical rev. phases >= 2. */
uint32_t commutation_stroke(unsigned phases);

/* Any angles; 2 <= phases <= HAL_PHASES_MAX. */
commutation_parameters_t commutation_configure(const commutation_angles_t *angles, unsigned phases,
                                               unsigned rotor_poles);

/* False when turn-on is so early that the torque of the phases in use, a phase before its unaligned position among
 * them, is against the commanded direction, or in it by less than a quarter of the largest: a rotor at rest there would
 * be driven backwards. Both at a current, A, Q7.9; looked at in COMMUTATION_ANGLES angles of a stroke. Angles that no
 * phase is in use at have no such torque. [background] */
bool commutation_drives_forward(const commutation_parameters_t *parameters, const machine_tables_t *tables,
                                int32_t current_q9);

/* Roles of the phases at the angle `electrical` of phase 0. */
void commutation_find(const commutation_parameters_t *parameters, commutation_t *commutation);

/* Angle of phase 0, 2^-32 electrical rev, for a rotor angle in 2^-32 mechanical rev; wraps. */
static inline uint32_t commutation_electrical(const commutation_parameters_t *parameters, uint32_t rotor_angle) {
    return rotor_angle * parameters->rotor_poles;
}

/* Angle of a phase, 2^-32 electrical rev. */
static inline uint32_t commutation_angle(const commutation_parameters_t *parameters, const commutation_t *commutation,
                                         unsigned phase) {
    return commutation->electrical - phase * parameters->stroke;
}

#endif
