#include "control/ditc_duty.h"

#include "control/phase_map.h"
#include "fixed/fixed.h"

#define DUTY_ONE_Q15 32768
#define AIM_UNIT_BITS 20 /* 1/16 N m in Q24 */

/* So little torque is none, whatever the reference: 1/16 N m. */
#define NO_TORQUE_Q24 (1 << 20)

void ditc_duty_reset(const ditc_duty_parameters_t *parameters, ditc_duty_t *ditc) {
    bp_pid_reset(&parameters->pid, &ditc->pid);
    ditc->regulated = COMMUTATION_NONE;
}

ditc_duty_aims_t ditc_duty_aims(const machine_tables_t *tables, uint32_t hand_over_angle) {
    const phase_map_place_t hand_over = phase_map_at(tables, hand_over_angle);
    ditc_duty_aims_t aims = {{0}};
    for (unsigned k = 1; k < DITC_DUTY_AIMS; k++) {
        const uint32_t end_q24 = ((4u + k % 4u) << (k / 4u + AIM_UNIT_BITS - 2u)) - (1u << AIM_UNIT_BITS);
        const int32_t torque_q24 = end_q24 < INT32_MAX ? (int32_t)end_q24 : INT32_MAX;
        /* The greatest current that gives no more. */
        uint32_t current_q9 = 0;
        for (uint32_t bit = 1u << 15; bit > 0; bit >>= 1) {
            if (phase_map_torque_q24(&hand_over, (int32_t)(current_q9 | bit)) <= torque_q24) {
                current_q9 |= bit;
            }
        }
        aims.current_q9[k] = (uint16_t)fixed_clamp((int32_t)current_q9, 0, PHASE_MAP_CURRENT_MAX_Q9);
    }
    return aims;
}

int32_t ditc_duty_aim_q9(const ditc_duty_aims_t *aims, int32_t torque_q24) {
    const uint32_t above = (uint32_t)torque_q24 + (1u << AIM_UNIT_BITS);
    const unsigned zeros = (unsigned)__builtin_clz(above); /* 0..11 */
    const uint32_t mantissa = above << zeros << 1;         /* without its leading one */
    const uint16_t *entry = &aims->current_q9[4u * (31u - AIM_UNIT_BITS - zeros) + (mantissa >> 30)];
    const int32_t fraction_q14 = (int32_t)(mantissa >> 16) & 0x3fff;
    return entry[0] + ((entry[1] - entry[0]) * fraction_q14 >> 14);
}

/* Duty that brings the incoming phase to its current: to the limit while torque is missing beyond the outer band. */
static int32_t incoming_duty_q15(const ditc_duty_parameters_t *parameters, const ditc_duty_sample_t *sample,
                                 int32_t current_q9) {
    const int32_t limit_q9 = parameters->current_limit_q9;
    const int32_t surplus_q24 = fixed_multiply_high(sample->reference_q24, parameters->surplus_q32);
    const int32_t carrying_q9 = ditc_duty_aim_q9(&parameters->aims, fixed_add(sample->reference_q24, surplus_q24));
    const bool assists = sample->error_q24 > parameters->band_outer_q24 || carrying_q9 > limit_q9;
    const int32_t target_q9 = assists ? limit_q9 : carrying_q9;
    /* Q23 * Q24 to Q15: currents of 0..128 A differ by less than 2^30. */
    return fixed_clamp(fixed_multiply_high((target_q9 - current_q9) * (1 << 14), parameters->incoming_gain_q24),
                       -DUTY_ONE_Q15, DUTY_ONE_Q15);
}

void ditc_duty_step(const ditc_duty_parameters_t *parameters, ditc_duty_t *ditc, const commutation_t *commutation,
                    const ditc_duty_sample_t *sample, int32_t duty_q15[HAL_PHASES_MAX]) {
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        duty_q15[phase] = -DUTY_ONE_Q15;
    }
    const unsigned active = commutation->active;
    if (active == COMMUTATION_NONE) {
        return;
    }

    if (ditc->regulated == COMMUTATION_NONE) {
        /* From standstill: past its window a phase still has torque, the one that just entered has none. */
        ditc->regulated = commutation->outgoing != COMMUTATION_NONE ? commutation->outgoing : active;
    }
    if (ditc->regulated != active) {
        /* The PID is with the outgoing phase while that one has torque to take off. */
        duty_q15[active] = incoming_duty_q15(parameters, sample, sample->current_q9[active]);
        const int32_t eighth_q24 = fixed_clamp(sample->reference_q24 / 8, 0, parameters->spent_torque_q24);
        const int32_t spent_q24 = eighth_q24 > NO_TORQUE_Q24 ? eighth_q24 : NO_TORQUE_Q24;
        const bool spent = sample->torque_q24[ditc->regulated] < spent_q24 && sample->error_q24 <= 0;
        if (spent || ditc->regulated != commutation->outgoing) {
            bp_pid_preset(&ditc->pid, duty_q15[active]);
            ditc->regulated = active;
        }
    }

    const int32_t regulated_q15 = bp_pid_step(&parameters->pid, &ditc->pid, sample->error_q24);
    const bool above_limit = sample->current_q9[ditc->regulated] > parameters->current_limit_q9;
    duty_q15[ditc->regulated] = above_limit && regulated_q15 > 0 ? 0 : regulated_q15;
}
