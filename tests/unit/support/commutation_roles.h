// Roles and angles of all phases at a rotor angle.
#ifndef TESTS_UNIT_COMMUTATION_ROLES_H
#define TESTS_UNIT_COMMUTATION_ROLES_H

#include <cstdint>

extern "C" {
#include "control/commutation.h"
}

struct roles_t : commutation_t {
    uint32_t angle[HAL_PHASES_MAX]; // 2^-32 electrical rev
};

inline roles_t roles_at(const commutation_angles_t &angles, unsigned phases, unsigned rotor_poles,
                        uint32_t rotor_angle) {
    const commutation_parameters_t parameters = commutation_configure(&angles, phases, rotor_poles);
    roles_t roles{};
    roles.electrical = commutation_electrical(&parameters, rotor_angle);
    commutation_find(&parameters, &roles);
    for (unsigned phase = 0; phase < phases; phase++) {
        roles.angle[phase] = commutation_angle(&parameters, &roles, phase);
    }
    return roles;
}

#endif
