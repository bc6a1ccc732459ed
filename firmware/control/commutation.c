#include "control/commutation.h"

#include <stdbool.h>

void commutation_find(const commutation_parameters_t *parameters, unsigned phases, unsigned rotor_poles,
                      uint32_t rotor_angle, commutation_t *commutation) {
    commutation->active = COMMUTATION_NONE;
    commutation->outgoing = COMMUTATION_NONE;
    const uint32_t electrical = rotor_angle * rotor_poles; /* modulo a pitch, on purpose */
    const uint32_t shift = commutation_stroke(phases);
    uint32_t active_since = UINT32_MAX; /* angle behind turn-on */
    uint32_t outgoing_since = UINT32_MAX;
    for (unsigned phase = 0; phase < phases; phase++) {
        const uint32_t angle = electrical - phase * shift;
        commutation->angle[phase] = angle;
        if (angle >= parameters->turn_on && angle < parameters->turn_off &&
            angle - parameters->turn_on < active_since) {
            active_since = angle - parameters->turn_on;
            commutation->active = phase;
        }
    }
    for (unsigned phase = 0; phase < phases; phase++) {
        const uint32_t angle = commutation->angle[phase];
        const bool available =
            angle >= parameters->turn_on && (angle < parameters->turn_off || angle < parameters->outgoing_off);
        if (available && phase != commutation->active && angle - parameters->turn_on < outgoing_since) {
            outgoing_since = angle - parameters->turn_on;
            commutation->outgoing = phase;
        }
    }
}
