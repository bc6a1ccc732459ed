#include "control/ditc_hysteresis.h"

#include <stdbool.h>

void ditc_hysteresis_reset(ditc_hysteresis_t *ditc) {
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        ditc->state[phase] = -1;
    }
}

static int8_t single_state(const ditc_hysteresis_parameters_t *parameters, int8_t state, int32_t error_q24) {
    if (error_q24 > parameters->band_inner_q24) {
        return 1;
    }
    if (error_q24 < -parameters->band_outer_q24) {
        return -1;
    }
    return error_q24 < -parameters->band_inner_q24 || state < 0 ? 0 : state;
}

static int8_t incoming_state(const ditc_hysteresis_parameters_t *parameters, int8_t state, int32_t error_q24) {
    if (error_q24 > parameters->band_outer_q24) {
        return 1;
    }
    return error_q24 < 0 || state < 0 ? 0 : state;
}

static int8_t outgoing_state(const ditc_hysteresis_parameters_t *parameters, int8_t state, int32_t error_q24) {
    if (error_q24 > parameters->band_inner_q24) {
        return 1;
    }
    if (error_q24 < -parameters->band_inner_q24) {
        return -1;
    }
    const bool crossed_zero = (state > 0 && error_q24 <= 0) || (state < 0 && error_q24 >= 0);
    return crossed_zero ? 0 : state;
}

typedef struct {
    int32_t current_q9; /* A, Q7.9 */
    int8_t state;       /* highest one above it */
} limit_t;

/* While the rotor turns backwards, the back-EMF drives the current of a freewheeling phase further up. */
static limit_t limit_of(const ditc_hysteresis_parameters_t *parameters, bool backwards) {
    const int32_t limit_q9 = parameters->current_limit_q9;
    return backwards ? (limit_t){limit_q9 - limit_q9 / 4, -1} : (limit_t){limit_q9, 0};
}

static int8_t limit_current(limit_t limit, int8_t state, int32_t current_q9) {
    return state > limit.state && current_q9 > limit.current_q9 ? limit.state : state;
}

void ditc_hysteresis_step(const ditc_hysteresis_parameters_t *parameters, ditc_hysteresis_t *ditc,
                          const commutation_t *commutation, int32_t torque_error_q24, const int32_t *current_q9,
                          bool backwards) {
    const limit_t limit = limit_of(parameters, backwards);
    const unsigned active = commutation->active;
    const unsigned outgoing = commutation->outgoing;
    int8_t outgoing_state_next = -1;
    bool outgoing_conducts = false;
    if (outgoing != COMMUTATION_NONE) {
        outgoing_state_next = limit_current(limit, outgoing_state(parameters, ditc->state[outgoing], torque_error_q24),
                                            current_q9[outgoing]);
        outgoing_conducts = current_q9[outgoing] > 0;
    }
    int8_t active_state_next = -1;
    if (active != COMMUTATION_NONE) {
        active_state_next = outgoing_conducts ? incoming_state(parameters, ditc->state[active], torque_error_q24)
                                              : single_state(parameters, ditc->state[active], torque_error_q24);
        active_state_next = limit_current(limit, active_state_next, current_q9[active]);
    }
    ditc_hysteresis_reset(ditc);
    if (outgoing != COMMUTATION_NONE) {
        ditc->state[outgoing] = outgoing_state_next;
    }
    if (active != COMMUTATION_NONE) {
        ditc->state[active] = active_state_next;
    }
}
