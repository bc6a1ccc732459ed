#include "interrupts/torque_control.h"

#include "control/modulator.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"

void torque_control_reset(const control_parameters_t *parameters, control_state_t *state) {
    ditc_hysteresis_reset(state->duty_q15);
    switch (parameters->torque_law) {
    case TORQUE_LAW_HYSTERESIS:
        break;
    case TORQUE_LAW_DUTY:
        pwm_ditc_reset(&state->duty);
        break;
    case TORQUE_LAW_PREDICTIVE:
        predictive_torque_reset(&state->predictive);
        break;
    }
}

/* Threshold of a rotor that turns backwards: 8 rad/s, above the noise of the speed estimate at standstill. */
#define BACKWARDS_Q22 (1 << 25)

static bool turns_backwards(int32_t speed_q22) {
    return speed_q22 < -BACKWARDS_Q22;
}

ditc_hysteresis_limit_t torque_control_limit(const control_parameters_t *parameters, int32_t speed_q22) {
    return ditc_hysteresis_limit(&parameters->hysteresis,
                                 turns_backwards(speed_q22) ? fixed_subtract(0, speed_q22) : 0);
}

/* Torque by which the estimate is below the reference, in units of the tables, in which bands and gains of DITC suit
 * the currents. */
static int32_t torque_error_q24(const control_state_t *state) {
    return table_scale_multiply(fixed_subtract(state->torque_reference_q24, state->measurement.torque_sum_q24),
                                state->table_scale.inverse_excess_q31);
}

/* Not inlined: with the rest of the interrupt it needs more registers than there are, 4 of the computed bound of
 * traditional. */
NOINLINE static void hysteresis_control(const control_parameters_t *parameters, control_state_t *state,
                                        const deferred_results_t *deferred) {
    const control_measurement_t *measured = &state->measurement;
    commutation_t commutation = {.electrical = measured->commutation.electrical};
    commutation_find(&parameters->commutation, &commutation);
    ditc_hysteresis_step(&parameters->hysteresis, &commutation, torque_error_q24(state), measured->current_q9,
                         deferred->limit, state->duty_q15);
}

/* False when hysteresis control is to act instead. */
static bool duty_control(const control_parameters_t *parameters, control_state_t *state,
                         const deferred_results_t *deferred) {
    const control_measurement_t *measured = &state->measurement;
    if (state->duty.regulated == COMMUTATION_NONE && state->torque_reference_q24 <= 0) {
        /* The speed law's first torque acts in the second period: the outgoing phase would count as depleted before. */
        for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
            state->duty_q15[phase] = -MODULATOR_DUTY_ONE_Q15;
        }
        return true;
    }
    if (turns_backwards(state->observer.speed_q22)) {
        /* The BP-PID assumes the order of the phases of forward motion. It begins again, as from standstill. */
        state->duty.regulated = COMMUTATION_NONE;
        return false;
    }
    const pwm_ditc_sample_t sample = {
        .current_q9 = measured->current_q9,
        .torque = measured->torque,
        .error_q24 = torque_error_q24(state),
        .gain_q24 = deferred->pid_gain_q24,
        .plan = &deferred->duty,
    };
    commutation_t ahead = {.electrical = measured->commutation.electrical + deferred->duty.lead};
    commutation_find(&parameters->commutation, &ahead);
    pwm_ditc_step(&parameters->duty, &state->duty, &ahead, &sample, state->duty_q15);
    return true;
}

static void predictive_control(const control_parameters_t *parameters, control_state_t *state,
                               const deferred_results_t *deferred) {
    const control_measurement_t *measured = &state->measurement;
    const load_observer_t *observer = &state->observer;
    const uint32_t rotor_poles = parameters->commutation.rotor_poles;
    /* The duties act from one to two periods after the sample: the observer has predicted the first period. */
    const int32_t step = fixed_multiply_high(observer->speed_q22, parameters->observer.angle_step_q32);
    const uint32_t angle_in_two_periods = (uint32_t)(observer->angle_q64 >> 32) + (uint32_t)step;
    const table_scale_factors_t *scale = &state->table_scale;
    const conduction_t *conduction =
        conduction_angles(&parameters->conduction, &state->deferred.conduction, deferred->predictive.conduction);
    const predictive_torque_sample_t sample = {
        .current_q9 = measured->current_q9,
        .flux = measured->flux_linkage,
        .conduction = conduction,
        .angle = angle_in_two_periods * rotor_poles,
        .misalignment = deferred->predictive.misalignment,
        .bus_voltage_q6 = measured->dc_link_voltage_q6,
        .torque_q24 = table_scale_multiply(fixed_add(state->torque_reference_q24, conduction->ripple_q24),
                                           scale->inverse_excess_q31),
        .flux_observer = &scale->flux,
        .period_q40 = scale->period_q40,
        .lost_phase = state->lost_phase,
        .reverse = observer->speed_q22 < 0,
        .angle_step = (uint32_t)fixed_abs(step) * rotor_poles,
    };
    predictive_torque_step(&parameters->predictive, &state->predictive, &machine_tables, &sample, state->duty_q15);
}

void torque_control(const control_parameters_t *parameters, control_state_t *state,
                    const deferred_results_t *deferred) {
    if (parameters->torque_law == TORQUE_LAW_PREDICTIVE) {
        predictive_control(parameters, state, deferred);
        return;
    }
    if (parameters->torque_law == TORQUE_LAW_HYSTERESIS || !duty_control(parameters, state, deferred)) {
        hysteresis_control(parameters, state, deferred);
    }
    const uint32_t lost = state->lost_phase - 1u; /* UINT32_MAX: none */
    if (!LIKELY(lost >= machine_tables.phases)) { /* the laws of hysteresis and duty know of no lost phase */
        state->duty_q15[lost] = -MODULATOR_DUTY_ONE_Q15;
    }
}

bool torque_control_voltage_saturated(const control_parameters_t *parameters, const control_state_t *state) {
    if (parameters->torque_law == TORQUE_LAW_PREDICTIVE) {
        return state->predictive.torque_shortfall_q24 != 0;
    }
    for (unsigned phase = 0; phase < machine_tables.phases; phase++) {
        if (state->duty_q15[phase] == MODULATOR_DUTY_ONE_Q15) {
            return true;
        }
    }
    return false;
}
