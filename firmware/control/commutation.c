#include "control/commutation.h"

commutation_t commutation_at(const commutation_parameters_t *parameters, unsigned phases, unsigned rotor_poles,
                             uint32_t rotor_angle) {
    commutation_t commutation = {.active = COMMUTATION_NONE, .outgoing = COMMUTATION_NONE};
    const uint32_t electrical = rotor_angle * rotor_poles; /* modulo a pitch, on purpose */
    const uint32_t shift = (uint32_t)(((uint64_t)1 << 32) / phases);
    for (unsigned phase = 0; phase < phases; phase++) {
        const uint32_t angle = electrical - phase * shift;
        commutation.angle[phase] = angle;
        if (angle >= parameters->turn_on && angle < parameters->turn_off) {
            commutation.active = phase;
        } else if (angle >= parameters->turn_off && angle < parameters->outgoing_off) {
            commutation.outgoing = phase;
        }
    }
    return commutation;
}
