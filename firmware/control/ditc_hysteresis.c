#include "control/ditc_hysteresis.h"

#include <stdbool.h>

#include "fixed/compiler.h"
#include "fixed/fixed.h"
#include "fixed/formats.h"

#define ON ONE_Q15
#define OFF (-ONE_Q15)

void ditc_hysteresis_reset(int32_t duty_q15[HAL_PHASES_MAX]) {
    UNROLL(4)
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        duty_q15[phase] = OFF;
    }
}

/* The only phase, or with `supporting` the incoming one beside an outgoing one that conducts. */
static int32_t active_state(const ditc_hysteresis_parameters_t *parameters, int32_t state, int32_t error_q24,
                            bool supporting) {
    if (error_q24 > (supporting ? parameters->band_outer_q24 : parameters->band_inner_q24)) {
        return ON;
    }
    if (!supporting && error_q24 < -parameters->band_outer_q24) {
        return OFF;
    }
    return error_q24 < (supporting ? 0 : -parameters->band_inner_q24) || state < 0 ? 0 : state;
}

static int32_t outgoing_state(const ditc_hysteresis_parameters_t *parameters, int32_t state, int32_t error_q24) {
    if (error_q24 > parameters->band_inner_q24) {
        return ON;
    }
    if (error_q24 < -parameters->band_inner_q24) {
        return OFF;
    }
    return (state ^ error_q24) < 0 || error_q24 == 0 ? 0 : state; /* 0: the error has returned through zero */
}

/* While the rotor turns backwards, the back-EMF drives the current of a freewheeling phase further up. */
ditc_hysteresis_limit_t ditc_hysteresis_limit(const ditc_hysteresis_parameters_t *parameters, int32_t backwards_q22) {
    const int32_t limit_q9 = parameters->current_limit_q9;
    if (backwards_q22 == 0) {
        return (ditc_hysteresis_limit_t){limit_q9, 0};
    }
    const int32_t slow_q9 = limit_q9 - (limit_q9 >> 2);
    const int32_t fast_q9 =
        parameters->generating_limit_q9 - fixed_multiply_high(backwards_q22, parameters->generating_slope_q19);
    return (ditc_hysteresis_limit_t){fixed_min(slow_q9, fast_q9), OFF};
}

static int32_t limit_current(ditc_hysteresis_limit_t limit, int32_t state, int32_t current_q9) {
    return state > limit.state && current_q9 > limit.current_q9 ? limit.state : state;
}

void ditc_hysteresis_step(const ditc_hysteresis_parameters_t *parameters, const commutation_t *commutation,
                          int32_t torque_error_q24, const int32_t *current_q9, ditc_hysteresis_limit_t limit,
                          int32_t duty_q15[HAL_PHASES_MAX]) {
    const unsigned active = commutation->active;
    const unsigned outgoing = commutation->outgoing;
    int32_t outgoing_next = OFF;
    bool outgoing_conducts = false;
    if (outgoing != COMMUTATION_NONE) {
        const int32_t outgoing_current_q9 = current_q9[outgoing];
        outgoing_next =
            limit_current(limit, outgoing_state(parameters, duty_q15[outgoing], torque_error_q24), outgoing_current_q9);
        outgoing_conducts = outgoing_current_q9 > 0;
    }
    if (active == COMMUTATION_NONE) {
        ditc_hysteresis_reset(duty_q15);
    } else {
        const int32_t state = active_state(parameters, duty_q15[active], torque_error_q24, outgoing_conducts);
        const int32_t active_next = limit_current(limit, state, current_q9[active]);
        ditc_hysteresis_reset(duty_q15);
        duty_q15[active] = active_next;
    }
    if (outgoing != COMMUTATION_NONE) {
        duty_q15[outgoing] = outgoing_next;
    }
}
