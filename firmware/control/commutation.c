#include "control/commutation.h"

/* 2^32 / phases: a stroke in 2^-32 pitch, from one phase to the next. As (2^32 - phases) / phases + 1, which a 32-bit
 * division does. */
uint32_t commutation_stroke(unsigned phases) {
    return (0u - phases) / phases + 1u;
}

commutation_parameters_t commutation_configure(const commutation_angles_t *angles, unsigned phases,
                                               unsigned rotor_poles) {
    const uint32_t stroke = commutation_stroke(phases);
    const uint32_t turn_on = angles->turn_on;
    const uint32_t active = angles->turn_off > turn_on ? angles->turn_off - turn_on : 0;
    const uint32_t available = angles->outgoing_off > turn_on ? angles->outgoing_off - turn_on : 0;
    return (commutation_parameters_t){
        .phases = phases,
        .rotor_poles = rotor_poles,
        .stroke = stroke,
        .turn_on = turn_on,
        /* Three strokes are one unit short of a pitch: a window of a stroke is not to leave that one open. */
        .active_width = active == stroke ? stroke + 1 : active,
        .available_width = available > active ? available : active,
    };
}

void commutation_find(const commutation_parameters_t *parameters, uint32_t rotor_angle, commutation_t *commutation) {
    const uint32_t electrical = rotor_angle * parameters->rotor_poles; /* modulo a pitch, on purpose */
    commutation->electrical = electrical;
    /* Strokes since phase 0 was turned on: the phase that was turned on last, and its angle behind that. */
    const uint32_t since_first = electrical - parameters->turn_on;
    const unsigned last = (unsigned)(((uint64_t)since_first * parameters->phases) >> 32);
    const uint32_t since = since_first - last * parameters->stroke;
    if (since < parameters->active_width) {
        commutation->active = last;
        commutation->outgoing = COMMUTATION_NONE;
        if (since + parameters->stroke < parameters->available_width) { /* at most two strokes: no overflow */
            commutation->outgoing = (last > 0 ? last : parameters->phases) - 1;
        }
    } else {
        commutation->active = COMMUTATION_NONE;
        commutation->outgoing = since < parameters->available_width ? last : COMMUTATION_NONE;
    }
}
