#include "control/pwm_ditc.h"

#include "control/phase_map.h"
#include "fixed/fixed.h"
#include "fixed/formats.h"

#define SETPOINT_UNIT_BITS 20 /* 1/16 N m in Q24 */

/* Lower limit of the depletion threshold: 1/16 N m. */
#define DEPLETED_MIN_Q24 (1 << 20)

void pwm_ditc_reset(const pwm_ditc_parameters_t *parameters, pwm_ditc_t *ditc) {
    bp_pid_reset(&parameters->pid, &ditc->pid);
    ditc->regulated = COMMUTATION_NONE;
}

pwm_ditc_setpoints_t pwm_ditc_setpoints(const machine_tables_t *tables, uint32_t crossover_angle) {
    pwm_ditc_setpoints_t setpoints = {{0}};
    for (unsigned k = 1; k < PWM_DITC_SETPOINTS; k++) {
        const uint32_t entry_q24 = ((4u + k % 4u) << (k / 4u + SETPOINT_UNIT_BITS - 2u)) - (1u << SETPOINT_UNIT_BITS);
        const int32_t torque_q24 = entry_q24 < INT32_MAX ? (int32_t)entry_q24 : INT32_MAX;
        /* Largest current whose torque does not exceed it, by bisection. */
        uint32_t current_q9 = 0;
        for (uint32_t bit = 1u << 15; bit > 0; bit >>= 1) {
            const int32_t trial_q9 = fixed_clamp((int32_t)(current_q9 | bit), 0, PHASE_MAP_CURRENT_MAX_Q9);
            const int32_t torque = phase_map_torque(tables, crossover_angle, trial_q9);
            if (phase_map_scale(&tables->torque_format, torque) <= torque_q24) {
                current_q9 |= bit;
            }
        }
        setpoints.current_q9[k] = (uint16_t)fixed_clamp((int32_t)current_q9, 0, PHASE_MAP_CURRENT_MAX_Q9);
    }
    return setpoints;
}

int32_t pwm_ditc_setpoint_q9(const pwm_ditc_setpoints_t *setpoints, int32_t torque_q24) {
    const uint32_t shifted_q24 = (uint32_t)fixed_non_negative(torque_q24) + (1u << SETPOINT_UNIT_BITS);
    const unsigned zeros = (unsigned)__builtin_clz(shifted_q24); /* 0..11 */
    const uint32_t mantissa = shifted_q24 << zeros << 1;         /* without the leading one */
    const uint16_t *entry = &setpoints->current_q9[4u * (31u - SETPOINT_UNIT_BITS - zeros) + (mantissa >> 30)];
    const int32_t fraction_q14 = (int32_t)(mantissa >> 16) & 0x3fff;
    return entry[0] + ((entry[1] - entry[0]) * fraction_q14 >> 14);
}

static void open_switches(int32_t duty_q15[HAL_PHASES_MAX]) {
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        duty_q15[phase] = -ONE_Q15;
    }
}

/* Duty that drives the incoming phase to its current setpoint, or to the limit while the torque is below the outer
 * band. */
static int32_t incoming_duty_q15(const pwm_ditc_parameters_t *parameters, const pwm_ditc_sample_t *sample,
                                 int32_t current_q9) {
    const int32_t limit_q9 = parameters->current_limit_q9;
    const int32_t margin_q24 = fixed_multiply_high(sample->reference_q24, parameters->overshoot_margin_q32);
    const int32_t setpoint_q9 =
        pwm_ditc_setpoint_q9(&parameters->current_setpoints, fixed_add(sample->reference_q24, margin_q24));
    const bool full_support = sample->error_q24 > parameters->band_outer_q24 || setpoint_q9 > limit_q9;
    const int32_t target_q9 = full_support ? limit_q9 : setpoint_q9;
    /* Q23 * Q24 to Q15: currents of 0..128 A differ by less than 2^30. */
    return fixed_clamp(fixed_multiply_high((target_q9 - current_q9) * (1 << 14), parameters->incoming_gain_q24),
                       -ONE_Q15, ONE_Q15);
}

/* Highest duty of the regulated phase. acting_q15: its duty until the new one acts. */
static int32_t ceiling_q15(const pwm_ditc_parameters_t *parameters, int32_t current_q9, int32_t acting_q15) {
    if (current_q9 > parameters->current_limit_q9) {
        return 0;
    }
    const int32_t room_q9 = parameters->current_ceiling_q9 - current_q9; /* >= 0 */
    return fixed_multiply_high(room_q9 * (1 << 14), parameters->ceiling_gain_q24) - acting_q15;
}

void pwm_ditc_step(const pwm_ditc_parameters_t *parameters, pwm_ditc_t *ditc, const commutation_t *commutation,
                   const pwm_ditc_sample_t *sample, int32_t duty_q15[HAL_PHASES_MAX]) {
    const unsigned active = commutation->active;
    if (active == COMMUTATION_NONE) {
        open_switches(duty_q15);
        return;
    }

    if (ditc->regulated == COMMUTATION_NONE) {
        /* From standstill: a phase past its window still has torque, the one that just entered has none. */
        ditc->regulated = commutation->outgoing != COMMUTATION_NONE ? commutation->outgoing : active;
    }
    int32_t incoming_q15 = -ONE_Q15;
    if (ditc->regulated != active) {
        /* The BP-PID regulates the outgoing phase until that phase is depleted. */
        incoming_q15 = incoming_duty_q15(parameters, sample, sample->current_q9[active]);
        const int32_t eighth_q24 = fixed_clamp(sample->reference_q24 >> 3, 0, parameters->depleted_torque_q24);
        const int32_t threshold_q24 = eighth_q24 > DEPLETED_MIN_Q24 ? eighth_q24 : DEPLETED_MIN_Q24;
        const bool depleted =
            sample->torque[ditc->regulated] < threshold_q24 >> parameters->torque_shift && sample->error_q24 <= 0;
        if (depleted || ditc->regulated != commutation->outgoing) {
            bp_pid_preset(&ditc->pid, incoming_q15);
            ditc->regulated = active;
        }
    }

    const int32_t regulated_q15 = bp_pid_step(&parameters->pid, &ditc->pid, sample->error_q24);
    const unsigned regulated = ditc->regulated;
    const int32_t highest_q15 = ceiling_q15(parameters, sample->current_q9[regulated], duty_q15[regulated]);
    open_switches(duty_q15);
    duty_q15[active] = incoming_q15;
    duty_q15[regulated] = regulated_q15 < highest_q15 ? regulated_q15 : highest_q15;
}
